"""A GLB while it is put together: buffer views, accessors, extensions."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import from_os_error

Array = npt.NDArray[Any]

ALIGNED = 8
"""Bytes that buffer views begin at multiples of, as tables of properties must."""
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views."""
COMPONENT = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
TYPE = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
MAGIC, JSON, BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942


class Builder:
    """A file with one binary buffer.

    Attributes:
        tree: the JSON; its lists may be empty, and are left out then.
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
        """Put an entry into a list of the tree; returns its index."""
        self.tree[kind].append(entry)
        return len(self.tree[kind]) - 1

    def use(self, extension: str, *, required: bool = False) -> None:
        """Name an extension; required: readers that don't know it can't show the file."""
        for kind in ("extensionsUsed", *(["extensionsRequired"] if required else [])):
            if extension not in self.tree[kind]:
                self.tree[kind].append(extension)

    def view(self, data: bytes, **about: Any) -> int:
        """A buffer view of some bytes; returns its index."""
        return self.add("bufferViews", {"buffer": 0, **self.place(data), **about})

    def place(self, data: bytes) -> dict[str, int]:
        """Put bytes into the buffer; returns where they are."""
        at = self._length
        self._parts += [data, b"\0" * (-len(data) % ALIGNED)]
        self._length += len(self._parts[-2]) + len(self._parts[-1])
        return {"byteOffset": at, "byteLength": len(data)}

    def unpacked(self, size: int) -> dict[str, int]:
        """Room for bytes that are kept packed, in the buffer that readers unpack to; returns where it is."""
        at = self._fallback
        self._fallback += size + -size % ALIGNED
        return {"buffer": 1, "byteOffset": at, "byteLength": size}

    def accessor(self, values: Array, view: int | None, *, bounds: bool = False, normalized: bool = False) -> int:
        """An accessor of rows (N,) or (N, k), which lie in a buffer view; None: in packed geometry.

        Args:
            bounds: say the lowest and highest of each column, as positions must.
            normalized: integers stand for 0 to 1, or -1 to 1.
        """
        columns = 1 if values.ndim == 1 else values.shape[1]
        about: dict[str, Any] = {
            "componentType": COMPONENT[str(values.dtype)], "count": len(values), "type": TYPE[columns],
        }  # fmt: skip
        if view is not None:
            about["bufferView"] = view
        if normalized:
            about["normalized"] = True
        if bounds:
            about |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.add("accessors", about)

    def save(self, path: Path) -> None:
        """Write the file.

        Raises:
            SpaceError: it can't be written.
        """
        buffers: list[dict[str, Any]] = [{"byteLength": self._length}]
        if self._fallback:
            kept = {"EXT_meshopt_compression": {"fallback": True}}  # readers unpack to it, it is nowhere
            buffers.append({"byteLength": self._fallback, "extensions": kept})
        tree = {name: value for name, value in self.tree.items() if value not in ([], {})} | {"buffers": buffers}
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        whole = 12 + 8 + len(text) + 8 + self._length
        try:
            with path.open("wb") as file:
                file.write(struct.pack("<5I", MAGIC, 2, whole, len(text), JSON) + text)
                file.write(struct.pack("<2I", self._length, BINARY))
                file.writelines(self._parts)
        except OSError as error:
            raise from_os_error(error, path) from error


def rows(values: Array) -> Array:
    """(N, k) with rows of whole 4 bytes, as vertex attributes must have: filled up with zeros."""
    table = values.reshape(len(values), -1)
    missing = -table.shape[1] * table.itemsize % 4 // table.itemsize
    return np.ascontiguousarray(np.pad(table, ((0, 0), (0, missing))))


def indices(faces: Array, vertices: int) -> Array:
    """(3F,) of faces (F, 3), in as few bytes as they fit in; the largest number is none."""
    return faces.ravel().astype(np.uint16 if vertices < 65_535 else np.uint32)
