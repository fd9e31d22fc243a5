"""MeshLab, through pymeshlab, which is under the GPL: always the cheapest edge first, from a heap."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.types import F64, I32, Bools
from scan2sim.pipeline.tiling.borders.boundary_curve import curve

NEEDS = ("pymeshlab",)
KEEPS_BORDER = True


def simplify(vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
    """See `pipeline.decimation.Backend`.

    Its own `preserveboundary` is a weight, which lets borders slip. Here all faces at a border are left out of the
    selection that is decimated, which holds their vertices in place.

    Raises:
        UnavailableError: libraries of the system are missing.
    """
    try:
        import pymeshlab
    except ImportError as error:  # its Qt wants libraries of a desktop
        remedy = "Install that library of the system (Debian: libopengl0, libxcb1), or choose another backend"
        raise UnavailableError("decimate.backend pymeshlab", f"can't be loaded ({error})", remedy) from error

    meshes = pymeshlab.MeshSet()
    free = ~_at_border(faces, len(vertices)) if keep_border else np.ones(len(faces), bool)
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces, f_scalar_array=free.astype(np.float64)))
    if keep_border:
        meshes.compute_selection_by_condition_per_face(condselect="(fq > 0.5)")
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=max(0, target - int((~free).sum())),  # of those that are selected
        selected=keep_border,
        preservenormal=True,
        autoclean=False,
    )
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.face_matrix()


def _at_border(faces: I32, n: int) -> Bools:
    """(F,) faces that have a vertex, of `n`, on an edge of one face alone."""
    on = np.zeros(n, bool)
    on[curve(faces, np.ones(n, bool)).edges] = True
    return np.asarray(on[faces].any(axis=1))
