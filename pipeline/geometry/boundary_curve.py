"""Boundary curve of a mesh on a tile border: extraction, chains of edges, and shortest paths along it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from heapq import heappop, heappush
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools
from scan2sim.pipeline.geometry.common_faces import directed_edges

REVERSE_COST = 4.0
"""Cost factor for walking along the neighbour's curve against its direction."""
MAX_DETOUR_RATIO, MAX_DETOUR_EXTRA_M = 3.0, 0.5
"""Maximum cost of the path that replaces an edge: factor of its length, plus metres."""


class Curve(NamedTuple):
    """Boundary curve of a mesh on one of its borders.

    Attributes:
        edges: (E, 2) vertex indices, directed as in their faces.
        face: (E,) face of each edge.
    """

    edges: I64
    face: I64


def curve(faces: npt.NDArray[Any], on: Bools) -> Curve:
    """The open edges (of a single face) with both ends `on` (V,) a border."""
    near = np.flatnonzero(on[faces].sum(axis=1) > 1)
    edges, face = directed_edges(faces[near]), np.tile(near, 3)
    along = on[edges].all(axis=1)
    edges, face = edges[along], face[along]
    _, index, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    single = count[index.ravel()] == 1
    return Curve(edges[single], face[single])


def chains(edges: I64, ends: Iterable[int] = ()) -> list[list[int]]:
    """Chains of consecutive edges, as lists of vertices; closed chains repeat their first vertex at the end.

    Args:
        edges: (E, 2) directed edges.
        ends: vertices at which chains end even if they could continue.
    """
    after: dict[int, list[int]] = defaultdict(list)
    incoming: dict[int, int] = defaultdict(int)
    for a, b in edges.tolist():
        after[a].append(b)
        incoming[b] += 1
    stops = {v for v in {*after, *incoming} if len(after.get(v, ())) != 1 or incoming.get(v, 0) != 1} | set(ends)
    found = []
    for start in [*sorted(stops), *sorted(set(after) - stops)]:  # edges that remain after the open chains are loops
        while after.get(start):
            chain = [start, after[start].pop()]
            while chain[-1] not in stops and after.get(chain[-1]):
                chain.append(after[chain[-1]].pop())
            found.append(chain)
    return found


class Graph:
    """Graph of a neighbour's boundary curve, for shortest paths along it.

    Args:
        edges: (E, 2) indices into `xyz`, directed as in the neighbour's faces, opposite to the own curve.
        xyz: (V, 3) metres.
    """

    def __init__(self, edges: I64, xyz: F64) -> None:
        self.xyz = xyz
        self.next: dict[int, dict[int, float]] = defaultdict(dict)
        length = np.linalg.norm(xyz[edges[:, 0]] - xyz[edges[:, 1]], axis=1)
        for (a, b), metres in zip(edges.tolist(), length.tolist(), strict=True):
            self.next[b][a] = metres
            self.next[a].setdefault(b, REVERSE_COST * metres)

    def shortest_path(self, a: int, b: int) -> list[int] | None:
        """Vertices of the cheapest path from a to b, without a; None if it is too expensive or doesn't exist."""
        limit = MAX_DETOUR_RATIO * float(np.linalg.norm(self.xyz[a] - self.xyz[b])) + MAX_DETOUR_EXTRA_M
        queue: list[tuple[float, list[int]]] = [(0.0, [a])]
        seen = set()
        while queue:
            cost, path = heappop(queue)
            if path[-1] == b:
                return path[1:]
            if path[-1] in seen:
                continue
            seen.add(path[-1])
            for vertex, edge_cost in self.next[path[-1]].items():
                if vertex not in seen and cost + edge_cost <= limit:
                    heappush(queue, (cost + edge_cost, [*path, vertex]))
        return None

    def tail(self, last: int, before: int, limit: float) -> list[int]:
        """Vertices after `last` to the end of the curve, coming from `before`; empty if farther than `limit` metres."""
        path, length = [last], 0.0
        while len(self.next[path[-1]]) == 2:
            (step,) = self.next[path[-1]].keys() - {before}
            length += float(np.linalg.norm(self.xyz[step] - self.xyz[path[-1]]))
            if length > limit or step == last:
                return []
            before = path[-1]
            path.append(step)
        return path[1:] if len(self.next[path[-1]]) == 1 else []
