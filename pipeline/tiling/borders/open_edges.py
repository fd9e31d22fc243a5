"""Rims: the open edges of a tile's mesh that are no border with another tile, and can be thinned.

Libraries that decimate keep all open edges or none. Here every rim is closed by a cone first, whose tip lies far off
along the surface's normal: what is open still, and so is kept, are the borders. A cone's faces stand upright on the
surface, and hold the rim's shape, as Garland and Heckbert (1997, section 6) do with planes across boundaries.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.decimation import simplify
from scan2sim.pipeline.tiling.borders.boundary_curve import Curve, chains, curve
from scan2sim.pipeline.tiling.borders.common_faces import normals
from scan2sim.pipeline.tiling.borders.grid import world
from scan2sim.pipeline.tiling.voronoi_cell import Cell

ON = 2e-3
"""Metres from a border within which a vertex counts as lying on it."""
FAR = 1e4
"""Metres from a rim to its cone's tip; tiles are below 2 km."""
ENOUGH, ROUNDS = 0.85, 5
"""Share of the target that will do, and further tries at reaching it."""


def on_border(mesh: Mesh, cell: Cell | None) -> Bools:
    """(V,) which vertices lie on a border of the tile's cell."""
    on = np.zeros(len(mesh.vertices), bool)
    if cell is not None:
        xy = world(mesh)[:, :2]
        for name in cell.neighbours:
            on |= np.abs(cell.beyond(name, xy)) <= ON
    return on


def thinned(mesh: Mesh, target: int, on: Bools) -> Mesh:
    """A mesh with at most `target` faces, its borders as they are; attributes are dropped.

    It has more where its borders need them. A surface all in crumbs keeps its rims as well, where it has borders.

    Args:
        mesh, target: what is thinned, and how many faces it may have.
        on: (V,) which vertices lie on borders (`on_border`): open edges between them are those that stay.
    """
    if len(mesh) <= target:
        return Mesh(mesh.frame, mesh.vertices, mesh.faces)
    tips, cones = _cones(mesh, _rims(mesh, on))
    vertices = np.concatenate([mesh.vertices, tips]).astype(np.float32)
    closed = Mesh(mesh.frame, vertices, np.concatenate([mesh.faces, cones]).astype(np.int32))
    best, wanted = _opened(simplify(closed, target)), target
    for _ in range(ROUNDS):  # cones take a share of the faces that shows only then
        if len(best) >= ENOUGH * target:
            break
        wanted += target - len(best)
        more = _opened(simplify(closed, wanted))
        if len(more) > target:
            break
        best = more
    if len(best) < target / 2:  # crumbs, which cones would swallow
        return simplify(mesh, target, keep_border=bool(on.any()))
    return best


def _opened(mesh: Mesh) -> Mesh:
    """A mesh without its cones."""
    far = np.abs(mesh.corners).max(axis=(1, 2), initial=0) > FAR / 2
    return mesh.keep(~far)


def _rims(mesh: Mesh, on: Bools) -> Curve:
    """The open edges that don't run along a border, `on` (V,) which vertices lie."""
    opened = curve(mesh.faces, np.ones(len(mesh.vertices), bool))
    rim = ~on[opened.edges].all(axis=1)
    return Curve(opened.edges[rim], opened.face[rim])


def _cones(mesh: Mesh, rims: Curve) -> tuple[F64, I64]:
    """Tips (K, 3) of cones over all rims, and their faces (E, 3), which count tips on from the mesh's vertices."""
    xyz = mesh.vertices.astype(np.float64)
    normal = normals(xyz[mesh.faces])
    beside = {(a, b): face for (a, b), face in zip(rims.edges.tolist(), rims.face.tolist(), strict=True)}
    tips, faces = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
    for i, chain in enumerate(chains(rims.edges)):
        a, b = np.array(chain[:-1]), np.array(chain[1:])
        across = normal[[beside[edge] for edge in pairwise(chain)]].sum(axis=0)
        length = float(np.linalg.norm(across))
        direction = across / length if length > 0 else np.array([0.0, 0.0, 1.0])
        tips.append((xyz[chain].mean(axis=0) + FAR * direction)[None])
        faces.append(np.column_stack([b, a, np.full(len(a), len(xyz) + i)]))
    return np.concatenate(tips), np.concatenate(faces)
