"""The grid that vertices on borders lie on, so that "the same place" means the same bits in all tiles.

float32 holds multiples of `GRID` in world metres exactly in any tile's local coordinates: origins are whole metres,
tiles below 2 km.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, Frame, Mesh

GRID = 2.0**-12
"""Metres: places on borders are multiples of it, in world coordinates."""


def on_grid(xyz: F64) -> F64:
    """World places (N, 3) rounded to multiples of `GRID`."""
    return np.rint(xyz / GRID) * GRID


def world(mesh: Mesh) -> F64:
    """(V, 3) vertices in world metres."""
    return mesh.vertices.astype(np.float64) + np.asarray(mesh.frame.origin)


def local(frame: Frame, xyz: F64, faces: npt.NDArray[Any]) -> Mesh:
    """From world metres."""
    return Mesh(frame, (xyz - np.asarray(frame.origin)).astype(np.float32), faces.astype(np.int32))
