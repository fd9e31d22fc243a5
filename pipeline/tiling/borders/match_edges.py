"""Follow: how a tile's border is to go along a neighbour's, vertex for vertex."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Mesh
from scan2sim.pipeline.tiling.borders.boundary_curve import Graph, chains, curve
from scan2sim.pipeline.tiling.borders.clip import Clipped
from scan2sim.pipeline.tiling.borders.common_faces import normals
from scan2sim.pipeline.tiling.borders.grid import world

FACING = 0.1
"""Metres that a normal's turn by 60 degrees counts for where the counterpart of a vertex is looked for."""


class Follow(NamedTuple):
    """How a border is to follow a neighbour's.

    Attributes:
        vertices: (M,) that move.
        places: (M, 3) where to, world metres.
        welds: (W, 2) vertices that become one.
        inserts: (face, a, b, places (N, 3)): new vertices on the edge a-b of a face, in order.
        facts: see `join.join`.
    """

    vertices: I64
    places: F64
    welds: I64
    inserts: list[tuple[int, int, int, F64]]
    facts: dict[str, float]


def follow(name: str, own: Clipped, settled: F64, other: str, theirs: Clipped, there: F64, tolerance: float) -> Follow:
    """How the tile `name` is to follow the border of the tile `other`.

    Args:
        name, own: the tile.
        settled: (V, 3) world places of its vertices, where those in corners have theirs already.
        other, theirs, there: the same of the other tile.
        tolerance: metres that a vertex may be moved.
    """
    mine, yours = curve(own.mesh.faces, own.on[other]), curve(theirs.mesh.faces, theirs.on[name])
    vertices, graph = np.unique(mine.edges), Graph(yours.edges, there)
    partner, distance = _partners(own.mesh, vertices, theirs.mesh, np.unique(yours.edges), there, tolerance)
    corner = vertices[np.sum([on[vertices] for on in own.on.values()], axis=0) > 1]
    vertex_at = {tuple(there[v].tolist()): v for v in np.unique(yours.edges).tolist()}
    for v, place in zip(corner.tolist(), settled[corner].tolist(), strict=True):
        partner.pop(v, None)
        if tuple(place) in vertex_at:
            partner[v] = vertex_at[tuple(place)]
    face_of = {(a, b): f for (a, b), f in zip(mine.edges.tolist(), mine.face.tolist(), strict=True)}
    target: dict[int, int] = {}
    welds, inserts, followed = [], [], 0
    single, count = np.unique(mine.edges, return_counts=True)
    ends = set(single[count == 1].tolist()) - set(corner.tolist())
    for chain in chains(mine.edges, corner.tolist()):
        for found in _runs(chain, partner, distance, graph):
            run, walk, at = _to_the_end(found, ends, graph, tolerance)
            target.update((vertex, walk[i]) for vertex, i in zip(run, at, strict=True))
            followed += len(walk) - 1
            for (a, i), (b, j) in pairwise(zip(run, at, strict=True)):
                if i == j:
                    welds.append((a, b))
                elif j > i + 1:
                    inserts.append((face_of[a, b], a, b, there[walk[i + 1 : j]]))
    moved, to = np.array(list(target), np.int64), there[np.array(list(target.values()), np.int64)]
    shift = np.linalg.norm(to - world(own.mesh)[moved], axis=1)
    facts = {
        "matched": len(moved),
        "unmatched": len(vertices) - len(moved),
        "mean_m": round(float(shift.mean()), 4) if len(shift) else 0.0,
        "max_m": round(float(shift.max()), 4) if len(shift) else 0.0,
        "edges": len(yours.edges),
        "followed": followed,
    }
    return Follow(moved, to, np.array(welds, np.int64).reshape(-1, 2), inserts, facts)


def _partners(
    mesh: Mesh, vertices: I64, other: Mesh, others: I64, there: F64, tolerance: float
) -> tuple[dict[int, int], dict[int, float]]:
    """The nearest of a neighbour's vertices for each, and how far it is; none where that is beyond `tolerance`.

    Nearest in place and normal: of a thin wall's two sides, the right one.
    """
    from scipy.spatial import cKDTree

    if not len(others) or not len(vertices):
        return {}, {}
    xyz = world(mesh)[vertices]
    tree = cKDTree(np.column_stack([there[others], FACING * _vertex_normals(other, others)]))
    _, nearest = tree.query(np.column_stack([xyz, FACING * _vertex_normals(mesh, vertices)]))
    distance = np.linalg.norm(there[others[nearest]] - xyz, axis=1)
    close = distance <= tolerance
    v = vertices[close].tolist()
    return (
        dict(zip(v, others[nearest[close]].tolist(), strict=True)),
        dict(zip(v, distance[close].tolist(), strict=True)),
    )


class Run(NamedTuple):
    """A part of a chain that follows the neighbour's curve.

    Attributes:
        vertices: the own ones.
        walk: the neighbour's, in a row.
        at: each own one's place in the walk: never back.
    """

    vertices: list[int]
    walk: list[int]
    at: list[int]


def _runs(chain: list[int], partner: dict[int, int], distance: dict[int, float], graph: Graph) -> Iterable[Run]:
    """Parts of a chain that follow an edge or more of the neighbour's curve.

    Partners may lie back and forth; the walk goes on only: what it would take back is left out of it, and the
    vertices that led there stay where it turned.
    """
    if chain[0] == chain[-1] and distance:  # a loop begins where it is surest
        first = min(range(len(chain) - 1), key=lambda i: distance.get(chain[i], np.inf))
        chain = [*chain[first:-1], *chain[: first + 1]]
    run = Run([], [], [])
    for vertex in [*chain, -1]:
        to = partner.get(vertex)
        way = graph.way(run.walk[-1], to) if run.walk and to is not None else None
        if way is None:
            if len(run.walk) > 1:
                yield run._replace(at=np.minimum.accumulate(run.at[::-1])[::-1].tolist())
            run = Run([], [] if to is None else [to], [])
        for step in way or ():
            if run.walk[-2:-1] == [step]:
                run.walk.pop()
            else:
                run.walk.append(step)
        if to is not None:
            run.vertices.append(vertex)
            run.at.append(len(run.walk) - 1)


def _to_the_end(run: Run, ends: set[int], graph: Graph, limit: float) -> Run:
    """A run, its walk continued to the ends of the neighbour's curve where it begins or stops at one of `ends`."""
    vertices, walk, at = run
    if vertices[-1] in ends:
        walk = [*walk, *graph.tail(walk[-1], walk[-2], limit)]
        at = [*at[:-1], len(walk) - 1]
    if vertices[0] in ends:
        before = graph.tail(walk[0], walk[1], limit)[::-1]
        walk = [*before, *walk]
        at = [0, *(i + len(before) for i in at[1:])]
    return Run(vertices, walk, at)


def _vertex_normals(mesh: Mesh, vertices: I64) -> F64:
    """(N, 3) unit normals of some of a mesh's vertices."""
    chosen = np.zeros(len(mesh.vertices), bool)
    chosen[vertices] = True
    faces = mesh.faces[chosen[mesh.faces].any(axis=1)]
    normal = np.zeros((len(chosen), 3))
    np.add.at(normal, faces, normals(mesh.vertices[faces].astype(np.float64))[:, None])
    normal = normal[vertices]
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
