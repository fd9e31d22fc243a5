"""Clip: a mesh cut to its tile's cell, border after border."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.tiling.borders.common_faces import directed_edges, normals, welded
from scan2sim.pipeline.tiling.borders.grid import local, on_grid, world
from scan2sim.pipeline.tiling.voronoi_cell import Cell

ON = 1e-4
"""Metres from a border within which a vertex counts as lying on it."""
SNAP = 0.02
"""Metres that a vertex may slide along its edge to the border, where a cut would leave a sliver."""
SHORT = 0.002
"""Metres: edges along a border that are no longer become one vertex."""
LEAST = 0.1
"""Share of a face's area that sliding must leave, seen in the direction of its normal."""


@dataclass(frozen=True)
class Clipped:
    """A mesh cut to its cell.

    Attributes:
        mesh: nothing of it reaches beyond a border.
        on: neighbour's name to (V,): the vertex lies on the border with it; one in a corner lies on several.
    """

    mesh: Mesh
    on: Mapping[str, Bools]

    def save(self, mesh: Path, on: Path) -> None:
        """Write as two .npz."""
        self.mesh.save(mesh)
        with open(on, "wb") as file:
            np.savez(file, names=np.array(list(self.on), str), on=stacked(self.on, len(self.mesh.vertices)))

    @classmethod
    def load(cls, mesh: Path, on: Path) -> Clipped:
        """Read what `save` wrote."""
        with np.load(on) as data:
            return cls(Mesh.load(mesh), dict(zip(data["names"].tolist(), data["on"].T, strict=True)))


def stacked(on: Mapping[str, Bools], n: int) -> Bools:
    """(n, names)."""
    return np.stack(list(on.values()), axis=1) if on else np.zeros((n, 0), bool)


def clip(mesh: Mesh, cell: Cell) -> Clipped:
    """Cut a mesh to its tile's cell, border after border; `density` and the like are dropped.

    Edges that cross a border are cut there, once for all their faces. Where the cut would come close to a vertex,
    the vertex slides along the edge onto the border instead, so that no slivers arise. Faces that lie in a border
    altogether go.
    """
    xyz, faces = world(mesh), mesh.faces.astype(np.int64)
    names = sorted(cell.neighbours)
    on = np.zeros((len(xyz), len(names)), bool)
    for k, name in enumerate(names):
        distance = cell.beyond(name, xyz[:, :2])
        if (distance > -ON).any():
            xyz, faces, on = _cut(xyz, faces, on, distance, k)
    border = on.sum(axis=1) > 0
    xyz[border] = on_grid(xyz[border])
    for short in (0.0, SHORT):  # first those that have come to lie in one place, be it a corner
        edges = directed_edges(faces[border[faces].sum(axis=1) > 1])
        length = np.linalg.norm(xyz[edges[:, 0]] - xyz[edges[:, 1]], axis=1)
        same = (on[edges[:, 0]] == on[edges[:, 1]]).all(axis=1) & border[edges[:, 0]]
        faces, _, weld = welded(faces, edges[(length <= short) & (same if short else True)], len(xyz))
        gone = np.flatnonzero(weld != np.arange(len(xyz)))
        np.logical_or.at(on, weld[gone], on[gone])
    used, faces = np.unique(faces, return_inverse=True)
    xyz, faces, on = xyz[used], faces.reshape(-1, 3), on[used]
    return Clipped(local(mesh.frame, xyz, faces), {name: on[:, k] for k, name in enumerate(names)})


def _cut(xyz: F64, faces: I64, on: Bools, distance: F64, k: int) -> tuple[F64, I64, Bools]:
    """Cut at border `k`, which vertices lie `distance` (V,) beyond."""
    side = np.sign(np.where(np.abs(distance) <= ON, 0, distance)).astype(np.int8)
    xyz, side = _slid(xyz, faces, on, distance, side)
    on = on.copy()
    on[:, k] = side == 0
    faces = faces[(side[faces] < 0).any(axis=1)]  # not those in the border or beyond it
    crosses = (side[faces] > 0).any(axis=1)
    a, b, cut = _crossings(faces[crosses], side)
    places = xyz[a] + (distance[a] / (distance[a] - distance[b]))[:, None] * (xyz[b] - xyz[a])
    flags = on[a] & on[b]
    flags[:, k] = True
    cut[cut >= 0] += len(xyz)
    xyz, on = np.concatenate([xyz, places]), np.concatenate([on, flags])
    # round each cut face: its corners on this side, and the cuts of its edges, in order
    kept = np.where(side[faces[crosses]] <= 0, faces[crosses], -1)
    ring = np.stack([kept, cut], axis=2).reshape(-1, 6)
    ring = np.take_along_axis(ring, np.argsort(ring < 0, axis=1, kind="stable"), axis=1)[:, :4]
    return xyz, np.concatenate([faces[~crosses], _fans(xyz, ring)]), on


def _crossings(faces: I64, side: npt.NDArray[np.int8]) -> tuple[I64, I64, I64]:
    """Edges that cross: both ends, and (F, 3) each face's (first corner to second, ...) index into them, or -1."""
    edges = np.sort(directed_edges(faces), axis=1)
    across = side[edges[:, 0]] * side[edges[:, 1]] < 0
    ends, inverse = np.unique(edges[across], axis=0, return_inverse=True)
    index = np.full(len(edges), -1)
    index[across] = inverse.ravel()
    return ends[:, 0], ends[:, 1], index.reshape(3, -1).T


def _fans(xyz: F64, ring: I64) -> I64:
    """Triangles of polygons (F, 4), the fourth corner -1 where there are but three; quads by their shorter diagonal."""
    quad = ring[ring[:, 3] >= 0]
    corners = xyz[quad]
    first, second = (np.linalg.norm(corners[:, i] - corners[:, i + 2], axis=1) for i in (0, 1))
    other = first > second
    quad[other] = np.roll(quad[other], -1, axis=1)
    return np.concatenate([ring[ring[:, 3] < 0, :3], quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def _slid(
    xyz: F64, faces: I64, on: Bools, distance: F64, side: npt.NDArray[np.int8]
) -> tuple[F64, npt.NDArray[np.int8]]:
    """Vertices close to a border slid onto it along one of their edges that cross it; new places and sides.

    A vertex that lies on borders already slides along edges in those alone. None slides that would turn a face
    over, shrink it to nothing or lay it into the border.
    """
    at = faces[(side[faces] < 0).any(axis=1)]
    a, b, _ = _crossings(at[(side[at] > 0).any(axis=1)], side)
    share = distance[a] / (distance[a] - distance[b])
    places = xyz[a] + share[:, None] * (xyz[b] - xyz[a])
    way = np.concatenate([share, 1 - share]) * np.tile(np.linalg.norm(xyz[b] - xyz[a], axis=1), 2)
    vertex, other, place = np.concatenate([a, b]), np.concatenate([b, a]), np.concatenate([places, places])
    may = (way <= SNAP) & (np.concatenate([share, 1 - share]) <= 0.5) & (on[vertex] <= on[other]).all(axis=1)
    vertex, place, way = vertex[may], place[may], way[may]
    order = np.lexsort((way, vertex))  # each along its shortest way
    vertex, first = np.unique(vertex[order], return_index=True)
    place = place[order][first]

    moves = np.zeros(len(xyz), bool)
    moves[vertex] = True
    at = at[moves[at].any(axis=1)]
    before = normals(xyz[at])
    while len(vertex):
        slid, sides = xyz.copy(), side.copy()
        slid[vertex], sides[vertex] = place, 0
        matters = (sides[at] < 0).any(axis=1) | (sides[at] == 0).all(axis=1)
        kept = np.einsum("ij,ij->i", normals(slid[at]), before) > LEAST * np.einsum("ij,ij->i", before, before)
        bad = np.zeros(len(xyz), bool)
        bad[at[matters & (~kept | (sides[at] == 0).all(axis=1))]] = True
        if not bad[vertex].any():
            return slid, sides
        vertex, place = vertex[~bad[vertex]], place[~bad[vertex]]
    return xyz, side
