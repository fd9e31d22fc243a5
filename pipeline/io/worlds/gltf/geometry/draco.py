"""Google's Draco (`KHR_draco_mesh_compression`): unpacked slowly; browsers, Cesium, Blender, Unreal, Unity.

Positions are rounded to 2^-10 m on a grid that is the same for all tiles, so tiles meet within a millimetre; texture
coordinates to 2^-16 of a page, normals to 10 bits. Vertices and triangles come in another order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.io.worlds.gltf.builder import Array, Builder
from scan2sim.pipeline.io.worlds.gltf.geometry import Part

NEEDS = ("DracoPy",)
EXTENSION = "KHR_draco_mesh_compression"
STEP = 2.0**-10
"""Metres."""
LEVEL = 7
"""Of compression, of 10."""
OWN = ("POSITION", "TEXCOORD_0", "NORMAL")
KIND = {0: "POSITION", 1: "NORMAL", 3: "TEXCOORD_0"}
"""Draco's kinds of attributes."""


def primitive(builder: Builder, part: Part) -> dict[str, Any]:
    """See `pipeline.io.worlds.gltf.geometry.Codec`."""
    import DracoPy

    builder.use(EXTENSION, required=True)
    others = [name for name in part.attributes if name not in OWN]
    data = _packed(part, others)
    read = DracoPy.decode(data)  # which vertices it parted, and what it rounded positions to
    found = {KIND.get(a["attribute_type"]) or others[a["unique_id"]]: a for a in read.attributes}
    accessors = {
        name: builder.accessor(_rows(found[name]["data"], values), None, bounds=name == "POSITION")
        for name, values in part.attributes.items()
    }
    packed = {
        "bufferView": builder.view(data),
        "attributes": {name: found[name]["unique_id"] for name in part.attributes},
    }
    index = read.faces.ravel().astype(np.uint32)
    return {"attributes": accessors, "indices": builder.accessor(index, None), "extensions": {EXTENSION: packed}}


def _packed(part: Part, others: list[str]) -> bytes:
    import DracoPy

    at = part.attributes
    origin, bits = _grid(at["POSITION"])
    return DracoPy.encode(
        at["POSITION"],
        part.faces.astype(np.uint32),
        quantization_bits=bits,
        quantization_range=(2**bits - 1) * STEP,
        quantization_origin=origin,
        compression_level=LEVEL,
        tex_coord=at["TEXCOORD_0"].astype(np.float64) if "TEXCOORD_0" in at else None,
        tex_coord_quantization_bits=16,
        normals=at["NORMAL"].astype(np.float64) if "NORMAL" in at else None,
        normal_quantization_bits=10,
        generic_attributes={i: at[name].reshape(len(at[name]), -1) for i, name in enumerate(others)},
    )  # fmt: skip


def _grid(xyz: F32) -> tuple[F32, int]:
    """Where positions count from, a multiple of the step, and the bits that their steps take."""
    low = np.floor(xyz.min(axis=0) / STEP) * STEP
    steps = float((xyz.max(axis=0) - low).max() / STEP)
    return low.astype(np.float32), max(1, int(np.ceil(np.log2(steps + 2))))


def _rows(read: Array, like: Array) -> Array:
    """What was read of an attribute, with the type and columns that it had."""
    return read.astype(like.dtype).reshape(-1, *like.shape[1:])
