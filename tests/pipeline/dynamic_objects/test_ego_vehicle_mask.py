"""Ego-vehicle mask: points around a path, against the volume that a car or a person of known size sweeps."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, F64, Bools, Trajectory
from scan2sim.pipeline.dynamic_objects.ego_vehicle_mask import (
    CAR_ABOVE_M,
    CAR_AHEAD_M,
    CAR_BEHIND_M,
    CAR_HALF_WIDTH_M,
    GROUND_CLEARANCE_M,
    PERSON_HALF_WIDTH_M,
    in_swept_volume,
    near_cameras,
    swept_volume,
)

LENGTH, SCANNER_HEIGHT = 12.0, 1.8
"""Length of a straight path from the origin, and height of the scanner above the ground, metres."""


def axes(heading: float, slope: float = 0.0) -> F64:
    """Matrix (3, 3) from (along, across, above the ground) to local coordinates, on a sloping road."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0], [s, c, 0], [slope, 0, 1.0]])


def path(heading: float, speed: float = 10.0, slope: float = 0.0) -> Trajectory:
    along = np.linspace(0, LENGTH, 25)
    flat = np.column_stack([along, np.zeros(25), np.full(25, SCANNER_HEIGHT)])
    return Trajectory(along / speed, flat @ axes(heading, slope).T)


def around(count: int = 60_000, seed: int = 0) -> F64:
    """Points (N, 3) along, across and above a path; the first half is the ground, with 2 cm of noise."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-6, -3, 0), (LENGTH + 6, 3, 4), (count, 3))
    xyz[: count // 2, 2] = rng.normal(0, 0.02, count // 2)
    return xyz


def swept(points: F64, half_width: float, margin: float = 0.0) -> Bools:
    """(N,) bool, True for points inside the volume of the straight path, reduced by a margin on all sides."""
    along, across, above = points.T
    beyond = np.maximum(np.maximum(-CAR_BEHIND_M - along, along - LENGTH - CAR_AHEAD_M), 0)
    high = (above > GROUND_CLEARANCE_M + margin) & (above < SCANNER_HEIGHT + CAR_ABOVE_M - margin)
    return np.asarray(high & (np.hypot(across, beyond) < half_width - margin))


@pytest.mark.parametrize("heading", [0.0, 0.6, -2.3])
@pytest.mark.parametrize(("speed", "half_width"), [(10.0, CAR_HALF_WIDTH_M)])
def test_swept_volume_of_a_car_excludes_road_and_surroundings(heading: float, speed: float, half_width: float) -> None:
    points = around()
    xyz = (points @ axes(heading).T).astype(np.float32)
    volume = swept_volume(xyz, path(heading, speed))
    inside = in_swept_volume(xyz, volume)
    assert volume.half_width == half_width
    assert volume.ground == pytest.approx(0, abs=0.06)
    assert inside[swept(points, half_width, 0.08)].all(), "part of the vehicle is left"
    assert not inside[~swept(points, half_width, -0.08)].any(), "part of the surroundings is removed"
    assert not inside[:30_000].any(), "part of the road is removed"


def test_ground_of_the_swept_volume_follows_a_sloping_path() -> None:
    points = around()
    xyz = (points @ axes(0.3, 0.12).T).astype(np.float32)
    volume = swept_volume(xyz, path(0.3, slope=0.12))
    inside = in_swept_volume(xyz, volume)
    assert volume.ground == pytest.approx(volume.positions[:, 2] - SCANNER_HEIGHT, abs=0.12)
    assert not inside[:30_000].any() and inside[swept(points, CAR_HALF_WIDTH_M, 0.25)].all()


def test_no_points_are_in_the_volume_in_gaps_of_the_path() -> None:
    """For example in a tunnel without poses, where the path is unknown."""
    way = path(0.0)
    shift = np.array([40.0, 0, 0])
    times = np.concatenate([way.times, way.times + 5])
    both = Trajectory(times, np.concatenate([way.positions, way.positions + shift]))
    points = np.concatenate([around(), around() + shift, around() + shift / 2])
    xyz = points.astype(np.float32)
    inside = in_swept_volume(xyz, swept_volume(xyz, both))
    gap = (points[:, 0] > LENGTH + CAR_AHEAD_M + 1.1) & (points[:, 0] < 40 - CAR_BEHIND_M - 1.1)
    assert gap.sum() > 1000 and not inside[gap].any()
    parts = swept(points, CAR_HALF_WIDTH_M, 0.08) | swept(points - shift, CAR_HALF_WIDTH_M, 0.08)
    assert inside[parts].all()


def test_no_points_are_in_the_volume_without_ground_below() -> None:
    xyz = (around() + (0, 0, 50)).astype(np.float32)
    volume = swept_volume(xyz, path(0.0))
    assert np.isnan(volume.ground).all() and not in_swept_volume(xyz, volume).any()


def test_static_scanner_has_the_volume_of_a_person() -> None:
    xyz = (around() - (LENGTH / 2, 0, 0)).astype(np.float32)
    for times in ([0.0], [0.0, 1.0, 2.0]):
        still = Trajectory(np.array(times), np.tile([0.0, 0.0, SCANNER_HEIGHT], (len(times), 1)))
        volume = swept_volume(xyz, still)
        inside = in_swept_volume(xyz, volume)
        away = np.hypot(xyz[:, 0], xyz[:, 1])
        assert volume.half_width == PERSON_HALF_WIDTH_M and np.isfinite(volume.ground).all()
        assert inside.any() and away[inside].max() < PERSON_HALF_WIDTH_M
        assert inside[(away < PERSON_HALF_WIDTH_M) & (xyz[:, 2] > 0.4) & (xyz[:, 2] < 2.0)].all()


def test_points_near_cameras_equal_exhaustive_search() -> None:
    rng = np.random.default_rng(2)
    cameras = rng.uniform((0, -2, 1), (12, 2, 3), (15, 3))
    xyz = around(20_000).astype(np.float32)
    expected = (np.linalg.norm(xyz[:, None] - cameras, axis=2) < 0.9).any(axis=1)
    assert expected.any()
    np.testing.assert_array_equal(near_cameras(xyz, cameras, 0.9, None), expected)
    low = np.array([[3.0, 0.0, 0.4]])
    volume = swept_volume(xyz, path(0.0))
    near = near_cameras(xyz, low, 1.0, volume)
    above = np.linalg.norm(xyz - low, axis=1) < 1.0
    assert near[above & (xyz[:, 2] > 0.35)].all() and not near[~above].any()
    assert above[:10_000].any() and not near[:10_000].any(), "the road below a low camera is removed"


@pytest.mark.parametrize("xyz", [np.zeros((0, 3), np.float32), np.array([[1, 0.1, 1]], np.float32)])
def test_empty_cloud_and_single_point_are_accepted(xyz: F32) -> None:
    volume = swept_volume(xyz, path(0.0))
    assert in_swept_volume(xyz, volume).tolist() == [False] * len(xyz)
    cameras = np.array([[1.0, 0.0, 1.0]])
    assert near_cameras(xyz, cameras, 0.5, None).tolist() == [True] * len(xyz)
    assert near_cameras(xyz, np.zeros((0, 3)), 0.5, None).tolist() == [False] * len(xyz)
    assert near_cameras(xyz, cameras, 0.0, None).tolist() == [False] * len(xyz)
