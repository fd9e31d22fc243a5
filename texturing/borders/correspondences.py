"""Corresponding points of textured meshes along shared borders, and their texture coordinates in each mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, I64, Mesh
from scan2sim.pipeline.geometry.coordinate_grid import GRID_M, world

SAMPLE_SPACING_M = 0.015
"""Metres between the sample points along an edge: texels span a centimetre or more."""
SOFTENING_M = SAMPLE_SPACING_M / 2
"""Softening length in metres of inverse-distance weights: nearer points have about the same weight."""


@dataclass(frozen=True)
class OpenEdges:
    """Open edges of a textured mesh: those of a single face.

    Attributes:
        ends: (E, 2, 3) int64 world positions of an edge's ends, multiples of `GRID_M`.
        uv: (E, 2, 2) float32 texture coordinates of the ends on the edge's face.
        page: (E,) page of the face.
    """

    ends: I64
    uv: F32
    page: npt.NDArray[np.int16]


@dataclass(frozen=True)
class Samples:
    """Texture samples of a mesh at border points; points at vertices have a sample on each of their faces.

    Attributes:
        point: (L,) index of the border point.
        page: (L,) page of the face.
        uv: (L, 2) texture coordinates.
    """

    point: I64
    page: npt.NDArray[np.int16]
    uv: F32


@dataclass(frozen=True)
class Border:
    """Points that meshes share along their borders.

    Attributes:
        xyz: (P, 3) float64 points, world metres.
        metres: (P,) length of border that each point represents.
        samples: texture samples of every mesh.
        length: for each mesh but the first, metres of the first mesh's border edges that it shares (at least both
            ends of the edge).
    """

    xyz: F64
    metres: F64
    samples: tuple[Samples, ...]
    length: tuple[float, ...]

    def __len__(self) -> int:
        return len(self.xyz)


def open_edges(mesh: Mesh) -> OpenEdges:
    """Open edges of a mesh with uv and page."""
    assert mesh.uv is not None and mesh.page is not None
    a, b = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, axis=1).ravel().astype(np.int64)
    _, edge, count = np.unique(np.minimum(a, b) << 32 | np.maximum(a, b), return_index=True, return_counts=True)
    edge = np.sort(edge[count == 1])
    grid_position = np.rint(world(mesh) / GRID_M).astype(np.int64)
    face, corner = edge // 3, edge % 3
    uv = np.stack([mesh.uv[face, corner], mesh.uv[face, (corner + 1) % 3]], axis=1)
    return OpenEdges(grid_position[np.stack([a[edge], b[edge]], axis=1)], uv, mesh.page[face])


def shared_border(meshes: Sequence[OpenEdges], spacing: float = SAMPLE_SPACING_M) -> Border:
    """Border points of any two meshes: shared vertices, and points along shared edges every `spacing` metres.

    All tiles find identical points: an edge is sampled from its end with the smaller index.

    Args:
        meshes: open edges of each mesh.
        spacing: metres between points along edges.
    """
    all_ends = np.concatenate([mesh.ends.reshape(-1, 3) for mesh in meshes])
    vertex, number = np.unique(all_ends, axis=0, return_inverse=True)
    numbers = np.split(number.reshape(-1, 2), np.cumsum([len(mesh.ends) for mesh in meshes])[:-1])
    codes = [ends.min(axis=1) * len(vertex) + ends.max(axis=1) for ends in numbers]
    corners, edges = _shared(numbers), _shared(codes)
    start, end = vertex[edges // len(vertex)] * GRID_M, vertex[edges % len(vertex)] * GRID_M
    parts = np.maximum(1, np.ceil(np.linalg.norm(end - start, axis=1) / spacing)).astype(np.int64)
    which, part = _along(parts)
    share = (part + 0.5) / parts[which]
    xyz = np.concatenate([vertex[corners] * GRID_M, start[which] + share[:, None] * (end - start)[which]])
    samples = tuple(_samples(*mesh, corners, edges, parts) for mesh in zip(meshes, numbers, codes, strict=True))
    edge_length = np.linalg.norm(np.diff(meshes[0].ends, axis=1)[:, 0] * GRID_M, axis=1)
    length = tuple(float(edge_length[np.isin(numbers[0], other).all(axis=1)].sum()) for other in numbers[1:])
    # edges of which only the ends are shared are represented by their ends
    only_ends = np.isin(numbers[0], corners).all(axis=1) & ~np.isin(codes[0], edges)
    half = np.where(only_ends, edge_length / 2, 0)
    at_ends = np.bincount(numbers[0].ravel(), np.repeat(half, 2), len(vertex))[corners]
    along = (np.linalg.norm(end - start, axis=1) / parts)[which]
    return Border(xyz, np.concatenate([np.maximum(at_ends, SAMPLE_SPACING_M / 2), along]), samples, length)


def _shared(arrays: Sequence[I64]) -> I64:
    """Values that at least two of the arrays contain, ascending."""
    value, count = np.unique(np.concatenate([np.unique(array) for array in arrays]), return_counts=True)
    return value[count > 1]


def _along(parts: I64) -> tuple[I64, I64]:
    """Edge and index of every part, for edges divided into `parts` (N,) parts each."""
    which = np.repeat(np.arange(len(parts)), parts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)


def _samples(mesh: OpenEdges, number: I64, code: I64, corners: I64, edges: I64, parts: I64) -> Samples:
    """Samples of a mesh at the points of `shared_border`: `corners` first, then each of `edges` in `parts` (N,)."""
    at = np.flatnonzero(np.isin(number, corners))
    rows = np.flatnonzero(np.isin(code, edges))
    edge = np.searchsorted(edges, code[rows])
    which, part = _along(parts[edge])
    point = (len(corners) + np.cumsum(parts) - parts)[edge][which] + part
    row, share = rows[which], ((part + 0.5) / parts[edge][which]).astype(np.float32)
    share = np.where(number[row, 0] <= number[row, 1], share, 1 - share)[:, None]
    return Samples(
        np.concatenate([np.searchsorted(corners, number.ravel()[at]), point]),
        np.concatenate([mesh.page[at // 2], mesh.page[row]]),
        np.concatenate([mesh.uv.reshape(-1, 2)[at], (1 - share) * mesh.uv[row, 0] + share * mesh.uv[row, 1]]),
    )
