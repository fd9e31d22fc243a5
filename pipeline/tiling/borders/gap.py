"""Gap: what lies between two finished meshes at their border."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Mesh
from scan2sim.pipeline.tiling.borders.boundary_curve import curve
from scan2sim.pipeline.tiling.borders.grid import world
from scan2sim.pipeline.tiling.voronoi_cell import Cell

COUNTERPART = 0.3
"""Metres within which two borders are parts of one, for the measure."""
STEP = 0.01
"""Metres between the places at which a gap is measured."""


@dataclass(frozen=True)
class Gap:
    """What lies between two meshes at their border.

    Attributes:
        length_m: of the border, the mean of both meshes'.
        one_sided_m: of both, length without any counterpart within 0.3 m, or beyond the end of the other's border.
        shared: share of both meshes' border edges that both have, vertex for vertex and bit for bit.
        max_m, p99_m, mean_m: distance to the other's border, of what has a counterpart.
        crack_m2: area between the two, of what has a counterpart.
        overlap_m: how far one of them reaches beyond the border at most.
    """

    length_m: float
    one_sided_m: float
    shared: float
    max_m: float
    p99_m: float
    mean_m: float
    crack_m2: float
    overlap_m: float


def gap(a: Mesh, b: Mesh, cell: Cell, neighbour: str) -> Gap:
    """Walk the border between the mesh `a` of a cell and `b` of its neighbour, every centimetre of both.

    Edges of one face alone whose both ends lie within a millimetre of the border count.
    """
    sides = []
    overlap = 0.0
    for mesh, sign in ((a, 1), (b, -1)):
        xyz = world(mesh)
        distance = sign * cell.beyond(neighbour, xyz[:, :2])
        overlap = max(overlap, float(distance.max(initial=0.0)))
        sides.append(xyz[curve(mesh.faces, np.abs(distance) < 1e-3).edges])
    known = [{frozenset((tuple(p), tuple(q))) for p, q in side.tolist()} for side in sides]
    lengths = [float(np.linalg.norm(side[:, 0] - side[:, 1], axis=1).sum()) for side in sides]
    distance, length = np.concatenate(
        [_apart(sides[0], sides[1], known[1]), _apart(sides[1], sides[0], known[0])], axis=1
    )
    paired = distance <= COUNTERPART
    edges = len(sides[0]) + len(sides[1])
    return Gap(
        length_m=sum(lengths) / 2,
        one_sided_m=float(length[~paired].sum()),
        shared=2 * len(known[0] & known[1]) / edges if edges else 1.0,
        max_m=float(distance[paired].max(initial=0.0)),
        p99_m=float(np.percentile(distance[paired], 99)) if paired.any() else 0.0,
        mean_m=float(np.average(distance[paired], weights=length[paired])) if paired.any() else 0.0,
        crack_m2=float((distance * length)[paired].sum() / 2),
        overlap_m=overlap,
    )


def _apart(side: F64, other: F64, known: set[frozenset[Any]]) -> F64:
    """(2, N) of places every centimetre along edges `side` (E, 2, 3): distance to edges `other`, length stood for.

    Edges among the `known` ones of the other are at no distance at all. Where the other's border ends, what goes on
    has no counterpart: its distance is infinite.
    """
    from scipy.spatial import cKDTree

    same = np.array([frozenset((tuple(p), tuple(q))) in known for p, q in side.tolist()], bool)
    places, length, edge = _along(side)
    distance = np.zeros(len(places))
    apart = np.flatnonzero(~same[edge])
    if not len(other):
        distance[:] = np.inf
    elif len(apart):
        there, _, there_edge = _along(other)
        k = min(8, len(there))
        _, nearest = cKDTree(there).query(places[apart], k=k)
        p, q = np.moveaxis(other[there_edge[nearest.reshape(-1, k)]], 2, 0)  # (N, k, 3) ends of the nearest edges
        way = q - p
        square = np.maximum(np.einsum("ijk,ijk->ij", way, way), 1e-30)
        along = np.clip(np.einsum("ijk,ijk->ij", places[apart, None] - p, way) / square, 0, 1)
        away = np.linalg.norm(places[apart, None] - p - along[..., None] * way, axis=2)
        best = np.arange(len(apart)), away.argmin(axis=1)
        _, node, degree = np.unique(other.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
        ends = (degree == 1)[node.reshape(-1, 2)[there_edge[nearest.reshape(-1, k)]]][best]  # (N, 2) of that edge
        past = (ends[:, 0] & (along[best] == 0)) | (ends[:, 1] & (along[best] == 1))
        distance[apart] = np.where(past, np.inf, away[best])
    return np.stack([distance, length])


def _along(edges: F64) -> tuple[F64, F64, I64]:
    """Places every centimetre along edges (E, 2, 3), the length that each stands for, and its edge."""
    length = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1)
    count = np.maximum(1, np.rint(length / STEP)).astype(np.int64)
    edge = np.repeat(np.arange(len(edges)), count)
    order = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    share = ((order + 0.5) / count[edge])[:, None]
    return edges[edge, 0] * (1 - share) + edges[edge, 1] * share, (length / count)[edge], edge
