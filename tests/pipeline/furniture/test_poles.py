"""Radius and position of posts in sweeps of a passing scanner with pose errors."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, F64, Frame, PointCloud, Trajectory
from scan2sim.pipeline.furniture.classify import Detection, detect_furniture
from scan2sim.pipeline.furniture.poles import Columns

SWEEP_S, SPEED_M_S, AZIMUTH_STEP, RINGS = 0.1, 10.0, np.radians(0.17), np.radians(np.arange(-24, 3, 0.4))
RANGE_NOISE_M, SCANNER_HEIGHT_M = 0.02, 1.7


class Drive:
    """Sweeps past upright cylinders and a wall; every sweep is misplaced by a random error of its pose."""

    def __init__(self, pose_error: float, sweeps: int = 25) -> None:
        self._rng = np.random.default_rng(0)
        self._points: list[F64] = []
        self._times: list[F64] = []
        times: F64 = np.arange(sweeps, dtype=np.float64) * SWEEP_S
        still: F64 = np.zeros(len(times))
        self.path = Trajectory(times, np.column_stack([times * SPEED_M_S - 12, still, still]))
        self._errors = self._rng.normal(0, pose_error, (len(times), 2))

    def add(self, directions: F64, ranges: F64, low: float, high: float, sweep: int) -> None:
        """Returns (N,) at horizontal `ranges` in `directions` (N,), where the beams are between two heights."""
        d, r = np.repeat(directions, len(RINGS)), np.repeat(ranges, len(RINGS))
        z = SCANNER_HEIGHT_M + r * np.tile(np.tan(RINGS), len(directions))
        ok = np.isfinite(r) & (z > low) & (z < high)
        r = r[ok] + self._rng.normal(0, RANGE_NOISE_M, ok.sum())
        at = self.path.positions[sweep, :2] + self._errors[sweep]
        self._points.append(np.column_stack([at + r[:, None] * np.column_stack([np.cos(d[ok]), np.sin(d[ok])]), z[ok]]))
        self._times.append(np.full(ok.sum(), self.path.times[sweep]))

    def post(self, x: float, y: float, radius: float, height: float) -> None:
        """A cylinder on the ground."""
        for k, scanner in enumerate(self.path.positions[:, :2]):
            dx, dy = np.array([x, y]) - scanner
            far, towards = np.hypot(dx, dy), np.arctan2(dy, dx)
            a = np.arange(np.ceil((towards - 0.2) / AZIMUTH_STEP), (towards + 0.2) / AZIMUTH_STEP) * AZIMUTH_STEP
            aside = far * np.sin(a - towards)
            with np.errstate(invalid="ignore"):
                self.add(a, far * np.cos(a - towards) - np.sqrt(radius**2 - aside**2), 0.05, height, k)

    def wall(self, first: tuple[float, float], last: tuple[float, float], height: float = 3.0) -> None:
        """An upright rectangle between two points."""
        a, b = np.array(first), np.array(last)
        for k, scanner in enumerate(self.path.positions[:, :2]):
            ends = [np.arctan2(*(p - scanner)[::-1]) for p in (a, b)]
            d = np.arange(np.ceil(min(ends) / AZIMUTH_STEP), max(ends) / AZIMUTH_STEP) * AZIMUTH_STEP
            way, along = np.stack([np.cos(d), np.sin(d)]), b - a
            start = a - scanner
            ranges = (start[0] * along[1] - start[1] * along[0]) / (way[0] * along[1] - way[1] * along[0])
            self.add(d, ranges, 0.05, height, k)

    def detect(self, code: str = "building", timed: bool = True) -> list[Detection]:
        """Furniture in all points, which have one class."""
        xyz: F32 = np.concatenate(self._points).astype(np.float32)
        order = np.argsort(np.concatenate(self._times), kind="stable")
        time = np.concatenate(self._times)[order] if timed else None
        classes = np.full(len(xyz), CODE[code], np.uint8)
        cloud = PointCloud(Frame(), xyz[order], classification=classes, time=time)
        cloud = cloud.take(np.flatnonzero(cloud.xyz[:, 2] > 0.2))
        return detect_furniture(cloud, Columns(cloud.xyz), cloud.xyz[:, 2], self.path)


@pytest.mark.parametrize("radius, height", [(0.03, 2.8), (0.07, 6.0), (0.2, 4.0), (0.05, 1.0), (0.1, 1.1)])
@pytest.mark.parametrize("pose_error", [0.0, 0.05])
def test_posts_have_their_true_radius_and_position(radius: float, height: float, pose_error: float) -> None:
    drive = Drive(pose_error)
    drive.post(0.0, 6.0, radius, height)
    drive.wall((-8.0, 9.0), (8.0, 9.0))
    (post,) = drive.detect()
    assert post.stem.radius == pytest.approx(np.full(len(post.stem.radius), radius), abs=0.02)
    assert post.foot[:2] == pytest.approx([0, 6], abs=0.02 + pose_error / 2)
    assert post.height == pytest.approx(min(height, 2.4), abs=0.25)  # beams rise by 3 degrees


def test_trunks_are_detected_in_spite_of_the_class_vehicle() -> None:
    drive = Drive(0.02)
    drive.post(0.0, 6.0, 0.15, 5.0)
    (trunk,) = drive.detect("vehicle")
    assert trunk.stem.thickness == pytest.approx(0.15, abs=0.02)


def test_low_parts_of_vehicles_and_pickets_are_not_posts() -> None:
    drive = Drive(0.0)
    drive.post(0.0, 6.0, 0.05, 1.0)
    assert len(drive.detect()) == 1 and not drive.detect("vehicle")
    fence = Drive(0.0)
    for x in np.arange(-2, 2, 0.3):
        fence.post(float(x), 6.0, 0.04, 1.0)
    assert not fence.detect()


def test_strip_of_a_wall_is_not_a_post() -> None:
    drive = Drive(0.0, sweeps=10)  # seen from one side only, as between two parked cars
    drive.wall((0.0, 6.0), (0.0, 6.3))
    assert not drive.detect()


def test_radius_without_timestamps_is_fitted_to_circles() -> None:
    drive = Drive(0.0)
    drive.post(0.0, 6.0, 0.1, 4.0)
    (post,) = drive.detect(timed=False)
    assert post.stem.thickness == pytest.approx(0.1, abs=0.02)
