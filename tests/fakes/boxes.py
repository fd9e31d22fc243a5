"""Meshes of boxes."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import Frame, Mesh


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """A box whose faces look outwards."""
    corners = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)], np.float32)
    faces = [(0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4), (2, 6, 3), (3, 6, 7), (0, 4, 2),
             (2, 4, 6), (1, 3, 5), (3, 7, 5)]  # fmt: skip
    return Mesh(Frame(), corners, np.array(faces, np.int32))


def joined(*meshes: Mesh) -> Mesh:
    """Meshes as one."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + n for mesh, n in zip(meshes, first, strict=False)]).astype(np.int32)
    return Mesh(Frame(), np.concatenate([mesh.vertices for mesh in meshes]), faces)
