"""Sightings of points: in how many sweeps rays ended at a point, and in how many they passed it.

A static object is seen by every sweep in which nothing hides it. An object that came or left was seen by a few sweeps,
and rays of others passed its place. Unlike the voxels of `pipeline.dynamic_objects.free_space`, this needs no
minimum number of sweeps, and works at any range, since neighbouring rays are compared by their angle: an object that
only the last two sweeps saw is contradicted by all earlier ones. After Removert (Kim and Kim, "Remove, then revert",
IROS 2020), which compares range images.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Trajectory
from scan2sim.pipeline.lidar.sweeps import sweep_numbers

RAYS, MAX_ANGLE_RAD = 4, np.radians(0.6)
"""Number of rays nearest to a point that are compared with it, and their largest angle from it."""
MIN_PASSING_RAYS = 2
"""Least number of rays that pass a point; fewer could miss a narrow one."""
SEEN_M, PASSED_M = 0.3, 0.5
"""A ray that ends within the first distance of a point sees it; one that ends farther than the second beyond passed."""
AZIMUTH_BINS, AIM_ITERATIONS = 180, 3
"""Bins of azimuth whose time of scanning is known, and iterations in which the time of aiming at a point converges."""


def sightings(xyz: F32, returns: F32, times: F64, path: Trajectory) -> tuple[I64, I64]:
    """Numbers (N,) of sweeps that saw each point, and of sweeps all of whose rays near it passed.

    Args:
        xyz: (N, 3) points, local metres.
        returns: (M, 3) all returns, those of moving objects, too.
        times: (M,) seconds, of the returns.
        path: path of the scanner, with times.
    """
    from scipy.spatial import cKDTree

    known = np.isfinite(path.times)
    at, positions = path.times[known], path.positions[known]
    seen, passed = np.zeros(len(xyz), np.int64), np.zeros(len(xyz), np.int64)
    if not len(xyz) or not len(returns) or len(at) < 2:
        return seen, passed
    number = sweep_numbers(times, at)
    order = np.argsort(number, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(number[order])) + 1):
        origin = _interpolate(times[own], at, positions)
        directions, distance = _directions(returns[own] - origin)
        scanned_at = _time_of_azimuth(directions, times[own])
        when = np.full(len(xyz), np.median(times[own]))
        for _ in range(AIM_ITERATIONS):
            aim, to_point = _directions(xyz - _interpolate(when, at, positions))
            when = scanned_at[_azimuth_bin(aim)]
        tree = cKDTree(directions, balanced_tree=False, compact_nodes=False)
        near, ray = tree.query(aim, k=RAYS, distance_upper_bound=MAX_ANGLE_RAD, workers=-1)
        near = np.isfinite(near)
        beyond = distance[np.where(near, ray, 0)] - to_point[:, None]
        seen += (near & (np.abs(beyond) < SEEN_M)).any(axis=1)
        passed += (near.sum(axis=1) >= MIN_PASSING_RAYS) & (~near | (beyond > PASSED_M)).all(axis=1)
    return seen, passed


def _interpolate(times: F64, at: F64, positions: F64) -> F64:
    return np.stack([np.interp(times, at, positions[:, k]) for k in range(3)], axis=1)


def _directions(offsets: F64) -> tuple[F64, F64]:
    """Unit vectors (N, 3), and lengths (N,)."""
    length = np.linalg.norm(offsets, axis=1)
    return offsets / np.maximum(length, 1e-6)[:, None], length


def _azimuth_bin(directions: F64) -> I64:
    turn = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) + 0.5
    return np.minimum((turn * AZIMUTH_BINS).astype(np.int64), AZIMUTH_BINS - 1)


def _time_of_azimuth(directions: F64, times: F64) -> F64:
    """Mean time (`AZIMUTH_BINS`,) of a sweep's rays by their azimuth; the median of all where there are none."""
    bins = _azimuth_bin(directions)
    count = np.bincount(bins, minlength=AZIMUTH_BINS)
    start = times[0]  # times are large numbers: sums of differences are exact
    mean = np.bincount(bins, times - start, AZIMUTH_BINS) / np.maximum(count, 1)
    return start + np.where(count > 0, mean, np.median(times) - start)
