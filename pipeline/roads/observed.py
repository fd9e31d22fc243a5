"""What is seen of a road before any line is drawn: paint, edges, heights, along the way that was driven."""

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

BEYOND = 15.0
"""Metres beyond the driven way's ends up to which a road is looked at."""
REACH = 15.0
"""Metres to either side."""
CELL = (1.0, 0.5)
"""Metres along and across that heights are means of."""
BESIDE = 1.0
"""Metres within which paint has points of a road beside it."""
NEAR = 6.0
"""Metres between the ends of ways that go on in each other."""
ALONG = 0.8
"""Cosine of the angle up to which they do."""


@dataclass(frozen=True)
class Observed:
    """What is seen along one way.

    Attributes:
        way: (W, 2) polyline that was driven.
        paint: (N, 2) middles of strokes of paint, row by row; stroke: (N,) which; width: (N,) metres.
        edge: (E, 4) x, y, side (1 left, -1 right of the way), height of the kerb (NaN: a border of classes; 0: a
            lowered kerb, by its stones).
        ground: (G, 3) places on the road's surface.
    """

    way: F64
    paint: F64
    stroke: I64
    width: F64
    edge: F64
    ground: F64

    @property
    def length(self) -> float:
        """Metres of the way."""
        return driven.length(self.way)

    def kept(self, paint: Bools, edge: Bools, ground: Bools) -> Self:
        """What masks say."""
        return replace(
            self, paint=self.paint[paint], stroke=self.stroke[paint], width=self.width[paint], edge=self.edge[edge],
            ground=self.ground[ground],
        )  # fmt: skip

    def moved(self, shift: F64) -> Self:
        """The same, `shift` (3,) added to all places."""
        edge = self.edge + np.append(shift[:2], [0.0, 0.0])
        xy = shift[:2]
        return replace(self, way=self.way + xy, paint=self.paint + xy, edge=edge, ground=self.ground + shift)

    def turned(self) -> Self:
        """The same, as who comes the other way sees it."""
        edge = self.edge * np.array([1.0, 1.0, -1.0, 1.0])
        return replace(self, way=self.way[::-1], edge=edge)

    def then(self, other: Self) -> Self:
        """This way and the other one, which goes on where it ends, as one."""
        after = replace(other, stroke=other.stroke + self.stroke.max(initial=-1) + 1)
        both = {f.name: np.concatenate([getattr(self, f.name), getattr(after, f.name)]) for f in fields(self)}
        return replace(self, **both)


def observe(way: F64, xyz: F64, road: Bools, renderer: Renderer | None) -> Observed:
    """Look at one way.

    Args:
        way: (W, 2) polyline on a road.
        xyz: (N, 3) points of the ground; road: (N,) whether their class is one to drive on.
        renderer: of the ground's textured mesh; None: there is none, and no paint to be seen.
    """
    places = driven.extended(way, BEYOND)
    line = clothoid.fit(clothoid.through(places), places)
    near = _near(xyz, places)
    xyz, road = xyz[near], road[near]
    s, t = line.locate(xyz)
    found = [kerbs.edges(s, t, xyz[:, 2], road, line.length, REACH, side) for side in (1, -1)]
    edge = np.concatenate(
        [
            np.column_stack([line.places(e[:, 0], e[:, 1]), np.full(len(e), side), e[:, 2]])
            for side, e in zip((1.0, -1.0), found, strict=True)
        ]
    )
    on = road & (np.abs(t) < REACH / 2)
    strokes = paint.Paint(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0))
    if renderer is not None and len(xyz):
        strokes = paint.strokes(renderer, line, REACH, float(xyz[:, 2].max()) + 5.0)
    seen = Observed(way, strokes.place, strokes.stroke, strokes.width, edge, _means(xyz[on], s[on], t[on]))
    whole = (np.ones(len(part), bool) for part in (seen.edge, seen.ground))
    return seen.kept(_on_road(seen.paint, xyz[road]), *whole)


def _on_road(places: F64, road: F64) -> Bools:
    """(N,) which places (N, 2) have points of a road (M, 3) beside them."""
    from scipy.spatial import cKDTree

    if not len(road) or not len(places):
        return np.zeros(len(places), bool)
    return np.asarray(np.isfinite(cKDTree(road[:, :2]).query(places, distance_upper_bound=BESIDE)[0]))


def _near(xyz: F64, places: F64) -> Bools:
    """(N,) which points are within reach of a way's box."""
    low, high = places.min(axis=0) - REACH, places.max(axis=0) + REACH
    return np.asarray(((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1))


def _means(xyz: F64, s: F64, t: F64) -> F64:
    """(G, 3) means of points over `CELL`s."""
    if not len(xyz):
        return np.zeros((0, 3))
    cell = np.column_stack([np.floor(s / CELL[0]), np.floor(t / CELL[1])]).astype(np.int64)
    _, index, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    return np.column_stack([np.bincount(index.ravel(), column) / count for column in xyz.T])


def joined(parts: Sequence[Observed]) -> list[Observed]:
    """Ways that go on in each other as one, as where tiles meet, up to `driven.LONGEST` metres."""
    follows = _partners(parts)
    ways, done = [], set[int]()
    for first in range(len(parts)):
        if first in done:
            continue
        i, entered = first, 0
        while follows.get((i, entered)) is not None:  # back to where it begins, or once around
            other, end = follows[i, entered]
            i, entered = other, 1 - end
            if i == first:
                break
        way = None
        while i not in done:
            done.add(i)
            part = parts[i].turned() if entered else parts[i]
            if way is not None and way.length + part.length > driven.LONGEST:
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
    """Ends of ways (which way; 0 its first end, 1 its last) and the ends that they go on in, nearest first."""
    from scipy.spatial import cKDTree

    ends = [(i, end) for i in range(len(parts)) for end in (0, 1)]
    if not ends:
        return {}
    places = np.array([parts[i].way[-end] for i, end in ends])
    inner = np.array([parts[i].way[-2 if end else 1] for i, end in ends])
    outwards = (places - inner) / np.maximum(np.linalg.norm(places - inner, axis=1, keepdims=True), 1e-9)
    pairs = cKDTree(places).query_pairs(NEAR, output_type="ndarray")
    distance = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    partners: dict[tuple[int, int], tuple[int, int]] = {}
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0], distance))].tolist():
        one, other = ends[a], ends[b]
        if one[0] != other[0] and outwards[a] @ outwards[b] < -ALONG and not {one, other} & partners.keys():
            partners[one], partners[other] = other, one
    return partners


def save(path: Path, ways: Sequence[Observed], frame: Frame) -> None:
    """Keep what was seen, in world metres."""
    shift = np.asarray(frame.origin)
    arrays = {f"{f.name}_{i}": getattr(way.moved(shift), f.name) for i, way in enumerate(ways) for f in fields(way)}
    np.savez(path, **arrays)


def load(path: Path) -> list[Observed]:
    """What `save` kept, in world metres."""
    with np.load(path) as arrays:
        count = sum(name.startswith("way_") for name in arrays)
        names = [f.name for f in fields(Observed)]
        return [Observed(*(arrays[f"{name}_{i}"] for name in names)) for i in range(count)]
