"""Faces of OBJ files that trimesh would read wrongly: relative indices, and concave polygons.

Trimesh counts relative indices back from the end of the file, not from the line, and cuts polygons into fans, which
only fits convex ones: a wall with windows is one polygon for SketchUp, Rhino or Blender, whose fan would cover them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.types import F64

RELATIVE = re.compile(r"^[ \t]*f[ \t][^\n]*-\d", re.MULTILINE)
"""A face with a negative index."""
POLYGON = re.compile(r"^[ \t]*f(?:[ \t]+[\d/]+){5,}[ \t\r]*$", re.MULTILINE)
"""A face of five or more corners."""
CONTINUED = re.compile(r"\\\r?\n")
"""The end of a line that the next one continues (Rhino)."""
VERTEX = re.compile(r"^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
MAX_BEND = 0.01
"""Distance of corners from the plane of their polygon over its extent, above which it is no plane polygon."""
MIN_TURN = 1e-9
"""Area beside that of the whole polygon below which a triangle has none."""
Triangle = tuple[int, int, int]


def rewritten(text: str) -> str:
    """The text of an OBJ with absolute indices, and the concave ones of its polygons as triangles."""
    return triangulated(absolute(CONTINUED.sub(" ", text)))


def absolute(text: str) -> str:
    """The text of an OBJ with indices that count from its first vertex; negative ones count back from their line."""
    if RELATIVE.search(text) is None:
        return text
    counts, lines = {"v": 0, "vt": 0, "vn": 0}, text.splitlines()
    for i, line in enumerate(lines):
        key, *cells = line.split() or [""]
        if key in counts:
            counts[key] += 1
        elif key == "f" and "-" in line:
            corners = (cell.partition("#")[0].split("/") for cell in cells)
            lines[i] = "f " + " ".join("/".join(map(_absolute, corner, counts.values())) for corner in corners)
    return "\n".join(lines) + "\n"


def _absolute(index: str, count: int) -> str:
    return str(count + 1 + int(index)) if index.startswith("-") and index[1:].isdecimal() else index


def triangulated(text: str) -> str:
    """The text of an OBJ with absolute indices, with the concave ones of its polygons as triangles; others remain."""
    faces = list(POLYGON.finditer(text))
    if not faces:
        return text
    try:
        vertices = np.array(VERTEX.findall(text), np.float64)
    except ValueError:  # reading the mesh reports it
        return text
    parts, at = list[str](), 0
    for face in faces:
        corners = face.group().split()[1:]
        index = [int(corner.partition("/")[0]) - 1 for corner in corners]
        if not all(0 <= i < len(vertices) for i in index):
            continue
        triangles = triangles_of(vertices[index])
        if triangles:
            lines = ["f " + " ".join(corners[i] for i in triangle) for triangle in triangles]
            parts += [text[at : face.start()], "\n".join(lines)]
            at = face.end()
    return "".join([*parts, text[at:]])


def triangles_of(corners: F64) -> list[Triangle]:
    """Corners of the triangles of a concave plane polygon (N, 3), in the order of its sides; empty for others."""
    own = corners - corners[0]
    fan = np.cross(own[1:-1], own[2:])
    normal = fan.sum(axis=0)
    size, extent = float(np.linalg.norm(normal)), float(np.abs(own).max())
    bent = bool((np.abs(own @ normal) > MAX_BEND * extent * size).any())
    if bent or not (fan @ normal < -MIN_TURN * size**2).any():
        return []
    axis = int(np.abs(normal).argmax())
    flat = np.delete(own, axis, axis=1)
    flat[:, 1] *= np.sign(normal[axis]) * (-1 if axis == 1 else 1)  # counterclockwise
    return _clipped(flat.tolist(), MIN_TURN * float(np.abs(normal[axis])))


def _clipped(points: Sequence[Sequence[float]], least: float) -> list[Triangle]:
    """Triangles of a counterclockwise polygon, by ear clipping; holes may be joined to its outline by double edges.

    Source: Meisters, "Polygons have ears", American Mathematical Monthly 82 (1975).
    """
    rest, found = list(range(len(points))), list[Triangle]()
    while len(rest) >= 3:
        ears = [(rest[k - 1], rest[k], rest[(k + 1) % len(rest)]) for k in range(len(rest))]
        areas = [_area(*(points[i] for i in ear)) for ear in ears]
        ear = next((k for k, ear in enumerate(ears) if areas[k] > least and not _contains(points, ear, rest)), None)
        if ear is not None:
            found.append(ears[ear])
        del rest[ear if ear is not None else min(range(len(rest)), key=lambda k: abs(areas[k]))]
    return found


def _area(a: Sequence[float], b: Sequence[float], c: Sequence[float]) -> float:
    """Twice the area of a triangle, positive if it is counterclockwise."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _contains(points: Sequence[Sequence[float]], ear: Triangle, rest: Sequence[int]) -> bool:
    """Whether another corner of a polygon lies in an ear, or on its sides, unless it is at one of its corners."""
    a, b, c = (points[i] for i in ear)
    return any(
        p not in (a, b, c) and min(_area(a, b, p), _area(b, c, p), _area(c, a, p)) >= 0
        for p in (points[i] for i in rest)
    )
