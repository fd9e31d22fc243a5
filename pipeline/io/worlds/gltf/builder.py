"""Builder of GLB files: buffer views, accessors, extensions."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import from_os_error

Array = npt.NDArray[Any]

ALIGNMENT_BYTES = 8
"""Alignment of buffer views, which property tables require."""
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views."""
COMPONENT_TYPES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
ACCESSOR_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
MAGIC, JSON, BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942


class Builder:
    """A glTF file with one binary buffer.

    Attributes:
        tree: the JSON; empty lists are omitted from the file.
    """

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "scan2sim"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [],
            "meshes": [], "materials": [], "textures": [], "samplers": [], "images": [], "accessors": [],
            "bufferViews": [], "extensionsUsed": [], "extensionsRequired": [], "extensions": {},
        }  # fmt: skip
        self._parts: list[bytes] = []
        self._length = 0
        self._fallback = 0

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append an entry to a list of the tree; returns its index."""
        self.tree[kind].append(entry)
        return len(self.tree[kind]) - 1

    def use(self, extension: str, *, required: bool = False) -> None:
        """Declare an extension; required: readers that don't support it can't show the file."""
        for kind in ("extensionsUsed", *(["extensionsRequired"] if required else [])):
            if extension not in self.tree[kind]:
                self.tree[kind].append(extension)

    def view(self, data: bytes, **properties: Any) -> int:
        """Add a buffer view of some bytes; returns its index."""
        return self.add("bufferViews", {"buffer": 0, **self.append(data), **properties})

    def append(self, data: bytes) -> dict[str, int]:
        """Append bytes to the buffer; returns their offset and length."""
        at = self._length
        self._parts += [data, b"\0" * (-len(data) % ALIGNMENT_BYTES)]
        self._length += len(self._parts[-2]) + len(self._parts[-1])
        return {"byteOffset": at, "byteLength": len(data)}

    def reserve_decoded(self, size: int) -> dict[str, int]:
        """Reserve bytes for compressed data in the buffer that readers decode to; returns offset and length."""
        at = self._fallback
        self._fallback += size + -size % ALIGNMENT_BYTES
        return {"buffer": 1, "byteOffset": at, "byteLength": size}

    def accessor(self, values: Array, view: int | None, *, bounds: bool = False, normalized: bool = False) -> int:
        """Add an accessor; returns its index.

        Args:
            values: rows (N,) or (N, k).
            view: the buffer view that contains them; None: compressed geometry contains them.
            bounds: write minimum and maximum of each column, which positions require.
            normalized: integers represent 0 to 1, or -1 to 1.
        """
        columns = 1 if values.ndim == 1 else values.shape[1]
        accessor: dict[str, Any] = {
            "componentType": COMPONENT_TYPES[str(values.dtype)], "count": len(values), "type": ACCESSOR_TYPES[columns],
        }  # fmt: skip
        if view is not None:
            accessor["bufferView"] = view
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.add("accessors", accessor)

    def save(self, path: Path) -> None:
        """Write the file.

        Raises:
            SpaceError: it can't be written.
        """
        buffers: list[dict[str, Any]] = [{"byteLength": self._length}]
        if self._fallback:
            fallback = {"EXT_meshopt_compression": {"fallback": True}}  # has no data: readers decode to it
            buffers.append({"byteLength": self._fallback, "extensions": fallback})
        tree = {name: value for name, value in self.tree.items() if value not in ([], {})} | {"buffers": buffers}
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        file_bytes = 12 + 8 + len(text) + 8 + self._length
        try:
            with path.open("wb") as file:
                file.write(struct.pack("<5I", MAGIC, 2, file_bytes, len(text), JSON) + text)
                file.write(struct.pack("<2I", self._length, BINARY))
                file.writelines(self._parts)
        except OSError as error:
            raise from_os_error(error, path) from error


def rows(values: Array) -> Array:
    """Rows (N, k) padded with zeros to a multiple of 4 bytes, which vertex attributes require."""
    table = values.reshape(len(values), -1)
    missing = -table.shape[1] * table.itemsize % 4 // table.itemsize
    return np.ascontiguousarray(np.pad(table, ((0, 0), (0, missing))))


def indices(faces: Array, vertices: int) -> Array:
    """Indices (3F,) of faces (F, 3) in the smallest type; its largest number is reserved (primitive restart)."""
    return faces.ravel().astype(np.uint16 if vertices < 65_535 else np.uint32)
