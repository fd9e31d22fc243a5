"""Volume that is empty by definition: the recording vehicle has driven through it, or a camera stood in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools, Trajectory

HALF_WIDTH, AHEAD, BEHIND, ROOF = 1.0, 2.8, 3.2, 0.3
"""Metres that a car's body reaches from a scanner on its roof: to each side, ahead, behind, above."""
PERSON = 0.3
"""Metres that a person with a scanner reaches to each side."""
WALKING = 2.5
"""Metres a second: whatever carries a scanner more slowly is no wider than a person."""
CLEAR = 0.25
"""Metres above the ground below the path that are left to the ground: cross fall, kerbs, noise of the poses."""
HEIGHTS = (0.5, 4.0)
"""Metres below the scanner between which the ground it is carried over is looked for."""
STEP = 0.25
"""Metres between places of the path that are looked at, and the side of the cells that points are looked up in."""
STATION = 2.0
"""Metres of path that share a height of the ground."""
FARTHEST = 5.0
"""Metres between two poses, at most, between which the vehicle has driven straight on."""


@dataclass(frozen=True)
class Swept:
    """The way of the recording vehicle.

    Attributes:
        places: (K, 3) along the path, `STEP` apart; also beyond its ends, as far as the vehicle reaches.
        half_width: metres.
        ground: (K,) local z of the ground below; NaN where there is none within `HEIGHTS`.
    """

    places: F64
    half_width: float
    ground: F64


def swept(xyz: F32, path: Trajectory) -> Swept:
    """The way that the path's vehicle took over points (N, 3)."""
    places = [np.zeros((0, 3))]
    leg = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    ends = np.append(np.flatnonzero(leg > FARTHEST), len(path) - 1)
    for first, last in zip(np.append(0, ends[:-1] + 1), ends, strict=True):
        places.append(_lengthened(_resampled(path.positions[first : last + 1])))
    whole = np.concatenate(places)
    speed = leg / np.maximum(np.diff(path.times), 1e-6)
    drives = bool(leg.sum() > 0) and float(np.median(speed[leg > 0.01])) > WALKING if (leg > 0.01).any() else False
    return Swept(whole, HALF_WIDTH if drives else PERSON, _ground(xyz, whole))


def in_swept(xyz: F32, way: Swept) -> Bools:
    """(N,) which points lie where the vehicle has been, clear of the ground."""
    at, index = _near(xyz, way.places, way.half_width)
    out = np.zeros(len(xyz), bool)
    place, ground = way.places[at], way.ground[at]
    p = xyz[index]
    beside = np.linalg.norm(p[:, :2] - place[:, :2], axis=1) < way.half_width
    out[index] = beside & (p[:, 2] > ground + CLEAR) & (p[:, 2] < place[:, 2] + ROOF)  # NaN: no
    return out


def in_first_metre(xyz: F32, cameras: F64, radius: float, way: Swept | None) -> Bools:
    """(N,) which points are nearer than `radius` to a camera (C, 3), clear of the ground where that is known."""
    out = np.zeros(len(xyz), bool)
    if not len(cameras) or radius <= 0:
        return out
    from scipy.spatial import cKDTree

    _, index = _near(xyz, cameras, radius)
    z = xyz[index, 2]
    index = index[(z > cameras[:, 2].min() - radius) & (z < cameras[:, 2].max() + radius)]
    distance, _ = cKDTree(cameras).query(xyz[index], distance_upper_bound=radius, workers=-1)
    inside = index[np.isfinite(distance)]
    if way is not None and len(inside):
        _, below = cKDTree(way.places[:, :2]).query(xyz[inside, :2])
        inside = inside[~(xyz[inside, 2] < way.ground[below] + CLEAR)]
    out[inside] = True
    return out


def _resampled(positions: F64) -> F64:
    """(K, 3) places about `STEP` apart along a polyline."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    want = np.linspace(0, along[-1], max(1, int(np.ceil(along[-1] / STEP))) + 1) if along[-1] > 0 else along[:1]
    return np.stack([np.interp(want, along, positions[:, k]) for k in range(3)], axis=1)


def _lengthened(places: F64) -> F64:
    """Straight on by what the vehicle reaches ahead of its scanner at the way's end, and behind it at its begin."""
    back = min(len(places) - 1, round(2 / STEP))
    if back < 1:
        return places
    parts = [places]
    for end, other, length in ((0, back, BEHIND), (-1, -1 - back, AHEAD)):
        heading = places[end] - places[other]
        norm = np.linalg.norm(heading)
        if norm > STEP:
            steps = np.arange(STEP, length + STEP / 2, STEP)[:, None]
            parts.append(places[end] + steps * heading / norm)
    return np.concatenate(parts)


def _near(xyz: F32, places: F64, reach: float) -> tuple[I64, I64]:
    """Of the points that may be within `reach` of a place (in plan): the nearest place to their cell, and their index.

    Places are looked up by square cells of `STEP`, so that points far away cost next to nothing.
    """
    from scipy.spatial import cKDTree

    side = int(np.ceil(reach / STEP)) + 1
    offset = np.stack(np.meshgrid(*2 * [np.arange(-side, side + 1)], indexing="ij"), -1).reshape(-1, 2)
    low = xyz[:, :2].min(axis=0).astype(np.float64)
    size = ((xyz[:, :2].max(axis=0) - low) / STEP).astype(np.int64) + 1
    own = np.unique(np.floor((places[:, :2] - low) / STEP).astype(np.int64), axis=0)
    cells = np.unique((own[:, None] + offset).reshape(-1, 2), axis=0)
    cells = cells[((cells >= 0) & (cells < size)).all(axis=1)]
    lookup = np.full(size, -1, np.int32)
    if len(cells):
        _, nearest = cKDTree(places[:, :2]).query(low + (cells + 0.5) * STEP)
        lookup[cells[:, 0], cells[:, 1]] = nearest
    cell = ((xyz[:, :2] - low.astype(np.float32)) / STEP).astype(np.int32)
    at = lookup[np.minimum(cell[:, 0], size[0] - 1), np.minimum(cell[:, 1], size[1] - 1)]
    index = np.flatnonzero(at >= 0)
    return at[index].astype(np.int64), index


def _ground(xyz: F32, places: F64) -> F64:
    """(K,) local z of the ground below places: where below the path most points are."""
    at, index = _near(xyz, places, PERSON + STEP)
    below = places[at, 2] - xyz[index, 2]
    some = (below > HEIGHTS[0]) & (below < HEIGHTS[1])
    stations = np.arange(len(places)) // round(STATION / STEP)
    edges = np.arange(HEIGHTS[0], HEIGHTS[1] + 0.1, 0.1)
    count, *_ = np.histogram2d(stations[at[some]], below[some], [np.arange(stations[-1] + 2), edges])
    depth = np.where(count.sum(axis=1) > 0, edges[count.argmax(axis=1)] + 0.05, np.nan)
    known = np.flatnonzero(np.isfinite(depth))
    if not len(known):
        return np.full(len(places), np.nan)
    return places[:, 2] - np.interp(stations, known, depth[known])
