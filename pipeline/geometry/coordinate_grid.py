"""Grid of border vertices: coordinates are rounded to it so that equal positions are bit-identical in all tiles.

float32 represents multiples of `GRID_M` exactly in any tile's local coordinates, as origins are integer metres and
tiles smaller than 2 km.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, Frame, Mesh

GRID_M = 2.0**-12
"""World coordinates of border vertices are multiples of it."""


def snap_to_grid(xyz: F64) -> F64:
    """Round world coordinates (N, 3) to multiples of `GRID_M`."""
    return np.rint(xyz / GRID_M) * GRID_M


def world(mesh: Mesh) -> F64:
    """Vertices (V, 3) in world metres."""
    return mesh.vertices.astype(np.float64) + np.asarray(mesh.frame.origin)


def local(frame: Frame, xyz: F64, faces: npt.NDArray[Any]) -> Mesh:
    """Mesh in `frame`'s local coordinates from vertices in world metres."""
    return Mesh(frame, (xyz - np.asarray(frame.origin)).astype(np.float32), faces.astype(np.int32))
