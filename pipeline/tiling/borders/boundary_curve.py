"""The edge that a mesh has on a border: a curve, its chains, and ways along it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from heapq import heappop, heappush
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools
from scan2sim.pipeline.tiling.borders.common_faces import directed_edges

AGAINST = 4.0
"""What a metre along the other's border costs in the wrong direction."""
DETOUR, MORE = 3.0, 0.5
"""What an edge may cost that is made to follow the other's border: so many times its length, and as much more."""


class Curve(NamedTuple):
    """The edge that a mesh has on one of its borders.

    Attributes:
        edges: (E, 2) directed as in their faces; into the mesh's vertices.
        face: (E,) the face of each.
    """

    edges: I64
    face: I64


def curve(faces: npt.NDArray[Any], on: Bools) -> Curve:
    """The edges of one face alone whose both ends lie `on` (V,) a border."""
    near = np.flatnonzero(on[faces].sum(axis=1) > 1)
    edges, face = directed_edges(faces[near]), np.tile(near, 3)
    along = on[edges].all(axis=1)
    edges, face = edges[along], face[along]
    _, index, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    alone = count[index.ravel()] == 1
    return Curve(edges[alone], face[alone])


def chains(edges: I64, ends: Iterable[int] = ()) -> list[list[int]]:
    """Edges in a row, as lists of vertices; closed ones name their first vertex again at the end.

    Args:
        edges: (E, 2) directed.
        ends: vertices where chains end even if they could go on.
    """
    after: dict[int, list[int]] = defaultdict(list)
    incoming: dict[int, int] = defaultdict(int)
    for a, b in edges.tolist():
        after[a].append(b)
        incoming[b] += 1
    stops = {v for v in {*after, *incoming} if len(after.get(v, ())) != 1 or incoming.get(v, 0) != 1} | set(ends)
    found = []
    for start in [*sorted(stops), *sorted(set(after) - stops)]:  # what is left after the open ones are loops
        while after.get(start):
            chain = [start, after[start].pop()]
            while chain[-1] not in stops and after.get(chain[-1]):
                chain.append(after[chain[-1]].pop())
            found.append(chain)
    return found


class Graph:
    """A neighbour's border curve to walk along.

    Args:
        edges: (E, 2) into `xyz`, directed as in the neighbour's faces: the own ones run against them.
        xyz: (V, 3) metres.
    """

    def __init__(self, edges: I64, xyz: F64) -> None:
        self.xyz = xyz
        self.next: dict[int, dict[int, float]] = defaultdict(dict)
        length = np.linalg.norm(xyz[edges[:, 0]] - xyz[edges[:, 1]], axis=1)
        for (a, b), far in zip(edges.tolist(), length.tolist(), strict=True):
            self.next[b][a] = far
            self.next[a].setdefault(b, AGAINST * far)

    def way(self, a: int, b: int) -> list[int] | None:
        """Vertices of the cheapest way from a to b, without a; None where it is dear or there is none."""
        limit = DETOUR * float(np.linalg.norm(self.xyz[a] - self.xyz[b])) + MORE
        queue: list[tuple[float, list[int]]] = [(0.0, [a])]
        seen = set()
        while queue:
            price, way = heappop(queue)
            if way[-1] == b:
                return way[1:]
            if way[-1] in seen:
                continue
            seen.add(way[-1])
            for vertex, more in self.next[way[-1]].items():
                if vertex not in seen and price + more <= limit:
                    heappush(queue, (price + more, [*way, vertex]))
        return None

    def tail(self, last: int, before: int, limit: float) -> list[int]:
        """Vertices from `last` to where the curve ends, coming from `before`; none where that is far."""
        way, length = [last], 0.0
        while len(self.next[way[-1]]) == 2:
            (step,) = self.next[way[-1]].keys() - {before}
            length += float(np.linalg.norm(self.xyz[step] - self.xyz[way[-1]]))
            if length > limit or step == last:
                return []
            before = way[-1]
            way.append(step)
        return way[1:] if len(self.next[way[-1]]) == 1 else []
