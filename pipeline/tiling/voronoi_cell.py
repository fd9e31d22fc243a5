"""Cells: what of the plane is a tile's own, so that neighbours share their borders without a word.

A survey is cut by seeds along its trajectory: a place belongs to the tile whose seed is nearest (Voronoi), so cells
are convex, borders are upright planes halfway between two seeds, and every tile that knows its neighbours' seeds
computes the same borders. Everything here is in world metres (CRS coordinates times metres per unit).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
Seed = tuple[float, float]
TOUCH = 0.01
"""Metres within which two cells touch, in a corner at least."""


@dataclass(frozen=True)
class Cell:
    """A tile's own part of the plane: what is nearer to its seed than to any neighbour's.

    Attributes:
        seed: (x, y) world metres.
        neighbours: name of every tile whose cell touches this one (in a corner at least) to its seed. The tile whose
            name sorts first owns a border: the other one fits its mesh to it.
        buffer: metres that the tile's cloud reaches beyond its borders.
    """

    seed: Seed
    neighbours: Mapping[str, Seed] = field(default_factory=dict)
    buffer: float = 5.0

    def beyond(self, neighbour: str, xy: npt.ArrayLike) -> F64:
        """(N,) metres that world places (N, 2) lie beyond the border with a neighbour; negative on the own side."""
        return beyond(self.seed, self.neighbours[neighbour], xy)

    def outside(self, xy: npt.ArrayLike) -> F64:
        """(N,) metres beyond the farthest border, negative inside; -inf without neighbours."""
        xy = np.asarray(xy, np.float64)
        distance = np.full(len(xy), -np.inf)
        for name in self.neighbours:
            distance = np.maximum(distance, self.beyond(name, xy))
        return distance


def beyond(own: Seed, other: Seed, xy: npt.ArrayLike) -> F64:
    """(N,) metres from the plane halfway between two seeds, positive on the other's side.

    The sum is the same, but for its sign, whichever of the two seeds asks.
    """
    first, second = sorted((own, other))
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    normal = (b - a) / np.linalg.norm(b - a)
    distance = (np.asarray(xy, np.float64) - (a + b) / 2) @ normal
    return distance if tuple(own) == first else -distance


def nearest(xy: F64, seeds: Sequence[Seed]) -> npt.NDArray[np.int64]:
    """(N,) index of the nearest seed to each world place (N, 2), the first of several as near."""
    index, least = np.zeros(len(xy), np.int64), np.full(len(xy), np.inf)
    for i, seed in enumerate(seeds):
        square = ((xy - seed) ** 2).sum(axis=1)
        nearer = square < least
        index[nearer], least[nearer] = i, square[nearer]
    return index


def outline(cell: Cell, low: npt.ArrayLike, high: npt.ArrayLike) -> F64:
    """(K, 2) corners of a cell within a rectangle (its corners (2,)), counter-clockwise, world metres."""
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


def cells(seeds: Mapping[str, Seed], near: float) -> dict[str, Cell]:
    """Every tile's cell with its neighbours: all whose cells touch it, in a corner at least.

    Args:
        seeds: tile's name to its seed, world metres.
        near: metres; seeds further apart than this are no neighbours (their cells meet far from any data).
    """
    from scipy.spatial import cKDTree

    names = sorted(seeds)
    if not names:
        return {}
    places = np.array([seeds[name] for name in names])
    tree = cKDTree(places)
    around = [sorted(set(close) - {i}) for i, close in enumerate(tree.query_ball_point(places, near))]
    whole = [Cell(seeds[name], {names[j]: seeds[names[j]] for j in around[i]}) for i, name in enumerate(names)]
    touching: list[set[int]] = [set() for _ in names]
    for i, cell in enumerate(whole):
        corners = outline(cell, np.subtract(cell.seed, near), np.add(cell.seed, near))
        for j in around[i]:
            if len(corners) and float(np.max(cell.beyond(names[j], corners))) > -TOUCH:
                touching[i].add(j)
    for i in range(len(names)):  # what one finds touching, the other knows, too
        for j in list(touching[i]):
            touching[j].add(i)
    return {
        name: Cell(seeds[name], {names[j]: seeds[names[j]] for j in sorted(touching[i])})
        for i, name in enumerate(names)
    }
