"""Upright faces of which only one side is surface: what a scanner saw from one side."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from scan2sim.pipeline.core.types import Bools, Mesh

UPRIGHT = 0.5
"""Largest absolute z of an upright face's unit normal: 30 degrees from the vertical."""
THICKNESS_M = 4.0
"""Within this distance behind a face, the other side of a wall, vehicle or tree closes it; houses may be hollow."""
OFFSET_M = 1e-3
"""Distance behind a face at which its ray begins, so that it doesn't hit the face itself."""


def open_backs(mesh: Mesh, around: Iterable[Mesh]) -> Bools:
    """Upright faces without a surface behind them that faces away: from behind they are seen through.

    A ray from each face's centre, against its normal, must leave a body within `THICKNESS_M`, by the back of a face.

    Args:
        mesh: the faces, metres, z up.
        around: all surfaces there in the same frame, with `mesh` among them.

    Returns:
        (F,) bool.
    """
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    for one in around:
        if len(one):
            scene.add_triangles(one.vertices, one.faces.astype(np.uint32))
    normal = mesh.face_normal
    upright = (np.abs(normal[:, 2]) < UPRIGHT) & (np.abs(normal).sum(axis=1) > 0)
    backwards = -normal[upright]
    start = mesh.corners[upright].mean(axis=1) + OFFSET_M * backwards
    hit = scene.cast_rays(np.concatenate([start, backwards], axis=1).astype(np.float32))
    leaves = np.sum(hit["primitive_normals"].numpy() * backwards, axis=1) > 0
    found = np.zeros(len(mesh), bool)
    found[upright] = ~(leaves & (hit["t_hit"].numpy() <= THICKNESS_M))
    return found
