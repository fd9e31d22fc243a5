"""meshoptimizer's codec (`EXT_meshopt_compression`): very fast to decode; read by browsers, Cesium, Babylon.

Positions are quantized to 2^-10 m on a grid common to all tiles, so that tiles meet within a millimetre; texture
coordinates to 2^-16 of a page, distances to 2^-7 m, reflectance to 2^-8, normals to 8 bits (`KHR_mesh_quantization`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.io.worlds.gltf.builder import INDICES, VERTICES, Array, Builder, indices, rows
from scan2sim.pipeline.io.worlds.gltf.geometry import Part

NEEDS = ("meshopt",)
EXTENSION = "EXT_meshopt_compression"
STEP_EXPONENT = {"POSITION": -10, "_DISTANCE": -7, "_REFLECTANCE": -8}
"""Quantization step of attributes: exponent of two; metres, reflectance."""
MAX_STEPS = 1 << 23
"""Range of the 24-bit mantissa."""


def primitive(builder: Builder, part: Part) -> dict[str, Any]:
    """See `pipeline.io.worlds.gltf.geometry.Codec`."""
    import meshopt

    builder.use(EXTENSION, required=True)
    builder.use("KHR_mesh_quantization", required=True)
    order, new_index, used = meshopt.reorder_mesh(part.faces.astype(np.uint32).ravel(), True, False)
    at = np.argsort(new_index)[:used]
    attributes = {name: _attribute(builder, name, values[at]) for name, values in part.attributes.items()}
    index = indices(order, used)
    view = _compressed_view(builder, meshopt.encode_gltf_buffer(index, "TRIANGLES"), index, "TRIANGLES", target=INDICES)
    return {"attributes": attributes, "indices": builder.accessor(index, view)}


def _attribute(builder: Builder, name: str, values: Array) -> int:
    """Add an attribute to the builder; returns its accessor."""
    import meshopt

    if name in STEP_EXPONENT:
        steps, rounded = _on_grid(values, STEP_EXPONENT[name])
        packed = meshopt.encode_gltf_buffer(rows(steps), "ATTRIBUTES")
        view = _compressed_view(builder, packed, rows(steps), "ATTRIBUTES", "EXPONENTIAL", target=VERTICES)
        return builder.accessor(rounded, view, bounds=name == "POSITION")
    if name == "TEXCOORD_0":
        values = np.round(np.clip(values, 0, 1) * 65_535).astype(np.uint16)
    elif name == "NORMAL":
        values = np.round(np.clip(values, -1, 1) * 127).astype(np.int8)
    table = rows(values)
    packed = meshopt.encode_gltf_buffer(table, "ATTRIBUTES")
    view = _compressed_view(builder, packed, table, "ATTRIBUTES", target=VERTICES)
    return builder.accessor(values, view, normalized=name in ("TEXCOORD_0", "NORMAL"))


def _on_grid(values: Array, exponent: int) -> tuple[Array, F32]:
    """Values encoded for the filter EXPONENTIAL (int32: exponent in the highest byte), and as decoded from that."""
    steps = np.round(values.astype(np.float64) * 2.0**-exponent).clip(-MAX_STEPS, MAX_STEPS - 1).astype(np.int64)
    packed = ((exponent & 0xFF) << 24) | (steps & 0xFFFFFF)
    return packed.astype(np.uint32).view(np.int32), (steps * 2.0**exponent).astype(np.float32)


def _compressed_view(
    builder: Builder, data: bytes, table: Array, mode: str, filter: str = "NONE", *, target: int
) -> int:
    """Add a buffer view of compressed rows; returns its index."""
    size = table.nbytes // len(table)
    compression = {"buffer": 0, **builder.append(data), "byteStride": size, "mode": mode, "count": len(table)}
    if filter != "NONE":
        compression["filter"] = filter
    properties = {"target": target} | ({"byteStride": size} if target == VERTICES else {})
    view = {**builder.reserve_decoded(table.nbytes), "extensions": {EXTENSION: compression}, **properties}
    return builder.add("bufferViews", view)
