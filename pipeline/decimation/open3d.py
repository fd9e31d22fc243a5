"""Open3D: collapses the cheapest edge first (heap); it can weight borders, but not preserve them exactly."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, I32

KEEPS_BORDER = False


def simplify(vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
    """See `pipeline.decimation.Backend`."""
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    small = mesh.simplify_quadric_decimation(target)
    return np.asarray(small.vertices), np.asarray(small.triangles)
