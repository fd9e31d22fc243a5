"""Clipping of a mesh to its tile's cell, one border after another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.geometry.common_faces import directed_edges, normals, weld_vertices
from scan2sim.pipeline.geometry.coordinate_grid import local, snap_to_grid, world

BORDER_TOLERANCE_M = 1e-4
"""Distance from a border up to which a vertex counts as lying on it."""
MAX_SLIDE_M = 0.02
"""Distance that a vertex may slide along its edge to the border, where a cut would create a sliver."""
MIN_EDGE_M = 0.002
"""Edges along a border up to this length are collapsed to one vertex."""
MIN_AREA_SHARE = 0.1
"""Share of a face's area, projected along its normal, that sliding must preserve."""


@dataclass(frozen=True)
class Clipped:
    """A mesh clipped to its cell.

    Attributes:
        mesh: mesh that doesn't extend beyond any border.
        on: by neighbour, (V,) whether a vertex is on the border with it; a vertex in a corner is on several borders.
    """

    mesh: Mesh
    on: Mapping[str, Bools]

    def save(self, mesh: Path, on: Path) -> None:
        """Write two .npz files."""
        self.mesh.save(mesh)
        with open(on, "wb") as file:
            np.savez(file, names=np.array(list(self.on), str), on=stacked(self.on, len(self.mesh.vertices)))

    @classmethod
    def load(cls, mesh: Path, on: Path) -> Clipped:
        """Read what `save` wrote."""
        with np.load(on) as data:
            return cls(Mesh.load(mesh), dict(zip(data["names"].tolist(), data["on"].T, strict=True)))


def stacked(on: Mapping[str, Bools], n: int) -> Bools:
    """Masks (n,) as columns of an array (n, names)."""
    return np.stack(list(on.values()), axis=1) if on else np.zeros((n, 0), bool)


def clip(mesh: Mesh, cell: Cell) -> Clipped:
    """Clip a mesh to its tile's cell, one border after another; attributes such as `density` are dropped.

    Edges that cross a border are cut there, once for all their faces. If the cut would be close to a vertex, the vertex
    slides along the edge onto the border instead, to avoid slivers. Faces that are entirely in a border plane are
    removed.
    """
    xyz, faces = world(mesh), mesh.faces.astype(np.int64)
    names = sorted(cell.neighbours)
    on = np.zeros((len(xyz), len(names)), bool)
    for k, name in enumerate(names):
        distance = cell.beyond(name, xyz[:, :2])
        if (distance > -BORDER_TOLERANCE_M).any():
            xyz, faces, on = _cut(xyz, faces, on, distance, k)
    border = on.sum(axis=1) > 0
    xyz[border] = snap_to_grid(xyz[border])
    for max_length in (0.0, MIN_EDGE_M):  # first vertices that coincide, also in corners
        edges = directed_edges(faces[border[faces].sum(axis=1) > 1])
        length = np.linalg.norm(xyz[edges[:, 0]] - xyz[edges[:, 1]], axis=1)
        same = (on[edges[:, 0]] == on[edges[:, 1]]).all(axis=1) & border[edges[:, 0]]
        faces, _, weld = weld_vertices(faces, edges[(length <= max_length) & (same if max_length else True)], len(xyz))
        merged = np.flatnonzero(weld != np.arange(len(xyz)))
        np.logical_or.at(on, weld[merged], on[merged])
    used, faces = np.unique(faces, return_inverse=True)
    xyz, faces, on = xyz[used], faces.reshape(-1, 3), on[used]
    return Clipped(local(mesh.frame, xyz, faces), {name: on[:, k] for k, name in enumerate(names)})


def _cut(xyz: F64, faces: I64, on: Bools, distance: F64, k: int) -> tuple[F64, I64, Bools]:
    """Cut at border `k`; vertices have the signed `distance` (V,) from it, positive beyond."""
    side = np.sign(np.where(np.abs(distance) <= BORDER_TOLERANCE_M, 0, distance)).astype(np.int8)
    xyz, side = _slide_to_border(xyz, faces, on, distance, side)
    on = on.copy()
    on[:, k] = side == 0
    faces = faces[(side[faces] < 0).any(axis=1)]  # drop faces in the border plane or beyond it
    crosses = (side[faces] > 0).any(axis=1)
    a, b, cut = _crossings(faces[crosses], side)
    cut_points = xyz[a] + (distance[a] / (distance[a] - distance[b]))[:, None] * (xyz[b] - xyz[a])
    flags = on[a] & on[b]
    flags[:, k] = True
    cut[cut >= 0] += len(xyz)
    xyz, on = np.concatenate([xyz, cut_points]), np.concatenate([on, flags])
    # polygon of each cut face: its corners on this side and the cut points of its edges, in order
    kept = np.where(side[faces[crosses]] <= 0, faces[crosses], -1)
    ring = np.stack([kept, cut], axis=2).reshape(-1, 6)
    ring = np.take_along_axis(ring, np.argsort(ring < 0, axis=1, kind="stable"), axis=1)[:, :4]
    return xyz, np.concatenate([faces[~crosses], _fans(xyz, ring)]), on


def _crossings(faces: I64, side: npt.NDArray[np.int8]) -> tuple[I64, I64, I64]:
    """Edges that cross the border: both ends, and (F, 3) index of each face's edges into them, or -1."""
    edges = np.sort(directed_edges(faces), axis=1)
    across = side[edges[:, 0]] * side[edges[:, 1]] < 0
    ends, inverse = np.unique(edges[across], axis=0, return_inverse=True)
    index = np.full(len(edges), -1)
    index[across] = inverse.ravel()
    return ends[:, 0], ends[:, 1], index.reshape(3, -1).T


def _fans(xyz: F64, ring: I64) -> I64:
    """Triangulate polygons (F, 4), with -1 as fourth corner of triangles; quads are split by their shorter diagonal."""
    quad = ring[ring[:, 3] >= 0]
    corners = xyz[quad]
    first, second = (np.linalg.norm(corners[:, i] - corners[:, i + 2], axis=1) for i in (0, 1))
    other = first > second
    quad[other] = np.roll(quad[other], -1, axis=1)
    return np.concatenate([ring[ring[:, 3] < 0, :3], quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def _slide_to_border(
    xyz: F64, faces: I64, on: Bools, distance: F64, side: npt.NDArray[np.int8]
) -> tuple[F64, npt.NDArray[np.int8]]:
    """Slide vertices close to a border onto it along an edge that crosses it; returns new positions and sides.

    A vertex that is already on borders slides only along edges in these. Vertices don't slide if that would flip a
    face, degenerate it or put it into the border plane.
    """
    at = faces[(side[faces] < 0).any(axis=1)]
    a, b, _ = _crossings(at[(side[at] > 0).any(axis=1)], side)
    share = distance[a] / (distance[a] - distance[b])
    crossings = xyz[a] + share[:, None] * (xyz[b] - xyz[a])
    slide = np.concatenate([share, 1 - share]) * np.tile(np.linalg.norm(xyz[b] - xyz[a], axis=1), 2)
    vertex, other, target = np.concatenate([a, b]), np.concatenate([b, a]), np.concatenate([crossings, crossings])
    may = (slide <= MAX_SLIDE_M) & (np.concatenate([share, 1 - share]) <= 0.5) & (on[vertex] <= on[other]).all(axis=1)
    vertex, target, slide = vertex[may], target[may], slide[may]
    order = np.lexsort((slide, vertex))  # each vertex by its shortest slide
    vertex, first = np.unique(vertex[order], return_index=True)
    target = target[order][first]

    moves = np.zeros(len(xyz), bool)
    moves[vertex] = True
    at = at[moves[at].any(axis=1)]
    before = normals(xyz[at])
    while len(vertex):
        slid, sides = xyz.copy(), side.copy()
        slid[vertex], sides[vertex] = target, 0
        matters = (sides[at] < 0).any(axis=1) | (sides[at] == 0).all(axis=1)
        kept = np.einsum("ij,ij->i", normals(slid[at]), before) > MIN_AREA_SHARE * np.einsum("ij,ij->i", before, before)
        bad = np.zeros(len(xyz), bool)
        bad[at[matters & (~kept | (sides[at] == 0).all(axis=1))]] = True
        if not bad[vertex].any():
            return slid, sides
        vertex, target = vertex[~bad[vertex]], target[~bad[vertex]]
    return xyz, side
