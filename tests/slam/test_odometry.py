"""Visual odometry on simulated drives: accuracy, GPS, tracking loss, moving objects."""

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.trajectory.align import aligned_trajectory
from tests.fakes.slam_drive import LENS, Follower, PerspectiveFollower, drive, gps_of, run, scatter
from tests.present import present
from tests.slam.conftest import Drive


def positions(odometry: Odometry) -> F64:
    return np.stack([odometry.pose_of(p)[:3, 3] for p in odometry.placed])


def error(found: F64, poses: F64, which: slice | npt.NDArray[np.bool_] = slice(None)) -> float:
    """Root mean square error in metres after alignment by a similarity."""
    truth = poses[which, :3, 3]
    off = umeyama(found[which], truth, scaled=True).apply(found[which]) - truth
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def test_path_is_accurate_up_to_scale_and_constant_while_standing() -> None:
    times, poses = drive(20)
    odometry = run(times, Follower(poses, scatter(poses)))
    found = positions(odometry)
    assert len(found) == len(times)
    assert error(found, poses) < 0.15  # of 180 m
    assert np.linalg.norm(found[5] - found[0]) < 1e-6
    assert not any(p.unsure for p in odometry.placed)


def test_trajectory_starts_where_the_car_stood_before_driving(corridor: Drive) -> None:
    still, first = 20, corridor.greys[0]
    odometry = Odometry(corridor.camera, OdometryParams(count=400))
    for frame, grey in enumerate([*[first] * still, *corridor.greys[1:]]):
        odometry.add(frame / 10, grey)
    found = positions(odometry)
    truth = np.concatenate([np.repeat(corridor.truth.positions[:1], still, axis=0), corridor.truth.positions[1:]])
    off = np.linalg.norm(umeyama(found, truth, scaled=True).apply(found) - truth, axis=1)
    assert np.ptp(found[:still], axis=0).max() < 0.01
    assert off.max() < 0.1  # of 21 m


def test_brightness_changes_increase_the_error_by_at_most_a_fifth(corridor: Drive) -> None:
    every = np.ones(len(corridor.greys))
    flickers, falls = every.copy(), every.copy()
    flickers[2::2], falls[10:] = 0.45, 0.35
    off = []
    for light in (every, flickers, falls):
        odometry = Odometry(corridor.camera, OdometryParams(count=400))
        for frame, grey in enumerate(corridor.greys * light[:, None, None]):
            odometry.add(frame / 10, grey.astype(np.uint8))
        off.append(error(positions(odometry), corridor.truth.poses))
        assert odometry.map.part == 0 and not any(p.unsure for p in odometry.placed)
    assert max(off) < 1.2 * off[0]


def test_odometry_works_with_a_perspective_camera() -> None:
    times, poses = drive(10)
    odometry = run(times, PerspectiveFollower(poses, scatter(poses, 20000)), parallax=1.0)
    assert error(positions(odometry), poses) < 0.6


def test_gps_determines_scale_and_position_of_the_path() -> None:
    times, poses = drive(30)
    gps = gps_of(times, poses, sigma=0.5)
    trajectory, _ = aligned_trajectory(MapCheckpoint.of(run(times, Follower(poses, scatter(poses)), gps=gps), ()), gps)
    off = np.linalg.norm((trajectory.positions - poses[:, :3, 3])[:, :2], axis=1)
    assert off.mean() < 1.0
    length = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum()
    assert length == pytest.approx(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum(), rel=0.02)
    up = present(trajectory.rotations)[:, 2, 1]
    assert (up < -0.99).all()


def test_path_is_accurate_with_adjacent_gps_distances() -> None:
    times, poses = drive(15)
    gps = gps_of(times, poses, sigma=0.3)
    odometry = run(times, Follower(poses, scatter(poses)), gps=gps, gps_distances="adjacent")
    assert error(positions(odometry), poses) < 1.0


@pytest.mark.parametrize("seconds", [0.3, 2.0])
def test_black_frames_are_dead_reckoned_and_marked_unsure(seconds: float) -> None:
    times, poses = drive(20)
    gps = gps_of(times, poses, sigma=0.2)
    said: list[str] = []

    def black(frame: int, points: F64) -> npt.NDArray[np.bool_]:
        return np.full(len(points), 10 <= times[frame] < 10 + seconds)

    odometry = run(times, Follower(poses, scatter(poses), hide=black), gps=gps, warn=said.append)
    trajectory, _ = aligned_trajectory(MapCheckpoint.of(odometry, ()), gps)
    off = np.linalg.norm(trajectory.positions - poses[:, :3, 3], axis=1)
    dark = (times >= 10) & (times < 10 + seconds)
    unsure = present(trajectory.unsure)
    assert unsure[dark].all() and not unsure[times < 9.9].any()
    assert not unsure[-1] and any("lost" in text for text in said)
    assert off.max() < 8
    step = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    assert step.max() < 4
    sigma = np.sqrt(np.trace(present(trajectory.covariance)[:, :3, :3], axis1=1, axis2=2))
    before = sigma[np.searchsorted(times, 9.5)]
    assert sigma[dark].max() > before + 0.2 * 10 * seconds and (sigma > 0).all()
    assert seconds < 1 or sigma[-1] > before + 0.3


def test_gps_rejects_poses_that_follow_a_bus_covering_the_view() -> None:
    times, poses = drive(20)
    gps = gps_of(times, poses, sigma=0.2)
    said: list[str] = []
    covered = (times >= 10) & (times < 14)
    carried = 0.95 * (poses[:, :3, 3] - poses[times >= 10][0, :3, 3]) * covered[:, None]

    class Beside(Follower):
        """For four seconds, all visible points move slightly slower than the car: a bus that is overtaken."""

        def _seen(self, points: F64) -> tuple[F64, npt.NDArray[np.bool_]]:
            return super()._seen(points + carried[self._frame])

    odometry = run(times, Beside(poses, scatter(poses)), gps=gps, warn=said.append)
    trajectory, _ = aligned_trajectory(MapCheckpoint.of(odometry, ()), gps)
    off = np.linalg.norm(trajectory.positions - poses[:, :3, 3], axis=1)
    assert "lost" in said[0] and 10 < float(said[0].split()[0]) < 12
    loss = odometry.losses[0]
    assert "where GPS measured" in loss.failure.what and loss.failure.measured < present(loss.failure.needed)
    assert loss.frame == round(10 * loss.time) and present(loss.resumed) > loss.time
    unsure = present(trajectory.unsure)
    assert unsure[(times >= 12) & (times < 14)].all() and not unsure[-1]
    assert off.max() < 20  # of the 36 m without a view


def test_path_is_accurate_in_spite_of_moving_cars() -> None:
    times, poses = drive(15)
    rng, still = np.random.default_rng(3), scatter(poses)
    kinds = {tuple(p): i for i, p in enumerate(still)}
    moving = rng.random(6000) < 0.35
    speed = rng.uniform(3, 12, (6000, 1)) * np.array([1.0, 0.2, 0.0])

    class Traffic(Follower):
        def _seen(self, points: F64) -> tuple[F64, npt.NDArray[np.bool_]]:
            at = points
            if len(points):
                kind = np.array([kinds[tuple(p)] for p in points])
                at = points + np.where(moving[kind][:, None], speed[kind] * times[self._frame], 0)
            return super()._seen(at)

    assert error(positions(run(times, Traffic(poses, still))), poses) < 0.6


def test_marginalized_points_are_stored_only_with_keep() -> None:
    times, poses = drive(25)
    odometry = run(times, Follower(poses, scatter(poses)), window=5, fixed_keyframes=2)
    held = [len(k.ids) > 0 for k in odometry.map.keyframes]
    assert len(held) > 12 and sum(held) <= 8 and not odometry.map.retired


def test_perspective_map_initializes_when_driving_straight_with_large_parallax() -> None:
    times, poses = drive(5, turn=0.0)
    tracker = PerspectiveFollower(poses, scatter(poses, 8000), noise=np.radians(0.01))
    odometry = Odometry(LENS, OdometryParams(parallax=20.0), tracker=tracker)
    for time in times:
        odometry.add(float(time), np.zeros((4, 8), np.uint8))
    assert odometry.map.part == 0 and len(odometry.map.keyframes) > 1
    assert odometry.map.keyframes[1].time < 2.5
