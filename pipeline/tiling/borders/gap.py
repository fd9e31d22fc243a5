"""Measurement of the gap between two finished meshes at their common border."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Mesh
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.geometry.boundary_curve import curve
from scan2sim.pipeline.geometry.coordinate_grid import world

MAX_COUNTERPART_M = 0.3
"""Distance up to which points of two boundary curves are counterparts."""
SAMPLE_SPACING_M = 0.01
"""Spacing of the points at which the gap is measured."""


@dataclass(frozen=True)
class Gap:
    """Gap between two meshes at their border.

    Attributes:
        length_m: length of the border, mean of both meshes.
        one_sided_m: length, of both meshes, without a counterpart within 0.3 m or beyond the end of the other's curve.
        shared: share of both meshes' border edges that both have, bit-identical.
        max_m, p99_m, mean_m: distance to the other's curve, where there is a counterpart.
        crack_m2: area between both curves, where there is a counterpart.
        overlap_m: maximum extent of a mesh beyond the border.
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
    """Measure the gap between the mesh `a` of a cell and `b` of its neighbour, at every centimetre of both curves.

    The curves are the open edges with both ends within a millimetre of the border.
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
        [_distances(sides[0], sides[1], known[1]), _distances(sides[1], sides[0], known[0])], axis=1
    )
    paired = distance <= MAX_COUNTERPART_M
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


def _distances(side: F64, other: F64, known: set[frozenset[Any]]) -> F64:
    """Distance to the edges `other` and represented length (2, N), of points every centimetre on `side` (E, 2, 3).

    Edges that are also among the `known` ones of the other have distance 0. Points beyond the end of the other's curve
    have no counterpart: their distance is infinite.
    """
    from scipy.spatial import cKDTree

    same = np.array([frozenset((tuple(p), tuple(q))) in known for p, q in side.tolist()], bool)
    points, length, edge = _sample_edges(side)
    distance = np.zeros(len(points))
    unshared = np.flatnonzero(~same[edge])
    if not len(other):
        distance[:] = np.inf
    elif len(unshared):
        other_points, _, other_edge = _sample_edges(other)
        k = min(8, len(other_points))
        _, nearest = cKDTree(other_points).query(points[unshared], k=k)
        p, q = np.moveaxis(other[other_edge[nearest.reshape(-1, k)]], 2, 0)  # (N, k, 3) ends of the nearest edges
        direction = q - p
        square = np.maximum(np.einsum("ijk,ijk->ij", direction, direction), 1e-30)
        along = np.clip(np.einsum("ijk,ijk->ij", points[unshared, None] - p, direction) / square, 0, 1)
        to_edge = np.linalg.norm(points[unshared, None] - p - along[..., None] * direction, axis=2)
        best = np.arange(len(unshared)), to_edge.argmin(axis=1)
        _, node, degree = np.unique(other.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
        ends = (degree == 1)[node.reshape(-1, 2)[other_edge[nearest.reshape(-1, k)]]][best]  # (N, 2) of that edge
        past = (ends[:, 0] & (along[best] == 0)) | (ends[:, 1] & (along[best] == 1))
        distance[unshared] = np.where(past, np.inf, to_edge[best])
    return np.stack([distance, length])


def _sample_edges(edges: F64) -> tuple[F64, F64, I64]:
    """Points every centimetre along edges (E, 2, 3), the length that each represents, and its edge."""
    length = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1)
    count = np.maximum(1, np.rint(length / SAMPLE_SPACING_M)).astype(np.int64)
    edge = np.repeat(np.arange(len(edges)), count)
    order = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    share = ((order + 0.5) / count[edge])[:, None]
    return edges[edge, 0] * (1 - share) + edges[edge, 1] * share, (length / count)[edge], edge
