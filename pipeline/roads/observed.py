"""Observations of a road along the driven path: paint, edges and heights, from which roads are modelled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools, Frame
from scan2sim.pipeline.roads import clothoid, driven, kerbs, paint

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Renderer

EXTENSION_M = 15.0
"""Length by which a driven way is extended at both ends for observations."""
MAX_OFFSET_M = 15.0
"""Largest distance of observations from the way."""
HEIGHT_CELL_M = (1.0, 0.5)
"""Size along and across of the cells over which heights are averaged."""
PAINT_ROAD_DISTANCE_M = 1.0
"""Paint must have points of a road within this distance."""
MAX_END_GAP_M = 6.0
"""Largest distance between the ends of ways that continue each other."""
MIN_CONTINUATION_COS = 0.8
"""Smallest cosine between the directions of ways that continue each other."""


@dataclass(frozen=True)
class Observed:
    """Observations along one way.

    Attributes:
        way: (W, 2) polyline of the driven path.
        paint: (N, 2) centre points of paint strokes, per row; stroke: (N,) index of the stroke; width: (N,) metres.
        edge: (E, 4) x, y, side (1 left, -1 right of the way), kerb height (NaN: a class boundary; 0: a dropped kerb,
            detected by its stones).
        ground: (G, 3) points on the road's surface.
    """

    way: F64
    paint: F64
    stroke: I64
    width: F64
    edge: F64
    ground: F64

    @property
    def length(self) -> float:
        """Length of the way, metres."""
        return driven.length(self.way)

    def kept(self, paint: Bools, edge: Bools, ground: Bools) -> Self:
        """Observations selected by masks."""
        return replace(
            self, paint=self.paint[paint], stroke=self.stroke[paint], width=self.width[paint], edge=self.edge[edge],
            ground=self.ground[ground],
        )  # fmt: skip

    def moved(self, shift: F64) -> Self:
        """Observations translated by `shift` (3,)."""
        edge = self.edge + np.append(shift[:2], [0.0, 0.0])
        xy = shift[:2]
        return replace(self, way=self.way + xy, paint=self.paint + xy, edge=edge, ground=self.ground + shift)

    def reverse(self) -> Self:
        """Observations of the way in the opposite direction."""
        edge = self.edge * np.array([1.0, 1.0, -1.0, 1.0])
        return replace(self, way=self.way[::-1], edge=edge)

    def then(self, other: Self) -> Self:
        """This way joined with another one that continues it."""
        after = replace(other, stroke=other.stroke + self.stroke.max(initial=-1) + 1)
        both = {f.name: np.concatenate([getattr(self, f.name), getattr(after, f.name)]) for f in fields(self)}
        return replace(self, **both)


def observe(way: F64, xyz: F64, road: Bools, renderer: Renderer | None) -> Observed:
    """Extract the observations along one way.

    Args:
        way: (W, 2) polyline on a road.
        xyz: (N, 3) ground points; road: (N,) bool, True for road classes.
        renderer: renderer of the ground's textured mesh; None: no texture, so no paint is detected.
    """
    places = driven.extend(way, EXTENSION_M)
    line = clothoid.fit(clothoid.approximate(places), places)
    near = _near(xyz, places)
    xyz, road = xyz[near], road[near]
    s, t = line.locate(xyz)
    found = [kerbs.edges(s, t, xyz[:, 2], road, line.length, MAX_OFFSET_M, side) for side in (1, -1)]
    edge = np.concatenate(
        [
            np.column_stack([line.points(e[:, 0], e[:, 1]), np.full(len(e), side), e[:, 2]])
            for side, e in zip((1.0, -1.0), found, strict=True)
        ]
    )
    on = road & (np.abs(t) < MAX_OFFSET_M / 2)
    strokes = paint.Paint(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0))
    if renderer is not None and len(xyz):
        strokes = paint.strokes(renderer, line, MAX_OFFSET_M, float(xyz[:, 2].max()) + 5.0)
    seen = Observed(way, strokes.position, strokes.stroke, strokes.width, edge, _means(xyz[on], s[on], t[on]))
    whole = (np.ones(len(part), bool) for part in (seen.edge, seen.ground))
    return seen.kept(_on_road(seen.paint, xyz[road]), *whole)


def _on_road(places: F64, road: F64) -> Bools:
    """(N,) bool, True for points (N, 2) with road points (M, 3) nearby."""
    from scipy.spatial import cKDTree

    if not len(road) or not len(places):
        return np.zeros(len(places), bool)
    return np.asarray(np.isfinite(cKDTree(road[:, :2]).query(places, distance_upper_bound=PAINT_ROAD_DISTANCE_M)[0]))


def _near(xyz: F64, places: F64) -> Bools:
    """(N,) bool, True for points in the dilated bounding box of a way."""
    low, high = places.min(axis=0) - MAX_OFFSET_M, places.max(axis=0) + MAX_OFFSET_M
    return np.asarray(((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1))


def _means(xyz: F64, s: F64, t: F64) -> F64:
    """Means (G, 3) of points over cells of `HEIGHT_CELL_M`."""
    if not len(xyz):
        return np.zeros((0, 3))
    cell = np.column_stack([np.floor(s / HEIGHT_CELL_M[0]), np.floor(t / HEIGHT_CELL_M[1])]).astype(np.int64)
    _, index, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    return np.column_stack([np.bincount(index.ravel(), column) / count for column in xyz.T])


def join(parts: Sequence[Observed]) -> list[Observed]:
    """Join ways that continue each other, as at tile borders, up to a length of `driven.MAX_LENGTH_M`."""
    follows = _partners(parts)
    ways, done = [], set[int]()
    for first in range(len(parts)):
        if first in done:
            continue
        i, entered = first, 0
        while follows.get((i, entered)) is not None:  # back to the first way of the chain, or around a loop
            other, end = follows[i, entered]
            i, entered = other, 1 - end
            if i == first:
                break
        way = None
        while i not in done:
            done.add(i)
            part = parts[i].reverse() if entered else parts[i]
            if way is not None and way.length + part.length > driven.MAX_LENGTH_M:
                ways.append(way)
                way = None
            way = part if way is None else way.then(part)
            after = follows.get((i, 1 - entered))
            if after is not None:
                i, entered = after
        if way is not None:
            ways.append(way)
    return ways


def _partners(parts: Sequence[Observed]) -> dict[tuple[int, int], tuple[int, int]]:
    """Pairs of ends (index of the way; 0 is its first end, 1 its last) that continue each other, nearest first."""
    from scipy.spatial import cKDTree

    ends = [(i, end) for i in range(len(parts)) for end in (0, 1)]
    if not ends:
        return {}
    places = np.array([parts[i].way[-end] for i, end in ends])
    inner = np.array([parts[i].way[-2 if end else 1] for i, end in ends])
    outwards = (places - inner) / np.maximum(np.linalg.norm(places - inner, axis=1, keepdims=True), 1e-9)
    pairs = cKDTree(places).query_pairs(MAX_END_GAP_M, output_type="ndarray")
    distance = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    partners: dict[tuple[int, int], tuple[int, int]] = {}
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0], distance))].tolist():
        one, other = ends[a], ends[b]
        if (
            one[0] != other[0]
            and outwards[a] @ outwards[b] < -MIN_CONTINUATION_COS
            and not {one, other} & partners.keys()
        ):
            partners[one], partners[other] = other, one
    return partners


def save(path: Path, ways: Sequence[Observed], frame: Frame) -> None:
    """Write observations as .npz, in world metres."""
    shift = np.asarray(frame.origin)
    arrays = {f"{f.name}_{i}": getattr(way.moved(shift), f.name) for i, way in enumerate(ways) for f in fields(way)}
    np.savez(path, **arrays)


def load(path: Path) -> list[Observed]:
    """Read the result of `save`, in world metres."""
    with np.load(path) as arrays:
        count = sum(name.startswith("way_") for name in arrays)
        names = [f.name for f in fields(Observed)]
        return [Observed(*(arrays[f"{name}_{i}"] for name in names)) for i in range(count)]
