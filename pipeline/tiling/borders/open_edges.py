"""Decimation that keeps a tile's borders and simplifies its other open boundary edges.

Decimation libraries preserve either all open edges or none. Therefore each open boundary that is not a border with
another tile is first closed by a cone, whose tip is far away along the surface's normal: the edges that are still open,
and so preserved, are the borders. The cone's faces are perpendicular to the surface and preserve the shape of the
boundary, like the constraint planes of Garland and Heckbert (1997, section 6).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.decimation import simplify
from scan2sim.pipeline.geometry.boundary_curve import Curve, chains, curve
from scan2sim.pipeline.geometry.common_faces import normals
from scan2sim.pipeline.geometry.coordinate_grid import world

BORDER_TOLERANCE_M = 2e-3
"""Distance from a border up to which a vertex counts as lying on it."""
ROUNDING_M = 5e-4
"""Distance beyond a border that rounding of coordinates explains."""
CONE_HEIGHT_M = 1e4
"""Distance of a cone's tip from its base; far more than the size of a tile (below 2 km)."""
MIN_TARGET_SHARE, MAX_RETRIES = 0.85, 5
"""Share of the target number of faces that is sufficient, and retries to reach it."""


def on_border(mesh: Mesh, cell: Cell | None) -> Bools:
    """Whether each vertex (V,) is on a border of the tile's cell."""
    on = np.zeros(len(mesh.vertices), bool)
    if cell is not None:
        xy = world(mesh)[:, :2]
        for name in cell.neighbours:
            on |= np.abs(cell.beyond(name, xy)) <= BORDER_TOLERANCE_M
    return on


def decimate_keeping_borders(mesh: Mesh, target: int, on: Bools) -> Mesh:
    """Decimate a mesh to at most `target` faces with unchanged borders; attributes are dropped.

    It has more faces if its borders need them. A very fragmented surface with borders keeps all its open edges.

    Args:
        mesh: the mesh.
        target: maximum number of faces.
        on: (V,) whether each vertex is on a border (`on_border`); open edges between such vertices are preserved.
    """
    if len(mesh) <= target:
        return Mesh(mesh.frame, mesh.vertices, mesh.faces)
    tips, cones = _cones(mesh, _free_boundaries(mesh, on))
    vertices = np.concatenate([mesh.vertices, tips]).astype(np.float32)
    closed = Mesh(mesh.frame, vertices, np.concatenate([mesh.faces, cones]).astype(np.int32))
    best, requested = _without_cones(simplify(closed, target)), target
    for _ in range(MAX_RETRIES):  # the number of faces that the cones take is known only after decimation
        if len(best) >= MIN_TARGET_SHARE * target:
            break
        requested += target - len(best)
        result = _without_cones(simplify(closed, requested))
        if len(result) > target:
            break
        best = result
    if len(best) < target / 2:  # many small fragments, for which cones take most faces
        return simplify(mesh, target, keep_border=bool(on.any()))
    return best


def pulled_inside(mesh: Mesh, cell: Cell) -> Mesh:
    """A mesh whose vertices beyond a border of the cell, where decimation has put them, are moved onto the border."""
    xy, moved = world(mesh)[:, :2], np.zeros((len(mesh.vertices), 2))
    for name, seed in cell.neighbours.items():
        distance = cell.beyond(name, xy + moved)
        normal = np.subtract(seed, cell.seed) / np.linalg.norm(np.subtract(seed, cell.seed))
        moved -= np.where(distance > ROUNDING_M, distance, 0)[:, None] * normal
    vertices = mesh.vertices.copy()
    vertices[:, :2] += moved.astype(np.float32)
    return replace(mesh, vertices=vertices)


def _without_cones(mesh: Mesh) -> Mesh:
    """A mesh without its cones."""
    far = np.abs(mesh.corners).max(axis=(1, 2), initial=0) > CONE_HEIGHT_M / 2
    return mesh.keep(~far)


def _free_boundaries(mesh: Mesh, on: Bools) -> Curve:
    """The open edges that aren't on a border; `on` (V,) marks vertices on borders."""
    open_edges = curve(mesh.faces, np.ones(len(mesh.vertices), bool))
    free = ~on[open_edges.edges].all(axis=1)
    return Curve(open_edges.edges[free], open_edges.face[free])


def _cones(mesh: Mesh, boundaries: Curve) -> tuple[F64, I64]:
    """Tips (K, 3) of cones over all boundaries, and their faces (E, 3); tips are numbered after the mesh's vertices."""
    xyz = mesh.vertices.astype(np.float64)
    normal = normals(xyz[mesh.faces])
    face_of = {(a, b): face for (a, b), face in zip(boundaries.edges.tolist(), boundaries.face.tolist(), strict=True)}
    tips, faces = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
    for i, chain in enumerate(chains(boundaries.edges)):
        a, b = np.array(chain[:-1]), np.array(chain[1:])
        normal_sum = normal[[face_of[edge] for edge in pairwise(chain)]].sum(axis=0)
        length = float(np.linalg.norm(normal_sum))
        direction = normal_sum / length if length > 0 else np.array([0.0, 0.0, 1.0])
        tips.append((xyz[chain].mean(axis=0) + CONE_HEIGHT_M * direction)[None])
        faces.append(np.column_stack([b, a, np.full(len(a), len(xyz) + i)]))
    return np.concatenate(tips), np.concatenate(faces)
