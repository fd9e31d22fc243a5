"""Geometry codecs of glTF: one module per codec (`pipeline.core.plugins`), selected by `export.glb_mesh`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from scan2sim.pipeline.core.types import I64
from scan2sim.pipeline.io.worlds.gltf.builder import Array, Builder

SETTING = "export.glb_mesh"


@dataclass(frozen=True)
class Part:
    """Triangles of one material.

    Attributes:
        faces: (F, 3) vertex indices.
        attributes: (V,) or (V, k) by their glTF names; includes POSITION (metres, y up).
    """

    faces: I64
    attributes: dict[str, Array]


class Codec(Protocol):
    """Interface of a codec's module."""

    def primitive(self, builder: Builder, part: Part) -> dict[str, Any]:
        """Add a part's data to the builder; returns the mesh primitive."""
