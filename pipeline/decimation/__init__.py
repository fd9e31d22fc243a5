"""Decimation: mesh simplification by quadric edge collapse (Garland and Heckbert 1997).

One module per library (`pipeline.core.plugins`), selected by `decimate.backend`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.types import F64, I32, Mesh

SETTING = "decimate.backend"


class Backend(Protocol):
    """Interface of a library's module."""

    def simplify(self, vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
        """Simplify a mesh to about `target` faces, or more if preserved borders need them.

        Args:
            vertices, faces: (V, 3) metres and (F, 3), more faces than `target`.
            target: number of faces.
            keep_border: preserve open border edges exactly.
        """


def find(name: str) -> Backend:
    """Load a backend that can run on this machine.

    Raises:
        SettingError: there is no backend of that name.
        UnavailableError: it isn't installed.
    """
    backend: Backend = plugins.find(__name__, name, SETTING)
    return backend


def simplify(mesh: Mesh, target: int, *, keep_border: bool = True, backend: str = "fast_simplification") -> Mesh:
    """Simplify a mesh to about `target` faces, if it has more; its attributes are dropped.

    Args:
        mesh: the mesh.
        target: number of faces.
        keep_border: preserve open border edges, even if that needs more faces.
        backend: name of a module of this package.

    Raises:
        SettingError, UnavailableError: as `find`.
    """
    chosen = find(backend)
    if len(mesh) <= target:
        return Mesh(mesh.frame, mesh.vertices, mesh.faces)
    vertices, faces = chosen.simplify(mesh.vertices.astype(np.float64), mesh.faces, target, keep_border)
    return Mesh(mesh.frame, vertices.astype(np.float32), faces.astype(np.int32)).keep(np.ones(len(faces), bool))
