"""Corresponding places of textured meshes: those they share along a border, and where each has them on its pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, I64, Mesh
from scan2sim.pipeline.tiling.borders.grid import GRID, world

SPACING = 0.015
"""Metres between the places of an edge where colours are compared: texels span a centimetre or more."""
SOFT = SPACING / 2
"""Metres within which places count alike."""


@dataclass(frozen=True)
class Rim:
    """Where a textured mesh ends: its edges of one face.

    Attributes:
        ends: (E, 2, 3) int64, world places of an edge's ends, multiples of `GRID`.
        uv: (E, 2, 2) float32, their texture coordinates on the edge's face.
        page: (E,) the face's page.
    """

    ends: I64
    uv: F32
    page: npt.NDArray[np.int16]


@dataclass(frozen=True)
class Samples:
    """Where on its pages a mesh is sampled at places; those at vertices are on several faces.

    Attributes:
        place: (L,) index of the place.
        page: (L,) of the face.
        uv: (L, 2) texture coordinates.
    """

    place: I64
    page: npt.NDArray[np.int16]
    uv: F32


@dataclass(frozen=True)
class Border:
    """Places that meshes share.

    Attributes:
        xyz: (P, 3) float64, world metres.
        metres: (P,) of the border that each place stands for.
        samples: of every mesh.
        length: metres of the first mesh's border edges that each other one shares, at their ends at least.
    """

    xyz: F64
    metres: F64
    samples: tuple[Samples, ...]
    length: tuple[float, ...]

    def __len__(self) -> int:
        return len(self.xyz)


def rim(mesh: Mesh) -> Rim:
    """The edges of one face of a mesh with uv and page."""
    assert mesh.uv is not None and mesh.page is not None
    a, b = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, axis=1).ravel().astype(np.int64)
    _, edge, count = np.unique(np.minimum(a, b) << 32 | np.maximum(a, b), return_index=True, return_counts=True)
    edge = np.sort(edge[count == 1])
    place = np.rint(world(mesh) / GRID).astype(np.int64)
    face, corner = edge // 3, edge % 3
    uv = np.stack([mesh.uv[face, corner], mesh.uv[face, (corner + 1) % 3]], axis=1)
    return Rim(place[np.stack([a[edge], b[edge]], axis=1)], uv, mesh.page[face])


def shared_border(rims: Sequence[Rim], spacing: float = SPACING) -> Border:
    """Places where any two meshes meet: shared vertices, and along shared edges every `spacing` metres.

    All tiles that share a place find the same one: an edge is walked from its lesser end.
    """
    everywhere = np.concatenate([rim.ends.reshape(-1, 3) for rim in rims])
    vertex, number = np.unique(everywhere, axis=0, return_inverse=True)
    numbers = np.split(number.reshape(-1, 2), np.cumsum([len(rim.ends) for rim in rims])[:-1])
    codes = [ends.min(axis=1) * len(vertex) + ends.max(axis=1) for ends in numbers]
    corners, edges = _shared(numbers), _shared(codes)
    start, end = vertex[edges // len(vertex)] * GRID, vertex[edges % len(vertex)] * GRID
    parts = np.maximum(1, np.ceil(np.linalg.norm(end - start, axis=1) / spacing)).astype(np.int64)
    which, part = _along(parts)
    share = (part + 0.5) / parts[which]
    xyz = np.concatenate([vertex[corners] * GRID, start[which] + share[:, None] * (end - start)[which]])
    samples = tuple(_samples(*of, corners, edges, parts) for of in zip(rims, numbers, codes, strict=True))
    long = np.linalg.norm(np.diff(rims[0].ends, axis=1)[:, 0] * GRID, axis=1)
    length = tuple(float(long[np.isin(numbers[0], other).all(axis=1)].sum()) for other in numbers[1:])
    # what is shared at its ends alone is stood for by these
    half = np.where(np.isin(numbers[0], corners).all(axis=1) & ~np.isin(codes[0], edges), long / 2, 0)
    at_ends = np.bincount(numbers[0].ravel(), np.repeat(half, 2), len(vertex))[corners]
    along = (np.linalg.norm(end - start, axis=1) / parts)[which]
    return Border(xyz, np.concatenate([np.maximum(at_ends, SPACING / 2), along]), samples, length)


def _shared(names: Sequence[I64]) -> I64:
    """What at least two of the arrays contain, ascending."""
    name, count = np.unique(np.concatenate([np.unique(array) for array in names]), return_counts=True)
    return name[count > 1]


def _along(parts: I64) -> tuple[I64, I64]:
    """The parts of all edges one after another, `parts` (N,) of each: which edge, which part of it."""
    which = np.repeat(np.arange(len(parts)), parts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)


def _samples(rim: Rim, number: I64, code: I64, corners: I64, edges: I64, parts: I64) -> Samples:
    """Where a mesh shows the places of `shared_border`: `corners` come first, then each of `edges` in `parts` (N,)."""
    at = np.flatnonzero(np.isin(number, corners))
    rows = np.flatnonzero(np.isin(code, edges))
    edge = np.searchsorted(edges, code[rows])
    which, part = _along(parts[edge])
    place = (len(corners) + np.cumsum(parts) - parts)[edge][which] + part
    row, share = rows[which], ((part + 0.5) / parts[edge][which]).astype(np.float32)
    share = np.where(number[row, 0] <= number[row, 1], share, 1 - share)[:, None]
    return Samples(
        np.concatenate([np.searchsorted(corners, number.ravel()[at]), place]),
        np.concatenate([rim.page[at // 2], rim.page[row]]),
        np.concatenate([rim.uv.reshape(-1, 2)[at], (1 - share) * rim.uv[row, 0] + share * rim.uv[row, 1]]),
    )
