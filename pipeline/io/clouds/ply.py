"""PLY clouds (Turk 1994): the vertices of an ASCII or binary file, with float64 coordinates.

A file must have exactly the number of vertices that its header declares, otherwise it is rejected as truncated. So are
Gaussian splats, whose centres are not on surfaces, and meshes whose vertices don't cover their surface.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import file_checks, label_sets, number_text, point_chunks
from scan2sim.pipeline.io.point_chunks import READ_POINTS, Points

SUFFIXES = (".ply",)
REMEDY = "Export it again, or as LAZ"
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
CLASSES = ("classification", "class", "label", "scalar_classification", "scalar_label")
INTENSITIES = ("intensity", "intensities", "reflectivity", "scalar_intensity", "reflectance")
TIMES = ("gps_time", "time", "timestamp", "scalar_gpstime")
SPLATS = ("f_dc_0", "packed_position")
"""Properties of Gaussian splats: colour (3DGS), and the position in compressed files (PlayCanvas)."""
MAX_HEADER_BYTES = 100_000
LARGE_FACE_EDGES = 5.0
"""Longest edge of a face, in medians of all faces, from which its inside has no vertices nearby."""
MAX_EDGE_SHARE = 0.1
"""The same in diagonals of the mesh: all faces of a box are large."""
MAX_LARGE_FACE_SHARE = 0.2
"""Share of a mesh's surface in large faces, from which its vertices are no cloud of the surface."""


@dataclass(frozen=True)
class Layout:
    """Layout of the vertices in a file.

    Attributes:
        form: "ascii", "binary_little_endian" or "binary_big_endian".
        count: number of vertices that the header declares.
        row: dtype of a vertex, property names in lower case.
        start: byte offset of the first element after the header.
        before: size of the elements before the vertices: lines (ASCII) or bytes.
        last: whether the vertices are the last element.
        faces: number of faces that the header declares.
    """

    form: str
    count: int
    row: np.dtype[Any]
    start: int
    before: int
    last: bool
    faces: int = 0


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of finite points, low and high corner (CRS units), no CRS, and notes on faces and points that aren't used.

    Raises:
        InputError: as `layout`, or a mesh whose vertices don't cover its surface.
    """
    header = layout(path)
    faces = _faces_note(path, header.faces) if header.faces else ()
    found = point_chunks.summary(path, parts(path))
    removed = header.count - found.count
    notes = (f"{removed:,} points with NaN coordinates removed",) if removed else ()
    return found.count, found.low, found.high, None, (*faces, *notes, *_label_notes(header), *found.notes)


def class_names(path: Path) -> tuple[bool, dict[int, str]]:
    """Whether classes are our own codes, as those of recognized data sets are; and no names."""
    return label_sets.matching(layout(path).row.names or ()) is not None, {}


def layout(path: Path) -> Layout:
    """Parse the header.

    Raises:
        InputError: not a PLY header, Gaussian splats, no vertices with x, y and z, or vertices with list properties.
    """
    with file_checks.check(path).open("rb") as file:
        head, found, _ = file.read(MAX_HEADER_BYTES).partition(b"end_header")
        lines = [line.split() for line in head.decode("latin-1").splitlines()]
        if not head.startswith(b"ply") or not found:
            raise _bad(path, "it has no header")
        file.seek(len(head) + len(found))
        start = file.tell() + len(file.readline(3))  # \n or \r\n
    form = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "")
    if form not in BYTE_ORDERS:
        raise _bad(path, f"its format is the unknown {form[:40]!r}")
    before, elements = 0, _elements(path, lines)
    faces = sum(count for name, count, _ in elements if name in ("face", "tristrips"))
    splats = [name for _, _, properties in elements for _, name in properties if name in SPLATS]
    if splats:
        cause = f"contains Gaussian splats (property {splats[0]}), whose centres are not points on surfaces"
        raise InputError(path, cause, "Give a point cloud or mesh of the scene, such as the dense cloud of its photos")
    for i, (name, count, properties) in enumerate(elements):
        fixed = all(kind in TYPES for kind, _ in properties)
        if name != "vertex" and (fixed or form == "ascii"):
            size = sum(int(TYPES[kind][1]) for kind, _ in properties) if form != "ascii" else 1
            before += count * size
            continue
        names = [name.lower() for _, name in properties]
        if not fixed or name != "vertex" or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
            properties_text = ", ".join(names)[:80] or "none"
            raise _bad(path, f"its {name[:40]} elements have unsupported properties: {properties_text}")
        row = np.dtype([(n, BYTE_ORDERS[form] + TYPES[kind]) for (kind, _), n in zip(properties, names, strict=True)])
        if count == 0:
            raise InputError(path, "contains no points", "Remove it from the tile")
        return Layout(form, count, row, start, before, i == len(elements) - 1, faces)
    raise _bad(path, f"it has {faces:,} faces, but no vertices" if faces else "it has no vertices")


def _faces_note(path: Path, faces: int) -> tuple[str, ...]:
    """Note on the faces of a mesh, of which only the vertices are used.

    Raises:
        InputError: its vertices don't cover its surface.
    """
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    except Exception as error:  # trimesh's parsers raise any exception on damaged files
        raise _bad(path, f"it is a mesh whose {faces:,} faces can't be read: {error}") from None
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))) if len(edge) else 0.0
    large = edge > min(LARGE_FACE_EDGES * float(np.median(edge)), MAX_EDGE_SHARE * diagonal) if len(edge) else edge > 0
    if area[large].sum() > MAX_LARGE_FACE_SHARE * area.sum():
        cause = f"is a mesh of {faces:,} faces, not a point cloud: its large faces have no points inside"
        raise InputError(path, cause, f"Import the mesh: scan2sim import map {path} --out TILE")
    return (
        f"is a mesh: its vertices are the points, its {faces:,} faces are ignored (`scan2sim import map` uses them)",
    )


def _label_notes(header: Layout) -> tuple[str, ...]:
    """Note on how a field of labels that isn't named as LAS's classes is read."""
    names = header.row.names or ()
    known, field = label_sets.matching(names), next((name for name in CLASSES if name in names), None)
    if known is not None:
        return (f"labels are read as those of {known.name}",)
    return label_sets.field_notes(field)


def _elements(path: Path, lines: list[list[str]]) -> list[tuple[str, int, list[tuple[str, str]]]]:
    """Name, count and properties (type, name; type "list" for lists) of each element."""
    found: list[tuple[str, int, list[tuple[str, str]]]] = []
    for words in lines:
        try:
            if words[:1] == ["element"]:
                found.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                found[-1][2].append((words[1], words[-1]))
        except (IndexError, ValueError):
            raise _bad(path, f"invalid header line {' '.join(words)[:80]!r}") from None
    if any(count < 0 for _, count, _ in found):
        raise _bad(path, "its header declares a negative number of elements")
    return found


def parts(path: Path) -> Iterator[Points]:
    """The vertices, in chunks.

    Raises:
        InputError: there are fewer or more vertices than declared, or they can't be parsed.
    """
    header = layout(path)
    for rows in _ascii_rows(path, header) if header.form == "ascii" else _binary_rows(path, header):
        names = rows.dtype.names or ()

        def first(wanted: Sequence[str], rows: Any = rows, names: Sequence[str] = names) -> Any:
            return next((rows[name] for name in wanted if name in names), None)

        known = label_sets.matching(names)
        rgb_names = next((three for three in COLOURS if set(three) <= set(names)), None)
        yield Points(
            np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"]),
            None if rgb_names is None else np.column_stack([rows[name] for name in rgb_names]),
            classification=first(CLASSES) if known is None else known.codes(rows[known.label]),
            time=first(TIMES),
            intensity=first(INTENSITIES),
        )


def _binary_rows(path: Path, header: Layout) -> Iterator[npt.NDArray[Any]]:
    first = header.start + header.before
    available = max(0, path.stat().st_size - first) // header.row.itemsize
    if available < header.count or (header.last and available > header.count):
        raise _wrong_count(path, header.count, available)
    with path.open("rb") as file:
        file.seek(first)
        for at in range(0, header.count, READ_POINTS):
            yield np.fromfile(file, header.row, min(READ_POINTS, header.count - at))


def _ascii_rows(path: Path, header: Layout) -> Iterator[npt.NDArray[Any]]:
    skip, at, names = header.before, 0, header.row.names or ()
    with path.open("rb") as file:
        file.seek(header.start)
        for block in number_text.blocks(path, file):
            lines = block[skip:]
            skip = max(0, skip - len(block))
            if header.last and at + len(lines) > header.count:
                raise _wrong_count(path, header.count, at + len(lines))
            lines = lines[: header.count - at]
            try:
                table = number_text.numbers(lines, None, len(names))
            except ValueError as error:
                if lines and len(lines[-1].split()) < len(names):  # the last line of a truncated file
                    raise _wrong_count(path, header.count, at + len(lines) - 1) from None
                raise _bad(path, f"vertices {at + 1:,} to {at + len(lines):,}: {error}") from None
            rows = np.empty(len(table), header.row)
            with np.errstate(invalid="ignore", over="ignore"):  # values out of range of their type
                for k, name in enumerate(names):
                    rows[name] = table[:, k]
            yield rows
            at += len(rows)
    if at < header.count:
        raise _wrong_count(path, header.count, at)


def _wrong_count(path: Path, declared: int, available: int) -> InputError:
    number = f"{available:,}" if available < declared else f"{available:,} or more"
    cause = f"is truncated or damaged: its header declares {declared:,} vertices, there are {number}"
    return InputError(path, cause, REMEDY)


def _bad(path: Path, cause: str) -> InputError:
    return InputError(path, f"is not a readable PLY cloud ({cause})", REMEDY)
