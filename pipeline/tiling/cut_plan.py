"""Where a corridor is cut: seeds of tiles along its path, which tiles a place belongs to, which photos see a tile.

Everything here is in world metres (CRS coordinates times metres per unit) and, but for photos, in the plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, I64, Frame, Trajectory, View
from scan2sim.pipeline.tiling.voronoi_cell import Seed

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Warn = Callable[[str], None]

NEAREST = 12
"""Seeds around a place that are asked whether it is theirs, too."""
GAP, GAP_STEPS = 20.0, 10.0
"""Between samples further apart than so many metres, and so many times the median step, a path is unknown."""
MOST = 100_000
"""Tiles; a grid of more is laid over a mistake."""
APART = 0.75
"""Lengths that seeds are apart at least, but for what would be further than a length from any."""
DENSE = 5.0
"""Metres between the samples of a path from which distances are told."""
SIGHT = 60.0
"""Metres to which photos are looked into."""
SHARE, ENOUGH = 0.01, 50
"""A photo sees a tile in this share of its points within sight, or in so many."""


def seeds(
    name: str,
    frame: Frame,
    length: float,
    low: npt.ArrayLike,
    high: npt.ArrayLike,
    path: Trajectory | None = None,
    warn: Warn = lambda _: None,
) -> dict[str, Seed]:
    """Tile names, `name_0000` and on, to seeds; where there is a path, in its order.

    A path is cut evenly into pieces of about `length`, with a seed in the middle of each. Where it comes by a second
    time, or another street's seed is close, it makes none. Without a path seeds are on a square grid, `length` apart.

    Args:
        name: of the survey.
        frame: of the path; seeds are whole thousandths of its CRS's unit, as `tile.toml` holds them.
        length: metres.
        low, high: (2,) corners of the clouds.
        path: the scanner's.
        warn: receives where the path has gaps.

    Raises:
        DataError: a grid of more than `MOST` tiles.
    """
    if path is None:
        places = _grid(np.asarray(low, np.float64), np.asarray(high, np.float64), length, name)
    else:
        world = path.positions + np.asarray(frame.origin)
        parts = _without_gaps(path.times, world[:, :2], frame.unit, warn)
        places = _along(parts, length)
    rounded = np.round(places / frame.unit, 3)
    digits = max(4, len(str(len(rounded) - 1)))  # sorted by name they are in order
    return {f"{name}_{i:0{digits}d}": (x * frame.unit, y * frame.unit) for i, (x, y) in enumerate(rounded.tolist())}


def dense(xy: F64) -> F64:
    """(M, 2) places of a path (N, 2), about `DENSE` metres apart; gaps are bridged straight."""
    xy = _thinned(xy, DENSE)
    out = [xy[:1]]
    for a, b in pairwise(xy):
        steps = max(1, math.ceil(float(np.linalg.norm(b - a)) / DENSE - 0.5))
        out.append(a + (b - a) * (np.arange(1, steps + 1) / steps)[:, None])
    return np.concatenate(out)


def members(xy: F64, places: F64, buffer: float) -> tuple[I64, I64, I64]:
    """Which tiles places belong to.

    Args:
        xy: (N, 2) places.
        places: (S, 2) seeds.
        buffer: metres that a tile reaches beyond its borders.

    Returns:
        own (N,): the tile of the nearest seed, by its index; and pairs (M,), (M,) of places and further tiles that
        reach there.
    """
    from scipy.spatial import cKDTree

    none = np.empty(0, np.int64)
    if len(places) == 1:
        return np.zeros(len(xy), np.int64), none, none
    tree = cKDTree(places)
    distance, nearest = tree.query(xy, k=2, workers=-1)
    own = nearest[:, 0].astype(np.int64)
    # no border is nearer than half of what its seed is further away: most places are within one tile alone
    close = np.flatnonzero(distance[:, 1] <= distance[:, 0] + 2 * buffer)
    k = min(NEAREST, len(places))
    distance, nearest = tree.query(xy[close], k=k, workers=-1)
    points, tiles = [none], [none]
    for j in range(k):
        at = np.flatnonzero((distance[:, j] <= distance[:, 0] + 2 * buffer) & (nearest[:, j] != own[close]))
        tile = nearest[at, j]
        within = np.ones(len(at), bool)
        for other in range(k):
            if other != j:
                apart = np.linalg.norm(places[tile] - places[nearest[at, other]], axis=1)
                within &= (distance[at, j] ** 2 - distance[at, other] ** 2) / (2 * apart) <= buffer
        points.append(close[at[within]])
        tiles.append(tile[within].astype(np.int64))
    return own, np.concatenate(points), np.concatenate(tiles)


def sees(view: View, xyz: F64) -> bool:
    """Whether a photo shows enough of points (N, 3), local coordinates; what hides them is not asked."""
    from scan2sim.pipeline.camera.projection import pixels

    xyz = xyz[np.linalg.norm(xyz - view.centre, axis=1) <= SIGHT]
    if len(xyz) == 0:
        return False
    _, shown = pixels(view.camera, view.T_world_cam, xyz)
    return int(np.count_nonzero(shown)) >= min(ENOUGH, max(1.0, SHARE * len(xyz)))


def _grid(low: F64, high: F64, length: float, name: str) -> F64:
    """(S, 2) seeds `length` apart around the middle, row after row."""
    extent = (high - low)[:2].tolist()
    nx, ny = (max(1, math.floor(metres / length + 0.5)) for metres in extent)
    if nx * ny > MOST:
        raise DataError(
            name,
            f"its clouds reach over {extent[0]:,.0f} x {extent[1]:,.0f} m, which would be {nx * ny:,} tiles",
            "Give longer tiles, or a trajectory, or check the clouds' coordinates",
        )
    middle = (low + high)[:2] / 2
    y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (ny, nx)), indexing="ij")
    return middle + length * np.column_stack([x.ravel(), y.ravel()])


def _without_gaps(times: F64, xy: F64, unit: float, warn: Warn) -> list[F64]:
    """The parts (N, 2) of a path between its gaps."""
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    gaps = np.flatnonzero(steps > max(GAP, GAP_STEPS * float(np.median(steps)))) if len(steps) else np.empty(0, int)
    for i in gaps.tolist():
        x, y = (xy[i] / unit).tolist()
        warn(
            f"the trajectory has a gap of {steps[i]:.0f} m from {times[i]:.3f} s to {times[i + 1]:.3f} s, "
            f"at {x:.1f}, {y:.1f}: what was scanned there goes to the nearest tiles"
        )
    return np.split(xy, gaps + 1)


def _along(parts: list[F64], length: float) -> F64:
    """(S, 2) seeds in the order of the path: evenly along new ground, and no place of it further than `length` away."""
    from scipy.spatial import cKDTree

    step = max(1.0, length / 20)
    parts = [_thinned(part, step) for part in parts]
    xy = np.concatenate(parts)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    stretches = _new_ground(parts, xy, run, max(10.0, length / 4), step)
    chosen: list[float] = []  # metres of the path

    def place(metres: list[float]) -> F64:
        return np.column_stack([np.interp(metres, run, xy[:, k]) for k in range(2)])

    for first, last in stretches:
        extent = run[last] - run[first]
        pieces = math.floor(extent / length + 0.5)
        for i in range(pieces):
            here = run[first] + (i + 0.5) * extent / pieces
            if not chosen or np.linalg.norm(place(chosen) - place([here]), axis=1).min() >= APART * length - 1e-6:
                chosen.append(here)
    if not chosen:
        first, last = max(stretches, key=lambda s: run[s[1]] - run[s[0]])
        chosen.append((run[first] + run[last]) / 2)
    while True:
        far = np.flatnonzero(cKDTree(place(chosen)).query(xy)[0] > length)
        if len(far) == 0:
            return place(sorted(chosen))
        chosen.append(run[far[0]])


def _new_ground(parts: list[F64], xy: F64, run: F64, near: float, step: float) -> list[tuple[int, int]]:
    """First and last sample of each stretch on which a path isn't where it was before.

    It was there before, if it passed within `near` and has since driven more than double the straight way: no bend of
    a street does that, but a turn does, and a way around the block.
    """
    from scipy.spatial import cKDTree

    tree: cKDTree = cKDTree(xy)
    new = np.ones(len(xy), bool)
    for i in range(len(xy)):
        before = np.array([j for j in tree.query_ball_point(xy[i], near) if j < i], np.int64)
        straight = np.linalg.norm(xy[before] - xy[i], axis=1)
        new[i] = not (run[i] - run[before] >= 2 * straight + 2 * step).any()
    stretches: list[tuple[int, int]] = []
    start = 0
    for part in parts:
        here = np.flatnonzero(new[start : start + len(part)]) + start
        for some in np.split(here, np.flatnonzero(np.diff(here) > 1) + 1):
            if len(some):
                stretches.append((int(some[0]), int(some[-1])))
        start += len(part)
    return stretches


def _thinned(xy: F64, step: float) -> F64:
    """The samples of a path (N, 2) that are `step` metres from the one kept before, and the last.

    What stands still, trembling, makes no way.
    """
    kept = [0]
    x, y = xy.T.tolist()
    for i in range(1, len(xy)):
        if math.hypot(x[i] - x[kept[-1]], y[i] - y[kept[-1]]) >= step - 1e-6:
            kept.append(i)
    if kept[-1] != len(xy) - 1:
        kept.append(len(xy) - 1)
    return xy[kept]
