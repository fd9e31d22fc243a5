"""Decimation: fewer triangles by quadric edge collapse (Garland and Heckbert 1997).

A file a library (`pipeline.core.plugins`), named in `decimate.backend`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F64, I32, Mesh

SETTING = "decimate.backend"


class Backend(Protocol):
    """What a library's module has.

    Attributes:
        KEEPS_BORDER: whether it can keep all edges of one face alone as they are, to the bit.
    """

    KEEPS_BORDER: bool

    def simplify(self, vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
        """Vertices and faces of a mesh with about `target` faces; more where kept borders need them.

        Args:
            vertices, faces: (V, 3) metres and (F, 3), more faces than `target`.
            keep_border: keep the edges of one face alone; only asked of what `KEEPS_BORDER`.
        """


def find(name: str, *, keep_border: bool = False) -> Backend:
    """A library that can run here, and keep borders where that is asked.

    Raises:
        SettingError: there is none of that name, or it can't keep borders.
        UnavailableError: it isn't installed.
    """
    backend: Backend = plugins.find(__name__, name, SETTING)
    if keep_border and not backend.KEEPS_BORDER:
        able = [one for one in plugins.names(__name__) if plugins.module(__name__, one).KEEPS_BORDER]
        raise SettingError(SETTING, f"{name!r} can't keep borders, where tiles meet", f"Choose {' or '.join(able)}")
    return backend


def simplify(mesh: Mesh, target: int, *, keep_border: bool = True, backend: str = "pyfqmr") -> Mesh:
    """A mesh with about `target` faces, or as it is where it has no more; its attributes are dropped.

    Args:
        keep_border: keep the edges of one face alone as they are, and have more faces where these need them.
        backend: name of a file here.

    Raises:
        SettingError, UnavailableError: as `find`.
    """
    chosen = find(backend, keep_border=keep_border)
    if len(mesh) <= target:
        return Mesh(mesh.frame, mesh.vertices, mesh.faces)
    vertices, faces = chosen.simplify(mesh.vertices.astype(np.float64), mesh.faces, target, keep_border)
    return Mesh(mesh.frame, vertices.astype(np.float32), faces.astype(np.int32)).keep(np.ones(len(faces), bool))
