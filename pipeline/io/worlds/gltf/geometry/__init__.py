"""How glTF keeps geometry: a file a codec (`pipeline.core.plugins`), named in `export.glb_mesh`."""

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
        faces: (F, 3) of vertices.
        attributes: (V,) or (V, k) by their names in glTF; POSITION (metres, y up) is one of them.
    """

    faces: I64
    attributes: dict[str, Array]


class Codec(Protocol):
    """What a codec's module has."""

    def primitive(self, builder: Builder, part: Part) -> dict[str, Any]:
        """A part as a primitive of a mesh, whose data is put into the builder."""
