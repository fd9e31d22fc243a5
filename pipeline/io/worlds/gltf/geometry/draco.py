"""Google's Draco codec (`KHR_draco_mesh_compression`): slow to decode; for browsers, Cesium, Blender, Unreal, Unity.

Positions are quantized to 2^-10 m on a grid common to all tiles, so that tiles meet within a millimetre; texture
coordinates to 2^-16 of a page, normals to 10 bits, reflectance to 8 bits. Vertices and triangles are reordered.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.io.worlds.gltf.builder import Array, Builder
from scan2sim.pipeline.io.worlds.gltf.geometry import Part

NEEDS = ("DracoPy",)
EXTENSION = "KHR_draco_mesh_compression"
QUANTIZATION_STEP_M = 2.0**-10
COMPRESSION_LEVEL = 7
"""0 to 10 (smallest)."""
TYPED_ATTRIBUTES = ("POSITION", "TEXCOORD_0", "NORMAL")
"""Attributes that have a type of their own in Draco; all others are generic."""
NORMALIZED = ("_REFLECTANCE",)
"""Attributes from 0 to 1 that are written as normalized bytes: Draco doesn't compress generic floats well."""
ATTRIBUTE_TYPES = {0: "POSITION", 1: "NORMAL", 3: "TEXCOORD_0"}
"""Draco's attribute types."""


def primitive(builder: Builder, part: Part) -> dict[str, Any]:
    """See `pipeline.io.worlds.gltf.geometry.Codec`."""
    import DracoPy

    builder.use(EXTENSION, required=True)
    attributes = {
        name: np.rint(255 * values).astype(np.uint8) if name in NORMALIZED else values
        for name, values in part.attributes.items()
    }
    generic = [name for name in attributes if name not in TYPED_ATTRIBUTES]
    data = _encode(Part(part.faces, attributes), generic)
    read = DracoPy.decode(data)  # accessors describe the decoded data: vertex order and quantized positions
    found = {ATTRIBUTE_TYPES.get(a["attribute_type"]) or generic[a["unique_id"]]: a for a in read.attributes}
    accessors = {
        name: builder.accessor(
            _rows(found[name]["data"], values), None, bounds=name == "POSITION", normalized=name in NORMALIZED
        )
        for name, values in attributes.items()
    }
    compressed = {
        "bufferView": builder.view(data),
        "attributes": {name: found[name]["unique_id"] for name in attributes},
    }
    index = read.faces.ravel().astype(np.uint32)
    return {"attributes": accessors, "indices": builder.accessor(index, None), "extensions": {EXTENSION: compressed}}


def _encode(part: Part, generic: list[str]) -> bytes:
    import DracoPy

    at = part.attributes
    origin, bits = _grid(at["POSITION"])
    return DracoPy.encode(
        at["POSITION"],
        part.faces.astype(np.uint32),
        quantization_bits=bits,
        quantization_range=(2**bits - 1) * QUANTIZATION_STEP_M,
        quantization_origin=origin,
        compression_level=COMPRESSION_LEVEL,
        tex_coord=at["TEXCOORD_0"].astype(np.float64) if "TEXCOORD_0" in at else None,
        tex_coord_quantization_bits=16,
        normals=at["NORMAL"].astype(np.float64) if "NORMAL" in at else None,
        normal_quantization_bits=10,
        generic_attributes={i: at[name].reshape(len(at[name]), -1) for i, name in enumerate(generic)},
    )  # fmt: skip


def _grid(xyz: F32) -> tuple[F32, int]:
    """Origin of the quantization grid, a multiple of the step, and the number of bits that positions need."""
    low = np.floor(xyz.min(axis=0) / QUANTIZATION_STEP_M) * QUANTIZATION_STEP_M
    steps = float((xyz.max(axis=0) - low).max() / QUANTIZATION_STEP_M)
    return low.astype(np.float32), max(1, int(np.ceil(np.log2(steps + 2))))


def _rows(read: Array, like: Array) -> Array:
    """A decoded attribute with the type and columns of the original."""
    return read.astype(like.dtype).reshape(-1, *like.shape[1:])
