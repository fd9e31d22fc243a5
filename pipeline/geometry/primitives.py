"""Meshes of primitive shapes: tubes, plates, boxes. Faces are counter-clockwise seen from outside."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I32

Triangles = tuple[F64, I32]
"""Vertices (V, 3) and faces (F, 3)."""


def join(parts: list[Triangles]) -> Triangles:
    """Concatenate meshes; empty for an empty list."""
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    vertices = [part[0] for part in parts] or [np.zeros((0, 3))]
    faces = [part[1] + start for part, start in zip(parts, first[:-1], strict=True)] or [np.zeros((0, 3))]
    return np.concatenate(vertices).astype(np.float64), np.concatenate(faces).astype(np.int32)


def tube(path: npt.ArrayLike, radius: npt.ArrayLike, sides: int) -> Triangles:
    """A round tube along `path` (K, 3) with `radius` (K,), closed at both ends.

    Its cross section is a polygon of `sides` corners with the area of the circle.
    """
    path = np.asarray(path, np.float64)
    out: F64 = np.asarray(radius, np.float64) * np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    helper = np.array([1.0, 0.0, 0.0]) if abs(along[:, 2]).min() > 0.5 else np.array([0.0, 0.0, 1.0])
    if (
        abs(along[:, 2]).min() <= 0.5 < abs(along[:, 2]).max()
    ):  # bends from vertical to horizontal: use a direction perpendicular to both
        helper = np.cross(along[0], along[-1])
    first = np.cross(np.broadcast_to(helper, along.shape), along)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    vertices = (path[:, None] + out[:, None, None] * ring).reshape(-1, 3)
    k = np.arange(sides)
    on = np.roll(k, -1)
    faces = []
    for i in range(len(path) - 1):
        low, high = i * sides, (i + 1) * sides
        faces += [np.column_stack([low + k, low + on, high + on]), np.column_stack([low + k, high + on, high + k])]
    top = (len(path) - 1) * sides
    fan = np.column_stack([np.zeros(sides - 2, int), k[1:-1], k[2:]])
    faces += [top + fan, fan[:, ::-1]]
    return vertices, np.concatenate(faces).astype(np.int32)


def plate(corners: npt.ArrayLike, back: npt.ArrayLike) -> Triangles:
    """A plate with a convex front face, corners (K, 3) counter-clockwise from the front; `back`: offset of its back."""
    front = np.asarray(corners, np.float64)
    n = len(front)
    k = np.arange(n)
    on = np.roll(k, -1)
    fan = np.column_stack([np.zeros(n - 2, int), k[1:-1], k[2:]])
    rim = [np.column_stack([k, n + k, n + on]), np.column_stack([k, n + on, on])]
    faces = np.concatenate([fan, n + fan[:, ::-1], *rim])
    return np.concatenate([front, front + np.asarray(back, np.float64)]), faces.astype(np.int32)


def box(centre: npt.ArrayLike, axes: npt.ArrayLike, half: npt.ArrayLike) -> Triangles:
    """A box around `centre` (3,) with right-handed unit `axes` (3, 3; rows) and half extents `half` (3,)."""
    along = np.asarray(axes, np.float64) * np.asarray(half, np.float64)[:, None]
    a, b, c = along
    face = np.asarray(centre, np.float64) + c + np.array([-a - b, a - b, a + b, -a + b])
    return plate(face, -2 * c)
