"""Lidar score: analytic scenes with known ranges, a simple reference for distances, and sweeps found in clouds."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64, Frame, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.lidar.casting import Scanner
from scan2sim.pipeline.lidar.range_errors import by_distance, by_surface, row
from scan2sim.pipeline.lidar.range_image import COLUMNS, ROWS, compare_points, pixels, range_image
from scan2sim.pipeline.lidar.score import score
from scan2sim.pipeline.lidar.sweeps import (
    Sweeps,
    covered_share,
    every_nth,
    scanner_origins,
    sweep_numbers,
    upright_axes,
)

HEIGHT = 2.0


def rectangle(a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]) -> Mesh:
    """A rectangle with the corners a, b and c in order."""
    corners = np.array([a, b, c, np.add(np.subtract(a, b), c)], np.float32)
    return Mesh(Frame(), corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def wall(x: float) -> Mesh:
    return rectangle((x, -50, -50), (x, 50, -50), (x, 50, 50))


def ground(z: float = 0.0, half: float = 100.0) -> Mesh:
    return rectangle((-half, -half, z), (half, -half, z), (half, half, z))


def fan() -> F64:
    """Unit vectors (N, 3) that look down on the ground all around, from 4 to 24 degrees below the horizon."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 2.0)), np.radians(-np.arange(4, 25, 1.0)))
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)


def ground_returns() -> tuple[F64, F64]:
    """Origins and returns (N, 3) of a scanner `HEIGHT` above level ground at z = 0."""
    way = fan()
    origins = np.tile([0.0, 0.0, HEIGHT], (len(way), 1))
    return origins, origins + way * (HEIGHT / -way[:, 2])[:, None]


def sweeps_of(origins: F64, returns: F64, number: int = 0) -> Sweeps:
    offsets = (returns - origins).astype(np.float32)
    return Sweeps(
        returns.astype(np.float32), origins, np.full(len(returns), number, np.int32), offsets, np.zeros(len(returns))
    )


def test_correct_world_has_no_error() -> None:
    origins, returns = ground_returns()
    rays = Scanner.of([ground()]).scan(origins, returns)
    assert np.allclose(rays.range, HEIGHT / -fan()[:, 2], rtol=1e-5) and (rays.surface == 0).all()
    found = row(rays)
    assert found["median_m"] < 1e-3 and found["early_20cm"] == found["late_50cm"] == found["missing"] == 0
    assert found["near_surface"] == 1 and found["rays"] == len(returns)


@pytest.mark.parametrize("shift", [-0.6, -0.3, 0.1, 0.7])
def test_error_of_a_shifted_wall_is_the_shift(shift: float) -> None:
    origins = np.zeros((100, 3))
    returns = np.column_stack([np.full(100, 10.0), np.zeros(100), np.zeros(100)])
    found = row(Scanner.of([wall(10 + shift)]).scan(origins, returns))
    assert found["median_m"] == pytest.approx(abs(shift), abs=1e-4) == found["p90_m"]
    assert found["early_20cm"] == (shift < -0.2) and found["early_50cm"] == (shift < -0.5)
    assert found["late_50cm"] == (shift > 0.5) and found["near_surface"] == (abs(shift) < 0.22)


def test_errors_count_for_the_surface_hit_and_misses_for_the_recorded_one() -> None:
    """A hedge 1 m in front of half of a wall 10 m away; a tenth of the returns lie beyond the end of the wall."""
    y = np.linspace(-9, 10.999, 200)
    returns = np.column_stack([np.full(200, 10.0), y, np.zeros(200)])
    hedge, house = rectangle((9, -9, -1), (9, 0, -1), (9, 0, 1)), rectangle((10, -9, -1), (10, 9, -1), (10, 9, 1))
    rays = Scanner.of([house, hedge]).scan(np.zeros((200, 3)), returns)
    rows = by_surface(rays, ["building", "vegetation"], np.zeros(200, int))
    assert [rows[name]["rays"] for name in ("vegetation", "building")] == pytest.approx([90, 90], abs=1)
    assert rows["vegetation"]["early_50cm"] == 1 and rows["building"]["early_20cm"] == 0
    assert rows["building"]["median_m"] < 1e-4 and rows["vegetation"]["median_m"] == pytest.approx(1, rel=0.2)
    assert rows["building"]["missing"] == pytest.approx(0.1, abs=0.01) and rows["vegetation"]["missing"] is None
    assert row(rays)["missing"] == rows["building"]["missing"]


def test_rays_are_counted_in_distance_bands() -> None:
    distance = np.array([5.0, 15, 30, 30, 60])
    returns = np.column_stack([distance, np.zeros(5), np.zeros(5)])
    bands = by_distance(Scanner.of([wall(30)]).scan(np.zeros((5, 3)), returns))
    assert [one["rays"] for one in bands.values()] == [1, 1, 2, 1]
    assert [one["near_surface"] for one in bands.values()] == [0, 0, 1, 0]


def test_every_ray_misses_an_empty_world() -> None:
    origins, returns = ground_returns()
    found = score(Scanner.of([]), sweeps_of(origins, returns), [], np.full(len(returns), -1))
    assert found.all["missing"] == 1 and found.all["near_surface"] == 0 and found.all["median_m"] is None
    image = found.range_image()
    assert image["f_score"] == 0 and image["chamfer_m2"] is None
    recorded = np.linalg.norm(returns - origins, axis=1)
    assert image["depth_median_m"] == pytest.approx(np.median(recorded), rel=0.1)


def test_range_image_pixels_follow_the_published_convention() -> None:
    """Reference: the published loop over single points."""
    points = np.random.default_rng(0).normal(0, (20, 20, 3), (500, 3))
    row_, column = pixels(points)
    for (x, y, z), r, c in zip(points, row_, column, strict=True):
        beta, alpha = np.pi - np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)) + 24.9 / 180 * np.pi
        assert c == int(round(beta / (2 * np.pi / 1030))) and r == int(round(66 - alpha / (26.9 / 180 * np.pi / 66)))


def test_range_image_keeps_the_nearest_return_up_to_80_m() -> None:
    points = np.array([[20.0, 0, -1], [10, 0, -0.5], [90, 1, -2], [10, 0, 9]])
    recorded = np.linalg.norm(points, axis=1).astype(np.float32)
    image = range_image(points, recorded, np.full(4, np.inf, np.float32), np.zeros((4, 3)), points)
    assert image.recorded == pytest.approx([recorded[1]]) and image.simulated.tolist() == [0]
    assert image.column.tolist() == [COLUMNS // 2] and image.picture().shape[1] == COLUMNS
    assert image.measures()["depth_rmse_m"] == pytest.approx(recorded[1])


def test_chamfer_distance_and_f_score_equal_exhaustive_search() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.uniform(0, 2, (80, 3)), rng.uniform(0, 2, (50, 3))
    squared = ((a[:, None] - b[None]) ** 2).sum(axis=2)
    precision, recall = (squared.min(axis=0) < 0.05).mean(), (squared.min(axis=1) < 0.05).mean()
    chamfer, f_score = compare_points(a, b)
    assert chamfer == pytest.approx(squared.min(axis=0).mean() + squared.min(axis=1).mean())
    assert f_score == pytest.approx(2 * precision * recall / (precision + recall)) and 0 < f_score < 1


def test_score_of_shifted_ground_is_analytic() -> None:
    """Ground 10 cm too low: the range of each ray is 10 cm / sin(elevation) too long, as is the distance of points."""
    origins, returns = ground_returns()
    sweeps = sweeps_of(origins, returns)
    found = score(Scanner.of([ground(-0.1)]), sweeps, ["terrain"], np.zeros(len(returns), int))
    late = 0.1 / -fan()[:, 2]
    assert found.all["median_m"] == pytest.approx(np.median(late), rel=1e-3)
    image = found.images[0]
    late = 0.1 * image.recorded / HEIGHT
    measured = found.sweeps[0]
    assert measured["depth_rmse_m"] == pytest.approx(np.sqrt((late**2).mean()), rel=1e-3)
    assert measured["depth_median_m"] == pytest.approx(np.median(late), rel=1e-3)
    assert len(image.row) > 0.5 * len(returns) and image.row.max() < ROWS


def test_returns_beyond_80_m_do_not_count() -> None:
    returns = np.array([[79.0, 0, 0], [81, 0, 0]])
    found = score(Scanner.of([]), sweeps_of(np.zeros((2, 3)), returns), [], np.full(2, -1))
    assert found.all["rays"] == 1


def test_sweeps_with_one_time_each_are_numbered() -> None:
    times = np.repeat([7.0, 7.1, 7.2], 2000)
    assert sweep_numbers(times, np.array([7.0, 7.1, 7.2])).tolist() == np.repeat([0, 1, 2], 2000).tolist()


def test_deskewed_sweeps_are_the_points_around_each_pose() -> None:
    poses = np.array([100, 100.104, 100.208, 100.312, 100.416])
    times = np.concatenate([pose + np.linspace(-0.05, 0.05, 50) for pose in poses])
    assert sweep_numbers(times, poses).tolist() == np.repeat(np.arange(5), 50).tolist()


def test_other_clouds_are_cut_into_windows_of_100_ms() -> None:
    """A path of 200 poses per second; there are no sweeps between two passes."""
    times = np.concatenate([np.arange(30), np.arange(6000, 6020)]) / 100 + 0.001
    number = sweep_numbers(times, np.arange(0, 61, 0.005, dtype=np.float64))
    assert np.bincount(number).tolist() == [10, 10, 10, 10, 10]


@pytest.mark.parametrize(("count", "every", "chosen"), [(25, 8, [4, 12, 20]), (3, 8, [1]), (1, 8, [0])])
def test_every_nth_sweep_is_chosen(count: int, every: int, chosen: list[int]) -> None:
    assert every_nth(count, every).tolist() == chosen


def test_covered_share_is_that_of_returns_near_other_sweeps() -> None:
    grid = np.stack(np.meshgrid(np.arange(0, 5, 0.2), np.arange(0, 5, 0.2), [0.0]), axis=-1).reshape(-1, 3)
    others = grid.astype(np.float32)
    assert covered_share(others + np.float32(0.05), others) == 1
    assert covered_share(np.concatenate([others, others + np.float32(30)]), others) == pytest.approx(0.5)


def test_origins_and_upright_axes_follow_the_path() -> None:
    """The scanner drives along y; a return to its left is at +y in its axes."""
    path = Trajectory(np.array([0.0, 1, 2]), np.array([[5.0, 0, 2], [5, 10, 2], [5, 20, 2]]))
    cloud = PointCloud(Frame(), np.array([[0, 5, 2], [5, 25, 2]], np.float32), time=np.array([0.5, 1.5]))
    origins, reason = scanner_origins(cloud, path)
    assert origins.tolist() == [[5, 5, 2], [5, 15, 2]] and not reason
    assert cloud.time is not None
    assert np.allclose(upright_axes(cloud.xyz - origins, path, cloud.time), [[0, 5, 0], [10, 0, 0]], atol=1e-5)
    assert scanner_origins(PointCloud(Frame(), cloud.xyz), path)[1] == "the points have no times"


def test_beam_returns_the_surface_of_its_largest_part() -> None:
    """At 20 m, a beam of 2 mrad is 4 cm wide."""
    origins = np.zeros((3, 3))
    returns = np.array([[20.0, 0, 0]] * 3)
    for top, expected in ((-0.008, 40.0), (0.008, 20.0), (-0.1, 40.0)):
        board = rectangle((20, -5, -5), (20, 5, -5), (20, 5, top))
        beam = Scanner.of([wall(40), board], divergence_rad=0.002).scan(origins, returns)
        assert beam.range == pytest.approx(expected, abs=0.01) and (beam.surface == (expected < 30)).all()
    sky = Scanner.of([rectangle((20, -5, -5), (20, 5, -5), (20, 5, -0.008))], divergence_rad=0.002)
    assert sky.scan(origins, returns).range == pytest.approx(20, abs=0.01)  # a third of the beam hits the only surface
    none = Scanner.of([rectangle((20, -5, -5), (20, 5, -5), (20, 5, -1))], divergence_rad=0.002).scan(origins, returns)
    assert np.isinf(none.range).all() and (none.surface == -1).all()


def test_range_of_a_beam_on_the_ground_is_that_of_its_centre() -> None:
    origins, returns = ground_returns()
    beam = Scanner.of([ground()], divergence_rad=0.002).scan(origins, returns)
    assert np.abs(beam.range - beam.recorded).max() < 0.15 and np.median(np.abs(beam.range - beam.recorded)) < 0.01
