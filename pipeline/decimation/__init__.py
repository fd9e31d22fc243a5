"""Decimation: mesh simplification by quadric edge collapse (Garland and Heckbert 1997).

One module per library (`pipeline.core.plugins`), selected by `decimate.backend`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F64, I32, Mesh

SETTING = "decimate.backend"


class Backend(Protocol):
    """Interface of a library's module.

    Attributes:
        KEEPS_BORDER: whether it can preserve open border edges exactly.
    """

    KEEPS_BORDER: bool

    def simplify(self, vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
        """Simplify a mesh to about `target` faces, or more if preserved borders need them.

        Args:
            vertices, faces: (V, 3) metres and (F, 3), more faces than `target`.
            target: number of faces.
            keep_border: preserve open border edges; only True if `KEEPS_BORDER`.
        """


def find(name: str, *, keep_border: bool = False) -> Backend:
    """Load a backend that can run on this machine and, if `keep_border`, preserve borders.

    Raises:
        SettingError: there is no backend of that name, or it can't preserve borders.
        UnavailableError: it isn't installed.
    """
    backend: Backend = plugins.find(__name__, name, SETTING)
    if keep_border and not backend.KEEPS_BORDER:
        capable = [one for one in plugins.names(__name__) if plugins.module(__name__, one).KEEPS_BORDER]
        raise SettingError(
            SETTING,
            f"{name!r} can't keep borders, which is required where tiles meet",
            f"Choose {' or '.join(capable)}",
        )
    return backend


def simplify(mesh: Mesh, target: int, *, keep_border: bool = True, backend: str = "pyfqmr") -> Mesh:
    """Simplify a mesh to about `target` faces, if it has more; its attributes are dropped.

    Args:
        mesh: the mesh.
        target: number of faces.
        keep_border: preserve open border edges, even if that needs more faces.
        backend: name of a module of this package.

    Raises:
        SettingError, UnavailableError: as `find`.
    """
    chosen = find(backend, keep_border=keep_border)
    if len(mesh) <= target:
        return Mesh(mesh.frame, mesh.vertices, mesh.faces)
    vertices, faces = chosen.simplify(mesh.vertices.astype(np.float64), mesh.faces, target, keep_border)
    return Mesh(mesh.frame, vertices.astype(np.float32), faces.astype(np.int32)).keep(np.ones(len(faces), bool))
