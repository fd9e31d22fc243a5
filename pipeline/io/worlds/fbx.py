"""FBX 7.4 writer (binary): static meshes with normals, texture coordinates, textured materials, for Unreal and CARLA.

The format isn't published; this is the subset that both Blender and assimp read: a tree of records with properties
(arrays compressed by zlib), objects with ids, and connections between them. Coordinates are centimetres, z up,
right-handed; centimetres are FBX's native unit, so that the size is also right in readers that don't convert units.
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
MAGIC = b"Kaydara FBX Binary  \x00\x1a\x00"
CREATION_TIME = "1970-01-01 10:00:00:000"
FILE_ID = bytes.fromhex("28b32aebb624ccc2bfc8b02aa92bfcf1")
FOOTER_ID = bytes.fromhex("fabcab09d0c8d466b176fb831cf7267e")
FOOTER = bytes.fromhex("f85a8c6adef5d97eece90ce3758f290b")
"""`FILE_ID` and `FOOTER_ID` must match `CREATION_TIME`, which readers check."""
CM_PER_M = 100.0
AXES = {"UpAxis": 2, "UpAxisSign": 1, "FrontAxis": 1, "FrontAxisSign": -1, "CoordAxis": 0, "CoordAxisSign": 1}


@dataclass(frozen=True)
class Part:
    """A mesh with one texture.

    Attributes:
        name: name of the object.
        shape: its faces, all on one page; metres, z up.
        image: texture file, relative to the FBX.
    """

    name: str
    shape: Textured
    image: str


@dataclass
class Record:
    """A record of the tree; properties are int (64 bits), float, str, bytes and arrays of float64 or int32."""

    name: str
    properties: Sequence[Any] = ()
    children: list[Record] = field(default_factory=list)

    def add(self, name: str, *properties: Any) -> Record:
        """Add a child and return it."""
        self.children.append(Record(name, properties))
        return self.children[-1]

    def encoded(self, start: int) -> bytes:
        """The bytes of the record at offset `start` of the file."""
        properties = b"".join(map(_property, self.properties))
        head = 13 + len(self.name)
        nested = b""
        for child in self.children:
            nested += child.encoded(start + head + len(properties) + len(nested))
        if self.children:
            nested += bytes(13)
        end = start + head + len(properties) + len(nested)
        name = self.name.encode("ascii")
        return struct.pack("<IIIB", end, len(self.properties), len(properties), len(name)) + name + properties + nested


def write(path: Path, parts: Sequence[Part]) -> None:
    """Write meshes into one file."""
    top = Record("")
    header = top.add("FBXHeaderExtension")
    header.add("FBXHeaderVersion", np.int32(1003))
    header.add("FBXVersion", np.int32(VERSION))
    top.add("FileId", FILE_ID)
    top.add("CreationTime", CREATION_TIME)
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
    """Add a mesh: its geometry, model, material, texture and video (image), with ids from `number` on."""
    geometry, model, material, texture, video = range(number, number + 5)
    _geometry(objects.add("Geometry", geometry, _named(part.name, "Geometry"), "Mesh"), part.shape)
    node = objects.add("Model", model, _named(part.name, "Model"), "Mesh")
    node.add("Version", np.int32(232))
    material_record = objects.add("Material", material, _named(part.name, "Material"), "")
    material_record.add("Version", np.int32(102))
    material_record.add("ShadingModel", "lambert")
    texture_record = objects.add("Texture", texture, _named(part.name, "Texture"), "")
    clip = objects.add("Video", video, _named(part.name, "Video"), "Clip")
    for kind, record in (("TextureVideoClip", texture_record), ("Clip", clip)):
        record.add("Type", kind)
        record.add("FileName", part.image)
        record.add("RelativeFilename", part.image)
    for child, parent in ((geometry, model), (model, 0), (material, model), (video, texture)):
        connections.add("C", "OO", child, parent)
    connections.add("C", "OP", texture, material, "DiffuseColor")


def _geometry(record: Record, shape: Textured) -> None:
    mesh = shape.mesh
    assert mesh.uv is not None
    record.add("GeometryVersion", np.int32(124))
    record.add("Vertices", mesh.vertices.astype(np.float64).ravel() * CM_PER_M)
    ends = mesh.faces.astype(np.int32) * np.array([1, 1, -1], np.int32) - np.array([0, 0, 1], np.int32)
    record.add("PolygonVertexIndex", ends.ravel())  # the last corner of a polygon is encoded as -1 - index
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
        entry = layer.add("LayerElement")
        entry.add("Type", f"LayerElement{kind}")
        entry.add("TypedIndex", np.int32(0))


def _named(name: str, kind: str) -> str:
    return f"{name}\x00\x01{kind}"


def _properties(record: Record, values: dict[str, int | float]) -> None:
    """Add named properties, integers and floats."""
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
        file.write(MAGIC + struct.pack("<I", VERSION))
        for record in top.children:
            file.write(record.encoded(file.tell()))
        file.write(bytes(13) + FOOTER_ID + bytes(4))
        file.write(bytes(16 - file.tell() % 16) + struct.pack("<I", VERSION) + bytes(120) + FOOTER)
