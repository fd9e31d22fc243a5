"""Uncompressed geometry: 32-bit floats, lossless; read by every program."""

from __future__ import annotations

from typing import Any

from scan2sim.pipeline.io.worlds.gltf.builder import INDICES, VERTICES, Builder, indices, rows
from scan2sim.pipeline.io.worlds.gltf.geometry import Part


def primitive(builder: Builder, part: Part) -> dict[str, Any]:
    """See `pipeline.io.worlds.gltf.geometry.Codec`."""
    attributes = {}
    for name, values in part.attributes.items():
        table = rows(values)
        stride = {"byteStride": table.nbytes // len(table)} if table.nbytes != values.nbytes else {}
        view = builder.view(table.tobytes(), target=VERTICES, **stride)
        attributes[name] = builder.accessor(values, view, bounds=name == "POSITION")
    index = indices(part.faces, len(part.attributes["POSITION"]))
    return {
        "attributes": attributes,
        "indices": builder.accessor(index, builder.view(index.tobytes(), target=INDICES)),
    }
