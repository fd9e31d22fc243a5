"""Voronoi cells of tiles; neighbours compute identical borders independently.

A survey is cut by seeds along its trajectory: a point belongs to the tile with the nearest seed, so cells are convex,
borders are vertical planes halfway between two seeds, and every tile that knows its neighbours' seeds computes the
same borders. Coordinates are world metres (CRS coordinates times metres per unit).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
Seed = tuple[float, float]
CONTACT_TOLERANCE_M = 0.01
"""Distance up to which two cells count as touching, at least in a corner."""


@dataclass(frozen=True)
class Cell:
    """Voronoi cell of a tile: the points that are nearer to its seed than to any neighbour's.

    Attributes:
        seed: (x, y) world metres.
        neighbours: name of every tile whose cell touches this one (at least in a corner) to its seed. The tile whose
            name sorts first owns a border: the other one fits its mesh to it.
        buffer: metres by which the tile's cloud extends beyond its borders.
    """

    seed: Seed
    neighbours: Mapping[str, Seed] = field(default_factory=dict)
    buffer: float = 5.0

    def beyond(self, neighbour: str, xy: npt.ArrayLike) -> F64:
        """Signed distance (N,) of world points (N, 2) from the border with a neighbour, negative inside the cell."""
        return beyond(self.seed, self.neighbours[neighbour], xy)

    def outside(self, xy: npt.ArrayLike) -> F64:
        """Signed distance (N,) from the cell: maximum over its borders, negative inside; -inf without neighbours."""
        xy = np.asarray(xy, np.float64)
        distance = np.full(len(xy), -np.inf)
        for name in self.neighbours:
            distance = np.maximum(distance, self.beyond(name, xy))
        return distance


def beyond(own: Seed, other: Seed, xy: npt.ArrayLike) -> F64:
    """Signed distance (N,) from the plane halfway between two seeds, positive on the other seed's side.

    Swapping the seeds changes only the sign, bit for bit.
    """
    first, second = sorted((own, other))
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    normal = (b - a) / np.linalg.norm(b - a)
    distance = (np.asarray(xy, np.float64) - (a + b) / 2) @ normal
    return distance if tuple(own) == first else -distance


def nearest(xy: F64, seeds: Sequence[Seed]) -> npt.NDArray[np.int64]:
    """Index (N,) of the seed nearest to each world point (N, 2), the first of several at the same distance."""
    index, smallest = np.zeros(len(xy), np.int64), np.full(len(xy), np.inf)
    for i, seed in enumerate(seeds):
        square = ((xy - seed) ** 2).sum(axis=1)
        nearer = square < smallest
        index[nearer], smallest[nearer] = i, square[nearer]
    return index


def outline(cell: Cell, low: npt.ArrayLike, high: npt.ArrayLike) -> F64:
    """Polygon (K, 2) of a cell clipped to a rectangle (corners (2,)), counter-clockwise, world metres."""
    (left, bottom), (right, top) = np.asarray(low, np.float64), np.asarray(high, np.float64)
    corners = np.array([(left, bottom), (right, bottom), (right, top), (left, top)])
    for name in cell.neighbours:
        s = cell.beyond(name, corners)
        kept: list[F64] = []
        for i in range(len(corners)):
            j = (i + 1) % len(corners)
            if s[i] <= 0:
                kept.append(corners[i])
            if (s[i] < 0 < s[j]) or (s[j] < 0 < s[i]):
                kept.append(corners[i] + (corners[j] - corners[i]) * s[i] / (s[i] - s[j]))
        corners = np.array(kept).reshape(-1, 2)
    return corners


def cells(seeds: Mapping[str, Seed], max_distance: float) -> dict[str, Cell]:
    """Every tile's cell with its neighbours: the tiles whose cells touch it, at least in a corner.

    Args:
        seeds: seed of each tile by name, world metres.
        max_distance: metres; seeds farther apart aren't neighbours (their cells meet far from any data).
    """
    from scipy.spatial import cKDTree

    names = sorted(seeds)
    if not names:
        return {}
    positions = np.array([seeds[name] for name in names])
    tree = cKDTree(positions)
    around = [sorted(set(close) - {i}) for i, close in enumerate(tree.query_ball_point(positions, max_distance))]
    candidates = [Cell(seeds[name], {names[j]: seeds[names[j]] for j in around[i]}) for i, name in enumerate(names)]
    touching: list[set[int]] = [set() for _ in names]
    for i, cell in enumerate(candidates):
        corners = outline(cell, np.subtract(cell.seed, max_distance), np.add(cell.seed, max_distance))
        for j in around[i]:
            if len(corners) and float(np.max(cell.beyond(names[j], corners))) > -CONTACT_TOLERANCE_M:
                touching[i].add(j)
    for i in range(len(names)):  # make the relation symmetric
        for j in list(touching[i]):
            touching[j].add(i)
    return {
        name: Cell(seeds[name], {names[j]: seeds[names[j]] for j in sorted(touching[i])})
        for i, name in enumerate(names)
    }
