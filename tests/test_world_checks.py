"""World checks: a robot leaving the road, a ball resting too low and an image from another pose are faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Camera, Frame, Mesh
from scan2sim.pipeline.simulation.robot import ROBOT
from tests.fakes.world_checks import Fault, drops, rays, renderings
from tests.fakes.world_checks.drive import Pose, drive
from tests.fakes.world_checks.reference import Photo, Visible, WorldReference

NO_POINTS = np.zeros((0, 3))


class FakeRobot:
    """Robot with ideal odometry (`slip` scales its speed), starting near the origin along x."""

    def __init__(self, slip: float = 1.0) -> None:
        self.x, self.y, self.heading, self.slip = 0.0, 0.3, 0.0, slip

    def pose(self) -> Pose:
        c, s = np.cos(self.heading), np.sin(self.heading)
        return Pose(np.array([self.x, self.y, 0.0]), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))

    def turn(self, left: float, right: float, seconds: float) -> None:
        speed, turn = (left + right) / 2 * ROBOT.wheel_radius, (right - left) * ROBOT.wheel_radius / ROBOT.track
        self.heading += turn * seconds
        self.x += self.slip * speed * np.cos(self.heading) * seconds
        self.y += self.slip * speed * np.sin(self.heading) * seconds


def street(bend: float = 0.0, half: float = 2.0) -> WorldReference:
    """A road along x, and a driven path on it that bends to the left."""
    x, y = np.meshgrid(np.arange(-2, 30, 0.1), np.arange(-6, 6, 0.1))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    along = np.arange(0.0, 28.0, 0.5)
    path = np.column_stack([along, bend * along**2, 0 * along])
    return WorldReference(NO_POINTS, NO_POINTS, ground, np.abs(ground[:, 1]) < half, (path,))


def test_a_robot_drives_20_m_and_returns_to_its_path() -> None:
    metrics = drive(FakeRobot(), street(0.003))
    assert metrics["robot_driven_m"] == pytest.approx(20, abs=0.1) and metrics["robot_left_road"] == 0
    assert metrics["robot_off_way_max_m"] < 0.5 and metrics["robot_above_max_m"] < 0.01


def test_a_robot_that_leaves_the_road_is_a_fault() -> None:
    with pytest.raises(Fault) as caught:
        drive(FakeRobot(), street(0.01))
    assert caught.value.metrics["robot_left_road"] > 10


def test_a_robot_that_gets_stuck_is_a_fault() -> None:
    with pytest.raises(Fault, match="didn't drive 20"):
        drive(FakeRobot(slip=0.1), street())


def test_a_ball_that_rests_3_cm_too_low_is_a_fault() -> None:
    reference = street()
    resting = np.array([[1.0, 0.0, drops.BALL_RADIUS_M + 0.005], [2.0, 0.0, drops.BALL_RADIUS_M - 0.005]])
    assert drops.rest_metrics(drops.rest_gaps(resting, reference))["drop_max_m"] == pytest.approx(0.005)
    for z in (drops.BALL_RADIUS_M - 0.03, -50.0):
        with pytest.raises(Fault) as caught:
            drops.rest_metrics(drops.rest_gaps(np.array([[1.0, 0.0, z]]), reference))
        assert caught.value.metrics["fell_through"] == (z < -1)


def test_an_image_from_another_position_than_the_photo_is_a_fault(tmp_path: Path) -> None:
    scene = np.random.default_rng(0).integers(0, 255, (60, 80, 3)).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    photo = Photo(scene[:, 20:-20], Camera("pinhole", 600, 480, 300, 300, 299.5, 239.5), np.eye(4))
    export = tmp_path / "exports" / "synthesized"
    export.mkdir(parents=True)
    compared = np.ones((480, 600), bool)
    good = renderings.compare(export, "synthesized", photo, photo.rgb // 2, compared)
    assert good["picture_off_px"] < 0.1 and good["picture_ssim"] > 0.99  # half as bright, same position
    assert (tmp_path / "pictures" / "synthesized.png").is_file()
    with pytest.raises(Fault) as caught:
        renderings.compare(export, "synthesized", photo, scene[:, 40:], compared)
    assert caught.value.metrics["picture_off_px"] == pytest.approx(20, abs=1)


def floor(z: float) -> Mesh:
    corners = np.array([[-90, -90, z], [90, -90, z], [90, 90, z], [-90, 90, z]], np.float32)
    return Mesh(Frame(), corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def test_ranges_of_a_lidar_that_are_3_cm_off_or_missing_and_absent_intensities_are_faults() -> None:
    origins, directions = rays.rays(street())
    visible = (Visible("terrain", floor(0), reflective=True),)
    true = np.where(directions[:, 2] < 0, rays.LIDAR_HEIGHT_M / np.maximum(-directions[:, 2], 1e-9), np.inf)
    true[np.abs(origins + np.where(np.isfinite(true), true, 0)[:, None] * directions)[:, :2].max(axis=1) > 90] = np.inf
    retro = np.full(len(true), 100.0)
    good = rays.compare(origins, directions, true + 0.01, retro, visible)
    assert good["lidar_off_median_m"] == pytest.approx(0.01, abs=1e-4) and good["lidar_rays"]["terrain"] > 1000
    with pytest.raises(Fault, match="terrain"):
        rays.compare(origins, directions, true + 0.03, retro, visible)
    with pytest.raises(Fault, match="here or there only"):
        rays.compare(origins, directions, np.where(np.arange(len(true)) % 50, true, np.inf), retro, visible)
    with pytest.raises(Fault, match="intensity"):
        rays.compare(origins, directions, true, 0 * retro, visible)
