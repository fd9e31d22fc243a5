"""Matching of a tile's boundary curve to that of a neighbour, vertex by vertex."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Mesh
from scan2sim.pipeline.geometry.boundary_curve import Graph, chains, curve
from scan2sim.pipeline.geometry.common_faces import normals
from scan2sim.pipeline.geometry.coordinate_grid import world
from scan2sim.pipeline.tiling.borders.clip import Clipped

NORMAL_WEIGHT_M = 0.1
"""Weight of normals in the search for counterparts: metres that a difference of 60 degrees corresponds to."""


class BorderMatch(NamedTuple):
    """Changes that make a boundary curve coincide with a neighbour's.

    Attributes:
        vertices: (M,) vertices that move.
        positions: (M, 3) their new positions, world metres.
        welds: (W, 2) pairs of vertices to weld.
        inserts: (face, a, b, positions (N, 3)): new vertices on the edge a-b of a face, in order.
        metrics: see `join.join`.
    """

    vertices: I64
    positions: F64
    welds: I64
    inserts: list[tuple[int, int, int, F64]]
    metrics: dict[str, float]


def match_border(
    name: str, own: Clipped, own_xyz: F64, other: str, theirs: Clipped, their_xyz: F64, tolerance: float
) -> BorderMatch:
    """Match the boundary curve of the tile `name` to that of the tile `other`.

    Args:
        name, own: the tile.
        own_xyz: (V, 3) world positions of its vertices, with final positions of vertices in corners.
        other, theirs, their_xyz: the same of the other tile.
        tolerance: maximum displacement of a vertex, metres.
    """
    own_curve, their_curve = curve(own.mesh.faces, own.on[other]), curve(theirs.mesh.faces, theirs.on[name])
    vertices, graph = np.unique(own_curve.edges), Graph(their_curve.edges, their_xyz)
    their_vertices = np.unique(their_curve.edges)
    partner, distance = _partners(own.mesh, vertices, theirs.mesh, their_vertices, their_xyz, tolerance)
    corner = vertices[np.sum([on[vertices] for on in own.on.values()], axis=0) > 1]
    vertex_at = {tuple(their_xyz[v].tolist()): v for v in their_vertices.tolist()}
    for v, position in zip(corner.tolist(), own_xyz[corner].tolist(), strict=True):
        partner.pop(v, None)
        if tuple(position) in vertex_at:
            partner[v] = vertex_at[tuple(position)]
    face_of = {(a, b): f for (a, b), f in zip(own_curve.edges.tolist(), own_curve.face.tolist(), strict=True)}
    target: dict[int, int] = {}
    welds, inserts, followed = [], [], 0
    single, count = np.unique(own_curve.edges, return_counts=True)
    ends = set(single[count == 1].tolist()) - set(corner.tolist())
    for chain in chains(own_curve.edges, corner.tolist()):
        for found in _runs(chain, partner, distance, graph):
            run, walk, at = _extend_to_ends(found, ends, graph, tolerance)
            target.update((vertex, walk[i]) for vertex, i in zip(run, at, strict=True))
            followed += len(walk) - 1
            for (a, i), (b, j) in pairwise(zip(run, at, strict=True)):
                if i == j:
                    welds.append((a, b))
                elif j > i + 1:
                    inserts.append((face_of[a, b], a, b, their_xyz[walk[i + 1 : j]]))
    moved, to = np.array(list(target), np.int64), their_xyz[np.array(list(target.values()), np.int64)]
    shift = np.linalg.norm(to - world(own.mesh)[moved], axis=1)
    facts = {
        "matched": len(moved),
        "unmatched": len(vertices) - len(moved),
        "mean_m": round(float(shift.mean()), 4) if len(shift) else 0.0,
        "max_m": round(float(shift.max()), 4) if len(shift) else 0.0,
        "edges": len(their_curve.edges),
        "followed": followed,
    }
    return BorderMatch(moved, to, np.array(welds, np.int64).reshape(-1, 2), inserts, facts)


def _partners(
    mesh: Mesh, vertices: I64, other: Mesh, others: I64, their_xyz: F64, tolerance: float
) -> tuple[dict[int, int], dict[int, float]]:
    """Nearest vertex of the neighbour for each vertex, and its distance; no entry beyond `tolerance`.

    Nearest in position and normal, to match the correct side of a thin wall.
    """
    from scipy.spatial import cKDTree

    if not len(others) or not len(vertices):
        return {}, {}
    xyz = world(mesh)[vertices]
    tree = cKDTree(np.column_stack([their_xyz[others], NORMAL_WEIGHT_M * _vertex_normals(other, others)]))
    _, nearest = tree.query(np.column_stack([xyz, NORMAL_WEIGHT_M * _vertex_normals(mesh, vertices)]))
    distance = np.linalg.norm(their_xyz[others[nearest]] - xyz, axis=1)
    close = distance <= tolerance
    v = vertices[close].tolist()
    return (
        dict(zip(v, others[nearest[close]].tolist(), strict=True)),
        dict(zip(v, distance[close].tolist(), strict=True)),
    )


class Run(NamedTuple):
    """A part of a chain that follows the neighbour's curve.

    Attributes:
        vertices: own vertices.
        walk: consecutive vertices of the neighbour.
        at: index of each own vertex in the walk, ascending.
    """

    vertices: list[int]
    walk: list[int]
    at: list[int]


def _runs(chain: list[int], partner: dict[int, int], distance: dict[int, float], graph: Graph) -> Iterable[Run]:
    """Parts of a chain that follow at least one edge of the neighbour's curve.

    Partners may alternate back and forth, but the walk only advances: it omits detours that are walked back, and the
    vertices of these get the position where the walk turned around.
    """
    if chain[0] == chain[-1] and distance:  # a loop starts at its best match
        first = min(range(len(chain) - 1), key=lambda i: distance.get(chain[i], np.inf))
        chain = [*chain[first:-1], *chain[: first + 1]]
    run = Run([], [], [])
    for vertex in [*chain, -1]:
        to = partner.get(vertex)
        path = graph.shortest_path(run.walk[-1], to) if run.walk and to is not None else None
        if path is None:
            if len(run.walk) > 1:
                yield run._replace(at=np.minimum.accumulate(run.at[::-1])[::-1].tolist())
            run = Run([], [] if to is None else [to], [])
        for step in path or ():
            if run.walk[-2:-1] == [step]:
                run.walk.pop()
            else:
                run.walk.append(step)
        if to is not None:
            run.vertices.append(vertex)
            run.at.append(len(run.walk) - 1)


def _extend_to_ends(run: Run, ends: set[int], graph: Graph, limit: float) -> Run:
    """Extend a run's walk to the ends of the neighbour's curve if the run starts or ends at one of `ends`."""
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
    """Unit normals (N, 3) of the given vertices of a mesh."""
    chosen = np.zeros(len(mesh.vertices), bool)
    chosen[vertices] = True
    faces = mesh.faces[chosen[mesh.faces].any(axis=1)]
    normal = np.zeros((len(chosen), 3))
    np.add.at(normal, faces, normals(mesh.vertices[faces].astype(np.float64))[:, None])
    normal = normal[vertices]
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
