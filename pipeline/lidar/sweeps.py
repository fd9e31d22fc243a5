"""Sweeps of a scanner in a cloud: which return belongs to which turn, and from where it was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools, PointCloud, Trajectory

SCAN_WINDOW_S = 0.1
"""Duration of one turn of most spinning scanners."""
MAX_PATH_GAP_S = 1.0
"""Longest gap in the path (or three times the median interval) over which the position is interpolated."""
AIRBORNE_RANGE_M = 60.0
"""Median range from which a scanner is airborne: its rays don't cross a location from several sides."""
MIN_RETURNS_PER_SWEEP = 1000
"""Mean number of returns with the same time from which each distinct time is a sweep (of a cloud that was not deskewed,
or whose data set is motion-compensated)."""
POSE_INTERVAL_MIN_S, POSE_INTERVAL_MAX_S = 0.08, 0.25
"""Median interval of the path within which it has one pose per sweep (12 to 4 turns per second)."""
COVERED_RADIUS_M = 0.22
"""Size of the voxels in which points of other sweeps are searched near a held-out return."""
COVERAGE_SAMPLES = 20_000
"""Held-out returns whose neighbourhood is checked."""
MOVING_RADIUS_M = 0.3
"""Distance to a point that moved, in the same sweep, within which a return is of the same object."""


@dataclass(frozen=True)
class Sweeps:
    """Returns of some of a scanner's sweeps, in local coordinates.

    Attributes:
        xyz: (N, 3) returns, metres.
        origins: (N, 3) position of the scanner when each was measured, metres.
        number: (N,) index of the sweep in the cloud, ascending in time.
        scanned: (N, 3) returns in the scanner's axes (x forward, y left, z up), metres.
        time: (N,) seconds.
    """

    xyz: F32
    origins: F64
    number: I32
    scanned: F32
    time: F64

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, index: I64 | Bools) -> Sweeps:
        """The returns that `index` selects."""
        return Sweeps(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    @staticmethod
    def join(parts: Sequence[Sweeps]) -> Sweeps:
        """The returns of all parts, of which there is at least one."""
        return Sweeps(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Sweeps)})

    def save(self, path: Path) -> None:
        """Write as .npz."""
        np.savez(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Sweeps:
        """Read what `save` wrote."""
        with np.load(path) as data:
            return cls(**{f.name: data[f.name] for f in fields(cls)})


def scanner_origins(cloud: PointCloud, path: Trajectory) -> tuple[F64, str]:
    """Scanner positions (N, 3) at each point's time, NaN where unknown; and the reason if rays can't be used, or ""."""
    if cloud.time is None:
        return np.zeros((0, 3)), "the points have no times"
    known = np.isfinite(path.times)
    times, positions = path.times[known], path.positions[known]
    if len(times) < 2:
        return np.zeros((0, 3)), "the path has no times"
    origins = np.stack([np.interp(cloud.time, times, positions[:, k]) for k in range(3)], axis=1)
    after = np.clip(np.searchsorted(times, cloud.time), 1, len(times) - 1)
    span = np.diff(times)
    max_gap = max(MAX_PATH_GAP_S, 3 * float(np.median(span)))
    unknown = span[after - 1] > max_gap
    unknown &= np.minimum(np.abs(cloud.time - times[after - 1]), np.abs(times[after] - cloud.time)) > SCAN_WINDOW_S
    unknown |= (cloud.time < times[0] - SCAN_WINDOW_S) | (cloud.time > times[-1] + SCAN_WINDOW_S)
    origins[unknown] = np.nan
    if unknown.all():
        return origins, "path and points don't overlap in time"
    sample = slice(None, None, max(1, len(cloud) // 100_000))
    ranges = np.linalg.norm(cloud.xyz[sample] - origins[sample], axis=1)
    if np.nanmedian(ranges) > AIRBORNE_RANGE_M:
        return origins, f"the scanner is airborne: points are {np.nanmedian(ranges):.0f} m away"
    return origins, ""


def sweep_numbers(times: F64, path_times: F64) -> I64:
    """Index of each point's sweep (N,), consecutive from 0 in order of time.

    Points of a sweep share one time, or lie around the time of one pose of the path; otherwise sweeps are windows of
    `SCAN_WINDOW_S`.

    Args:
        times: (N,) seconds, of the points.
        path_times: (T,) seconds, ascending, of the poses.
    """
    distinct, own = np.unique(times, return_inverse=True)
    if len(distinct) * MIN_RETURNS_PER_SWEEP <= len(times):
        return own.astype(np.int64)
    interval = float(np.median(np.diff(path_times))) if len(path_times) > 1 else 0.0
    if POSE_INTERVAL_MIN_S <= interval <= POSE_INTERVAL_MAX_S:
        window = np.searchsorted((path_times[1:] + path_times[:-1]) / 2, distinct)
    else:
        window = np.floor((distinct - distinct[0]) / SCAN_WINDOW_S).astype(np.int64)
    return np.unique(window, return_inverse=True)[1].astype(np.int64)[own]


def every_nth(count: int, every: int) -> I64:
    """Indices of every Nth of `count` sweeps, from the middle of the first N on; the middle one if there are fewer."""
    return np.arange(count)[min(every // 2, (count - 1) // 2) :: every]


def upright_axes(offsets: F64, path: Trajectory, times: F64) -> F32:
    """Offsets (N, 3) from the scanner to its returns in axes that are level and point in the direction of travel.

    Paths have no rotations. Where the scanner is stationary, x of the local axes is forward.

    Args:
        offsets: (N, 3) local axes, metres.
        path: path of the scanner.
        times: (N,) seconds, of the returns.
    """
    known = np.isfinite(path.times)
    at, positions = path.times[known], path.positions[known]
    ahead, behind = (
        np.stack([np.interp(times + shift, at, positions[:, k]) for k in (0, 1)], axis=1)
        for shift in (SCAN_WINDOW_S, -SCAN_WINDOW_S)
    )
    way = ahead - behind
    heading = np.arctan2(way[:, 1], way[:, 0])
    cos, sin = np.cos(heading), np.sin(heading)
    x, y, z = offsets.T
    return np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1).astype(np.float32)


def moving_returns(sweeps: Sweeps, moving: PointCloud) -> Sweeps:
    """Points of moving objects (with times), as returns of those of the sweeps in whose time they were measured."""
    parts = []
    for number in np.unique(sweeps.number):
        own = np.flatnonzero(sweeps.number == number)
        own = own[np.argsort(sweeps.time[own], kind="stable")]
        if moving.time is None:
            break
        there = np.flatnonzero((moving.time >= sweeps.time[own[0]]) & (moving.time <= sweeps.time[own[-1]]))
        time, xyz = moving.time[there], moving.xyz[there]
        origins = sweeps.origins[own[np.searchsorted(sweeps.time[own], time)]]
        numbers = np.full(len(there), number, np.int32)
        parts.append(Sweeps(xyz, origins, numbers, (xyz - origins).astype(np.float32), time))
    return Sweeps.join(parts) if parts else sweeps.take(np.zeros(0, np.int64))


def near_moving(sweeps: Sweeps, moving: Sweeps, radius: float = MOVING_RADIUS_M) -> Bools:
    """(N,) whether returns lie within `radius` (m) of one of `moving` of their sweep."""
    from scipy.spatial import cKDTree

    near = np.zeros(len(sweeps), bool)
    for number in np.unique(moving.number):
        own = np.flatnonzero(sweeps.number == number)
        tree = cKDTree(moving.xyz[moving.number == number])
        distance, _ = tree.query(sweeps.xyz[own], distance_upper_bound=radius, workers=-1)
        near[own] = np.isfinite(distance)
    return near


def covered_share(held_out: F32, others: F32) -> float:
    """Share of the held-out returns (N, 3) with a point of the other sweeps (M, 3) in their voxel or next to it."""
    sample = held_out[:: max(1, len(held_out) // COVERAGE_SAMPLES)]
    if not len(sample) or not len(others):
        return 0.0
    low = np.minimum(sample.min(axis=0), others.min(axis=0)) - 2 * COVERED_RADIUS_M
    taken, own = (((xyz - low) / COVERED_RADIUS_M).astype(np.int64) for xyz in (others, sample))
    codes = np.unique(_code(taken))
    found = np.zeros(len(own), bool)
    for shift in np.ndindex(3, 3, 3):
        found |= np.isin(_code(own + np.array(shift) - 1), codes)
    return float(found.mean())


def _code(voxel: I64) -> I64:
    return np.asarray((voxel[:, 0] << 42) | (voxel[:, 1] << 21) | voxel[:, 2], np.int64)
