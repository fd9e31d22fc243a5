"""Features of glTF files that the reader of meshes (trimesh) doesn't know, and would read wrongly without an error.

Source: glTF 2.0 specification, section 3.7; registry of extensions (https://github.com/KhronosGroup/glTF).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import InputError

FLOAT = 5126
"""Component type of numbers that aren't quantized."""
TRANSFORM = "KHR_texture_transform"
REQUIRED = {
    "EXT_meshopt_compression": ("is compressed by meshoptimizer", "Export it without mesh compression, or as OBJ"),
    "KHR_meshopt_compression": ("is compressed by meshoptimizer", "Export it without mesh compression, or as OBJ"),
    "KHR_texture_basisu": ("has texture images in KTX 2", "Export it with JPEG or PNG textures, or as OBJ"),
}
"""Extensions that a file may require: cause and remedy."""


def check(path: Path) -> None:
    """Check that a .gltf or .glb has no feature that would be read wrongly; damaged files are left to the reader.

    Raises:
        InputError: it has one; names it, and what to export instead.
    """
    try:
        found = next(_problems(_json(path)), None)
    except (OSError, ValueError, TypeError, KeyError, IndexError, AttributeError, struct.error, RecursionError):
        return
    if found is not None:
        raise InputError(path, *found)


def _json(path: Path) -> Any:
    with open(path, "rb") as file:
        head = file.read(20)
        if head[:4] != b"glTF":
            return json.loads(path.read_text(encoding="utf-8-sig"))
        return json.loads(file.read(struct.unpack_from("<I", head, 12)[0]))


def _problems(body: Any) -> Iterator[tuple[str, str]]:
    for name in body.get("extensionsRequired", ()):
        if name in REQUIRED:
            cause, remedy = REQUIRED[name]
            yield f"{cause} ({name}), which isn't read", remedy
    attributes = [one["attributes"] for mesh in body.get("meshes", ()) for one in mesh["primitives"]]
    for name in ("POSITION", "TEXCOORD_0"):
        used = [body["accessors"][one[name]] for one in attributes if name in one]
        if any(one["componentType"] != FLOAT and one.get("normalized") for one in used):
            cause = f"stores {name} as normalized integers (quantized), which aren't read"
            yield cause, "Export it without quantization, or as OBJ"
    for material in body.get("materials", ()):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        change = texture.get("extensions", {}).get(TRANSFORM, {})
        moved = any(change.get("offset", ())) or bool(change.get("rotation")) or {*change.get("scale", (1,))} != {1}
        if moved or change.get("texCoord", texture.get("texCoord", 0)):
            what = TRANSFORM if moved else "a second set of texture coordinates"
            cause = f"places the texture of material {material.get('name', '')!r} by {what}, which isn't read"
            yield cause, "Apply the transform to the texture coordinates and export it again, or export OBJ"
