"""FBX 7.4, binary: static meshes with normals, texture coordinates and textured materials, for Unreal and CARLA.

The format isn't published; what is written here is what Blender and assimp read alike: a tree of records, each with
properties (arrays packed by zlib), objects with ids, and connections between them. Centimetres, z up, right handed:
they are FBX's own unit, so readers that convert none have the right size, too.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.io.worlds.textured_mesh import Textured, unique_uv

VERSION = 7400
HEAD = b"Kaydara FBX Binary  \x00\x1a\x00"
TIME = "1970-01-01 10:00:00:000"
FILE_ID = bytes.fromhex("28b32aebb624ccc2bfc8b02aa92bfcf1")
FOOT_ID = bytes.fromhex("fabcab09d0c8d466b176fb831cf7267e")
FOOT = bytes.fromhex("f85a8c6adef5d97eece90ce3758f290b")
"""Readers hold these two ids against `TIME`."""
CENTIMETRES = 100.0
AXES = {"UpAxis": 2, "UpAxisSign": 1, "FrontAxis": 1, "FrontAxisSign": -1, "CoordAxis": 0, "CoordAxisSign": 1}


@dataclass(frozen=True)
class Part:
    """A mesh with one texture.

    Attributes:
        name: of the object.
        shape: its faces, all on one page; metres, z up.
        image: file of its texture, relative to the FBX.
    """

    name: str
    shape: Textured
    image: str


@dataclass
class Record:
    """A record of the tree: properties are int (64 bits), float, str, bytes and arrays of float64 or int32."""

    name: str
    properties: Sequence[Any] = ()
    children: list[Record] = field(default_factory=list)

    def add(self, name: str, *properties: Any) -> Record:
        """A child; returns it."""
        self.children.append(Record(name, properties))
        return self.children[-1]

    def encoded(self, start: int) -> bytes:
        """The record as it stands at a place of the file."""
        own = b"".join(map(_property, self.properties))
        head = 13 + len(self.name)
        inside = b""
        for child in self.children:
            inside += child.encoded(start + head + len(own) + len(inside))
        if self.children:
            inside += bytes(13)
        end = start + head + len(own) + len(inside)
        name = self.name.encode("ascii")
        return struct.pack("<IIIB", end, len(self.properties), len(own), len(name)) + name + own + inside


def write(path: Path, parts: Sequence[Part]) -> None:
    """Write meshes into one file."""
    top = Record("")
    header = top.add("FBXHeaderExtension")
    header.add("FBXHeaderVersion", np.int32(1003))
    header.add("FBXVersion", np.int32(VERSION))
    top.add("FileId", FILE_ID)
    top.add("CreationTime", TIME)
    top.add("Creator", "scan2sim")
    settings = top.add("GlobalSettings")
    settings.add("Version", np.int32(1000))
    _properties(settings, {**AXES, "UnitScaleFactor": 1.0, "OriginalUnitScaleFactor": 1.0})
    definitions = top.add("Definitions")
    definitions.add("Version", np.int32(100))
    for kind in ("Geometry", "Model", "Material", "Texture", "Video"):
        definitions.add("ObjectType", kind).add("Count", np.int32(len(parts)))
    objects, connections = top.add("Objects"), Record("Connections")
    for i, part in enumerate(parts):
        _object(objects, connections, 1_000_000 + 10 * i, part)
    top.children.append(connections)
    _save(path, top)


def _object(objects: Record, connections: Record, number: int, part: Part) -> None:
    """A mesh: its geometry, place, material, texture and picture, which have the numbers from `number` on."""
    geometry, model, material, texture, video = range(number, number + 5)
    _geometry(objects.add("Geometry", geometry, _named(part.name, "Geometry"), "Mesh"), part.shape)
    placed = objects.add("Model", model, _named(part.name, "Model"), "Mesh")
    placed.add("Version", np.int32(232))
    look = objects.add("Material", material, _named(part.name, "Material"), "")
    look.add("Version", np.int32(102))
    look.add("ShadingModel", "lambert")
    picture = objects.add("Texture", texture, _named(part.name, "Texture"), "")
    clip = objects.add("Video", video, _named(part.name, "Video"), "Clip")
    for kind, one in (("TextureVideoClip", picture), ("Clip", clip)):
        one.add("Type", kind)
        one.add("FileName", part.image)
        one.add("RelativeFilename", part.image)
    for child, parent in ((geometry, model), (model, 0), (material, model), (video, texture)):
        connections.add("C", "OO", child, parent)
    connections.add("C", "OP", texture, material, "DiffuseColor")


def _geometry(record: Record, shape: Textured) -> None:
    mesh = shape.mesh
    assert mesh.uv is not None
    record.add("GeometryVersion", np.int32(124))
    record.add("Vertices", mesh.vertices.astype(np.float64).ravel() * CENTIMETRES)
    ends = mesh.faces.astype(np.int32) * np.array([1, 1, -1], np.int32) - np.array([0, 0, 1], np.int32)
    record.add("PolygonVertexIndex", ends.ravel())  # a polygon's last corner is told as -1 - index
    uv, corner_uv = unique_uv(mesh.uv)
    layer = record.add("Layer", np.int32(0))
    layer.add("Version", np.int32(100))
    kinds = (
        ("Normal", "ByVertice", {"Normals": shape.normal.astype(np.float64).ravel()}),
        ("UV", "ByPolygonVertex", {"UV": uv.astype(np.float64).ravel(), "UVIndex": corner_uv.ravel()}),
        ("Material", "AllSame", {"Materials": np.zeros(1, np.int32)}),
    )
    for kind, mapping, arrays in kinds:
        element = Record(f"LayerElement{kind}", (np.int32(0),))
        element.add("Version", np.int32(101))
        element.add("Name", "")
        element.add("MappingInformationType", mapping)
        element.add("ReferenceInformationType", "Direct" if kind == "Normal" else "IndexToDirect")
        for name, values in arrays.items():
            element.add(name, values)
        record.children.insert(-1, element)
        own = layer.add("LayerElement")
        own.add("Type", f"LayerElement{kind}")
        own.add("TypedIndex", np.int32(0))


def _named(name: str, kind: str) -> str:
    return f"{name}\x00\x01{kind}"


def _properties(record: Record, values: dict[str, int | float]) -> None:
    """Named properties: whole numbers and others."""
    table = record.add("Properties70")
    for name, value in values.items():
        kind = ("int", "Integer") if isinstance(value, int) else ("double", "Number")
        table.add("P", name, *kind, "", np.int32(value) if isinstance(value, int) else value)


def _property(value: Any) -> bytes:
    if isinstance(value, np.ndarray):
        kind = {"f": b"d", "i": b"i"}[value.dtype.kind]
        packed = zlib.compress(np.ascontiguousarray(value).tobytes(), 6)
        return kind + struct.pack("<III", len(value), 1, len(packed)) + packed
    if isinstance(value, np.int32):
        return b"I" + struct.pack("<i", value)
    if isinstance(value, int):
        return b"L" + struct.pack("<q", value)
    if isinstance(value, float):
        return b"D" + struct.pack("<d", value)
    data = value.encode("ascii") if isinstance(value, str) else value
    return (b"S" if isinstance(value, str) else b"R") + struct.pack("<I", len(data)) + data


def _save(path: Path, top: Record) -> None:
    """Write the tree below `top`, and the footer."""
    with open(path, "wb") as file:
        file.write(HEAD + struct.pack("<I", VERSION))
        for record in top.children:
            file.write(record.encoded(file.tell()))
        file.write(bytes(13) + FOOT_ID + bytes(4))
        file.write(bytes(16 - file.tell() % 16) + struct.pack("<I", VERSION) + bytes(120) + FOOT)
