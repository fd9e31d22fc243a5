"""MeshLab, through pymeshlab (GPL): collapses the cheapest edge first (heap)."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.types import F64, I32, Bools
from scan2sim.pipeline.geometry.boundary_curve import curve

NEEDS = ("pymeshlab",)


def simplify(vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
    """See `pipeline.decimation.Backend`.

    MeshLab's `preserveboundary` is only a weight, so borders can move. Therefore faces at a border are excluded from
    the selection that is decimated, which fixes their vertices.

    Raises:
        UnavailableError: system libraries are missing.
    """
    try:
        import pymeshlab
    except ImportError as error:  # its Qt needs desktop libraries
        remedy = "Install the missing system library (Debian: libopengl0, libxcb1), or choose another backend"
        raise UnavailableError("decimate.backend pymeshlab", f"can't be loaded ({error})", remedy) from error

    meshes = pymeshlab.MeshSet()
    free = ~_at_border(faces, len(vertices)) if keep_border else np.ones(len(faces), bool)
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces, f_scalar_array=free.astype(np.float64)))
    if keep_border:
        meshes.compute_selection_by_condition_per_face(condselect="(fq > 0.5)")
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=max(0, target - int((~free).sum())),  # number of selected faces
        selected=keep_border,
        preservenormal=True,
        autoclean=False,
    )
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.face_matrix()


def _at_border(faces: I32, n: int) -> Bools:
    """(F,) bool, True for faces with a vertex (of `n`) on an open border edge."""
    on = np.zeros(n, bool)
    on[curve(faces, np.ones(n, bool)).edges] = True
    return np.asarray(on[faces].any(axis=1))
