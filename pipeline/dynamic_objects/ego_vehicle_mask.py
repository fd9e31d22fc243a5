"""Ego-vehicle mask: volume that must be empty, because the recording vehicle or a camera was there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools, Trajectory

CAR_HALF_WIDTH_M, CAR_AHEAD_M, CAR_BEHIND_M, CAR_ABOVE_M = 1.0, 2.8, 3.2, 0.3
"""Extent of a car relative to a scanner on its roof: to each side, ahead, behind, above."""
PERSON_HALF_WIDTH_M = 0.3
"""Extent to each side of a person who carries a scanner."""
MAX_WALKING_SPEED_MPS = 2.5
"""A slower platform is a person."""
GROUND_CLEARANCE_M = 0.25
"""Height above the ground below which points are kept: cross fall, kerbs, pose noise."""
GROUND_DEPTH_M = (0.5, 4.0)
"""Range below the scanner in which the ground is searched."""
PATH_STEP_M = 0.25
"""Sampling distance of the path, and size of the lookup cells."""
GROUND_SECTION_M = 2.0
"""Length of path with one height of the ground."""
MAX_POSE_GAP_M = 5.0
"""Largest distance between two poses over which the path is interpolated."""


@dataclass(frozen=True)
class SweptVolume:
    """Volume swept by the ego vehicle.

    Attributes:
        positions: (K, 3) along the path, `PATH_STEP_M` apart; extended beyond its ends by the length of the vehicle.
        half_width: half the width of the vehicle, metres.
        ground: (K,) local z of the ground below; NaN if none was found within `GROUND_DEPTH_M`.
    """

    positions: F64
    half_width: float
    ground: F64


def swept_volume(xyz: F32, path: Trajectory) -> SweptVolume:
    """Volume swept by the vehicle on `path`, with the ground height from points (N, 3)."""
    positions = [np.zeros((0, 3))]
    leg = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    ends = np.append(np.flatnonzero(leg > MAX_POSE_GAP_M), len(path) - 1)
    for first, last in zip(np.append(0, ends[:-1] + 1), ends, strict=True):
        positions.append(_extend(_resample(path.positions[first : last + 1])))
    whole = np.concatenate(positions)
    speed = leg / np.maximum(np.diff(path.times), 1e-6)
    is_car = (
        bool(leg.sum() > 0) and float(np.median(speed[leg > 0.01])) > MAX_WALKING_SPEED_MPS
        if (leg > 0.01).any()
        else False
    )
    return SweptVolume(whole, CAR_HALF_WIDTH_M if is_car else PERSON_HALF_WIDTH_M, _ground(xyz, whole))


def in_swept_volume(xyz: F32, volume: SweptVolume) -> Bools:
    """(N,) bool, True for points inside the swept volume, above the ground."""
    at, index = _lookup_nearest(xyz, volume.positions, volume.half_width)
    out = np.zeros(len(xyz), bool)
    position, ground = volume.positions[at], volume.ground[at]
    p = xyz[index]
    beside = np.linalg.norm(p[:, :2] - position[:, :2], axis=1) < volume.half_width
    out[index] = (
        beside & (p[:, 2] > ground + GROUND_CLEARANCE_M) & (p[:, 2] < position[:, 2] + CAR_ABOVE_M)
    )  # False where the ground is NaN
    return out


def near_cameras(xyz: F32, cameras: F64, radius: float, volume: SweptVolume | None) -> Bools:
    """(N,) bool, True for points within `radius` of a camera (C, 3), and above the ground if that is known."""
    out = np.zeros(len(xyz), bool)
    if not len(cameras) or radius <= 0:
        return out
    from scipy.spatial import cKDTree

    _, index = _lookup_nearest(xyz, cameras, radius)
    z = xyz[index, 2]
    index = index[(z > cameras[:, 2].min() - radius) & (z < cameras[:, 2].max() + radius)]
    distance, _ = cKDTree(cameras).query(xyz[index], distance_upper_bound=radius, workers=-1)
    inside = index[np.isfinite(distance)]
    if volume is not None and len(inside):
        _, below = cKDTree(volume.positions[:, :2]).query(xyz[inside, :2])
        inside = inside[~(xyz[inside, 2] < volume.ground[below] + GROUND_CLEARANCE_M)]
    out[inside] = True
    return out


def _resample(positions: F64) -> F64:
    """Points (K, 3) about `PATH_STEP_M` apart along a polyline."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    stations_m = (
        np.linspace(0, along[-1], max(1, int(np.ceil(along[-1] / PATH_STEP_M))) + 1) if along[-1] > 0 else along[:1]
    )
    return np.stack([np.interp(stations_m, along, positions[:, k]) for k in range(3)], axis=1)


def _extend(positions: F64) -> F64:
    """Extend a path linearly at its ends by the extent of the vehicle ahead of and behind its scanner."""
    back = min(len(positions) - 1, round(2 / PATH_STEP_M))
    if back < 1:
        return positions
    parts = [positions]
    for end, other, length in ((0, back, CAR_BEHIND_M), (-1, -1 - back, CAR_AHEAD_M)):
        heading = positions[end] - positions[other]
        norm = np.linalg.norm(heading)
        if norm > PATH_STEP_M:
            steps = np.arange(PATH_STEP_M, length + PATH_STEP_M / 2, PATH_STEP_M)[:, None]
            parts.append(positions[end] + steps * heading / norm)
    return np.concatenate(parts)


def _lookup_nearest(xyz: F32, positions: F64, radius: float) -> tuple[I64, I64]:
    """Points that may be within `radius` of a position (in plan view): index of the nearest position, and of the point.

    Uses a lookup table with square cells of `PATH_STEP_M`, so that distant points cost almost nothing.
    """
    from scipy.spatial import cKDTree

    if not len(xyz):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    side = int(np.ceil(radius / PATH_STEP_M)) + 1
    offset = np.stack(np.meshgrid(*2 * [np.arange(-side, side + 1)], indexing="ij"), -1).reshape(-1, 2)
    low = xyz[:, :2].min(axis=0).astype(np.float64)
    size = ((xyz[:, :2].max(axis=0) - low) / PATH_STEP_M).astype(np.int64) + 1
    own = np.unique(np.floor((positions[:, :2] - low) / PATH_STEP_M).astype(np.int64), axis=0)
    cells = np.unique((own[:, None] + offset).reshape(-1, 2), axis=0)
    cells = cells[((cells >= 0) & (cells < size)).all(axis=1)]
    lookup = np.full(size, -1, np.int32)
    if len(cells):
        _, nearest = cKDTree(positions[:, :2]).query(low + (cells + 0.5) * PATH_STEP_M)
        lookup[cells[:, 0], cells[:, 1]] = nearest
    cell = ((xyz[:, :2] - low.astype(np.float32)) / PATH_STEP_M).astype(np.int32)
    at = lookup[np.minimum(cell[:, 0], size[0] - 1), np.minimum(cell[:, 1], size[1] - 1)]
    index = np.flatnonzero(at >= 0)
    return at[index].astype(np.int64), index


def _ground(xyz: F32, positions: F64) -> F64:
    """Local z (K,) of the ground below positions: the most frequent height of points below the path."""
    at, index = _lookup_nearest(xyz, positions, PERSON_HALF_WIDTH_M + PATH_STEP_M)
    below = positions[at, 2] - xyz[index, 2]
    in_range = (below > GROUND_DEPTH_M[0]) & (below < GROUND_DEPTH_M[1])
    stations = np.arange(len(positions)) // round(GROUND_SECTION_M / PATH_STEP_M)
    edges = np.arange(GROUND_DEPTH_M[0], GROUND_DEPTH_M[1] + 0.1, 0.1)
    count, *_ = np.histogram2d(stations[at[in_range]], below[in_range], [np.arange(stations[-1] + 2), edges])
    depth = np.where(count.sum(axis=1) > 0, edges[count.argmax(axis=1)] + 0.05, np.nan)
    known = np.flatnonzero(np.isfinite(depth))
    if not len(known):
        return np.full(len(positions), np.nan)
    return positions[:, 2] - np.interp(stations, known, depth[known])
