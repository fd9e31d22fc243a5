"""Plan of a cut: seeds of tiles along the path, tile membership of points, and visibility of tiles in photos.

Coordinates are world metres (CRS coordinates times metres per unit), in 2D except for photos.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, I64, Frame, Trajectory, View
from scan2sim.pipeline.core.voronoi_cell import Seed
from scan2sim.pipeline.geometry.path_sampling import thin_path

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Warn = Callable[[str], None]

CANDIDATE_SEEDS = 12
"""Nearest seeds whose tiles are checked for containing a point in their buffer."""
MIN_GAP_M, MIN_GAP_STEPS = 20.0, 10.0
"""A gap of the path: poses farther apart than this distance, and this many times the median step."""
MAX_TILES = 100_000
"""Maximum number of tiles on a grid; more result from wrong coordinates."""
MIN_SEED_SPACING = 0.75
"""Minimum distance between seeds in tile lengths, unless a part of the path would be farther than a length from any."""
MAX_SIGHT_M = 60.0
"""Distance from a photo up to which points count as visible."""
MIN_VISIBLE_SHARE, MIN_VISIBLE_POINTS = 0.01, 50
"""A photo shows a tile if it shows this share of the tile's points within `MAX_SIGHT_M`, or this number."""


def seeds(
    name: str,
    frame: Frame,
    length: float,
    low: npt.ArrayLike,
    high: npt.ArrayLike,
    path: Trajectory | None = None,
    warn: Warn = lambda _: None,
) -> dict[str, Seed]:
    """Seeds of the tiles, by tile name (`name_0000` and so on), in order along the path if there is one.

    A path is cut evenly into pieces of about `length`, with a seed in the middle of each. Repeated visits of a street,
    and pieces close to another street's seed, get none. Without a path seeds are on a square grid, `length` apart.

    Args:
        name: name of the survey.
        frame: frame of the path; seeds are rounded to 1/1000 of its CRS's unit, as in `tile.toml`.
        length: length of a tile, metres.
        low, high: (2,) corners of the clouds.
        path: path of the scanner, or None.
        warn: receives a warning for each gap of the path.

    Raises:
        DataError: a grid of more than `MAX_TILES` tiles.
    """
    if path is None:
        positions = _grid(np.asarray(low, np.float64), np.asarray(high, np.float64), length, name)
    else:
        world = path.positions + np.asarray(frame.origin)
        parts = _without_gaps(path.times, world[:, :2], frame.unit, warn)
        positions = _seeds_along(parts, length)
    rounded = np.round(positions / frame.unit, 3)
    digits = max(4, len(str(len(rounded) - 1)))  # so that sorting by name keeps the order
    return {f"{name}_{i:0{digits}d}": (x * frame.unit, y * frame.unit) for i, (x, y) in enumerate(rounded.tolist())}


def tile_membership(xy: F64, seed_xy: F64, buffer: float) -> tuple[I64, I64, I64]:
    """Assign points to tiles.

    Args:
        xy: (N, 2) points.
        seed_xy: (S, 2) seeds.
        buffer: metres by which a tile extends beyond its borders.

    Returns:
        own (N,): index of the tile with the nearest seed; and pairs (M,), (M,) of points and further tiles whose
        buffer contains them.
    """
    from scipy.spatial import cKDTree

    empty = np.empty(0, np.int64)
    if len(seed_xy) == 1:
        return np.zeros(len(xy), np.int64), empty, empty
    tree = cKDTree(seed_xy)
    distance, nearest = tree.query(xy, k=2, workers=-1)
    own = nearest[:, 0].astype(np.int64)
    # a border is at least half the difference of the seeds' distances away: most points are in a single tile
    close = np.flatnonzero(distance[:, 1] <= distance[:, 0] + 2 * buffer)
    k = min(CANDIDATE_SEEDS, len(seed_xy))
    distance, nearest = tree.query(xy[close], k=k, workers=-1)
    points, tiles = [empty], [empty]
    for j in range(k):
        at = np.flatnonzero((distance[:, j] <= distance[:, 0] + 2 * buffer) & (nearest[:, j] != own[close]))
        tile = nearest[at, j]
        within = np.ones(len(at), bool)
        for other in range(k):
            if other != j:
                apart = np.linalg.norm(seed_xy[tile] - seed_xy[nearest[at, other]], axis=1)
                within &= (distance[at, j] ** 2 - distance[at, other] ** 2) / (2 * apart) <= buffer
        points.append(close[at[within]])
        tiles.append(tile[within].astype(np.int64))
    return own, np.concatenate(points), np.concatenate(tiles)


def sees(view: View, xyz: F64) -> bool:
    """Whether a photo shows enough of the points (N, 3), local coordinates; occlusion is ignored."""
    from scan2sim.pipeline.camera.projection import pixels

    xyz = xyz[np.linalg.norm(xyz - view.centre, axis=1) <= MAX_SIGHT_M]
    if len(xyz) == 0:
        return False
    _, visible = pixels(view.camera, view.T_world_cam, xyz)
    return int(np.count_nonzero(visible)) >= min(MIN_VISIBLE_POINTS, max(1.0, MIN_VISIBLE_SHARE * len(xyz)))


def _grid(low: F64, high: F64, length: float, name: str) -> F64:
    """Seeds (S, 2) on a grid, `length` apart and centred, row by row."""
    extent = (high - low)[:2].tolist()
    nx, ny = (max(1, math.floor(metres / length + 0.5)) for metres in extent)
    if nx * ny > MAX_TILES:
        raise DataError(
            name,
            f"its clouds extend over {extent[0]:,.0f} x {extent[1]:,.0f} m, which would be {nx * ny:,} tiles",
            "Give longer tiles, or a trajectory, or check the clouds' coordinates",
        )
    middle = (low + high)[:2] / 2
    y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (ny, nx)), indexing="ij")
    return middle + length * np.column_stack([x.ravel(), y.ravel()])


def _without_gaps(times: F64, xy: F64, unit: float, warn: Warn) -> list[F64]:
    """Split a path (N, 2) at its gaps."""
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    gaps = (
        np.flatnonzero(steps > max(MIN_GAP_M, MIN_GAP_STEPS * float(np.median(steps))))
        if len(steps)
        else np.empty(0, int)
    )
    for i in gaps.tolist():
        x, y = (xy[i] / unit).tolist()
        warn(
            f"the trajectory has a gap of {steps[i]:.0f} m from {times[i]:.3f} s to {times[i + 1]:.3f} s, "
            f"at {x:.1f}, {y:.1f}: points there go to the nearest tiles"
        )
    return np.split(xy, gaps + 1)


def _seeds_along(parts: list[F64], length: float) -> F64:
    """Seeds (S, 2) in order along the path: even along first visits, and no part of the path farther than `length`."""
    from scipy.spatial import cKDTree

    step = max(1.0, length / 20)
    parts = [thin_path(part, step) for part in parts]
    xy = np.concatenate(parts)
    arc_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    stretches = _first_visits(parts, xy, arc_length, max(10.0, length / 4), step)
    chosen: list[float] = []  # arc lengths of seeds, metres

    def position(metres: list[float]) -> F64:
        return np.column_stack([np.interp(metres, arc_length, xy[:, k]) for k in range(2)])

    for first, last in stretches:
        extent = arc_length[last] - arc_length[first]
        pieces = math.floor(extent / length + 0.5)
        for i in range(pieces):
            centre = arc_length[first] + (i + 0.5) * extent / pieces
            spacing = MIN_SEED_SPACING * length - 1e-6
            if not chosen or np.linalg.norm(position(chosen) - position([centre]), axis=1).min() >= spacing:
                chosen.append(centre)
    if not chosen:
        first, last = max(stretches, key=lambda s: arc_length[s[1]] - arc_length[s[0]])
        chosen.append((arc_length[first] + arc_length[last]) / 2)
    while True:
        far = np.flatnonzero(cKDTree(position(chosen)).query(xy)[0] > length)
        if len(far) == 0:
            return position(sorted(chosen))
        chosen.append(arc_length[far[0]])


def _first_visits(parts: list[F64], xy: F64, arc_length: F64, near: float, step: float) -> list[tuple[int, int]]:
    """First and last sample of each stretch that the path visits for the first time.

    A sample is a repeated visit if the path passed within `near` before and has since driven more than twice the
    straight distance: a bend of a street doesn't do that, but a U-turn or a loop around the block does.
    """
    from scipy.spatial import cKDTree

    tree: cKDTree = cKDTree(xy)
    new = np.ones(len(xy), bool)
    for i in range(len(xy)):
        before = np.array([j for j in tree.query_ball_point(xy[i], near) if j < i], np.int64)
        straight = np.linalg.norm(xy[before] - xy[i], axis=1)
        new[i] = not (arc_length[i] - arc_length[before] >= 2 * straight + 2 * step).any()
    stretches: list[tuple[int, int]] = []
    start = 0
    for part in parts:
        new_samples = np.flatnonzero(new[start : start + len(part)]) + start
        for stretch in np.split(new_samples, np.flatnonzero(np.diff(new_samples) > 1) + 1):
            if len(stretch):
                stretches.append((int(stretch[0]), int(stretch[-1])))
        start += len(part)
    return stretches
