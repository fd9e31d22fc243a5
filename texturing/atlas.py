"""Texture atlas of one block of a mesh: UVAtlas and xatlas behind one function.

Both are native code that can hang or crash, so `texturing.unwrap` calls them in a child process.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.types import F32, I32

Backend = Literal["uvatlas", "xatlas"]
MIN_PAGE_TEXELS = 16
"""Smallest width and height of a page."""
PACKING_STEP_TEXELS = 4
"""Largest step in which xatlas packs charts: its search slows down with the number of possible positions."""
MAX_CHART_TEXELS = 30_000
"""Largest area of xatlas' charts: growing a chart takes time quadratic in its faces."""
CHART_LIMIT_TEXEL_M = 0.01
"""Texel size in metres above which charts don't get larger, for the same reason."""

_kept: list[Any] = []
"""Atlases of xatlas, which are never freed: that can wait forever for a thread of xatlas that goes to sleep just when
it is woken up to end. A child process makes one only, and ends without freeing it."""


@dataclass(frozen=True)
class Unwrapped:
    """Texture coordinates of a block on its page.

    Attributes:
        uv: (F, 3, 2) float32 in [0, 1], origin at the lower left.
        width, height: size of the page in texels for the wanted density.
        charts: number of charts.
        backend: backend that made them.
    """

    uv: F32
    width: int
    height: int
    charts: int
    backend: Backend


def unwrap_block(backend: Backend, vertices: F32, faces: I32, texel: float, gutter: int) -> Unwrapped:
    """Unwrap a block (vertices (V, 3) in metres, faces (F, 3)) onto one page.

    Raises:
        RuntimeError: the backend can't.
    """
    return {"uvatlas": _uvatlas, "xatlas": _xatlas}[backend](vertices, faces, texel, gutter)


def manifold(faces: I32) -> tuple[I32, I32]:
    """Cut a mesh where it is not manifold: edges of three faces, inconsistent winding, pinched vertices, twin faces.

    Args:
        faces: (F, 3) without repeated vertices within a face.

    Returns:
        Faces (F, 3) that index new vertices, and the old vertex (N,) of each new vertex.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corner = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    loose = np.zeros(len(faces), bool)  # faces cut off on all sides, where cutting single edges is not enough
    while True:
        a, b = corner.ravel(), corner[:, [1, 2, 0]].ravel()  # corners at the start and end of every directed edge
        start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
        key = np.minimum(start, end) << 32 | np.maximum(start, end)
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
        pairs = first[np.diff(np.r_[first, len(key)]) == 2]
        e, f = order[pairs], order[pairs + 1]
        valid = (start[e] == end[f]) & ~loose[e // 3] & ~loose[f // 3]
        e, f = e[valid], f[valid]
        rows, columns = np.r_[a[e], b[e]], np.r_[b[f], a[f]]
        links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(faces.size, faces.size))
        n, joined = connected_components(links, directed=False)
        new = joined.reshape(-1, 3).astype(np.int32)
        again = _non_manifold(new)
        if not again.any():
            old = np.empty(n, np.int32)
            old[new.ravel()] = faces.ravel()
            return new, old
        loose |= again


def _non_manifold(faces: I32) -> np.ndarray:
    """(F,) faces with an edge that more than two faces share, or two in the same direction, and duplicate faces."""
    start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
    key = np.minimum(start, end) << 32 | np.maximum(start, end)
    _, index, count = np.unique(key, return_inverse=True, return_counts=True)
    _, directed, same = np.unique(start << 32 | end, return_inverse=True, return_counts=True)
    _, kind, twins = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    return ((count[index] > 2) | (same[directed] > 1)).reshape(-1, 3).any(axis=1) | (twins[kind.ravel()] > 1)


def _area(corners: F32) -> float:
    edges = corners[:, 1:] - corners[:, :1]
    return float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2)


def _uv_area(uv: F32) -> float:
    edges = uv[:, 1:] - uv[:, :1]
    return float(np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum() / 2)


def _uvatlas(vertices: F32, faces: I32, texel: float, gutter: int) -> Unwrapped:
    """Microsoft's UVAtlas (Zhou et al. 2004) through Open3D.

    Not deterministic: it takes its seed from the system and offers no way to set it; charts differ by a fraction of a
    texel from run to run. xatlas is deterministic.
    """
    import open3d as o3d

    valid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    cut, old = manifold(faces[valid])
    area = _area(vertices[faces])
    guess = math.sqrt(area / 0.6) / texel
    tensor: Any = o3d.core.Tensor
    mesh = o3d.t.geometry.TriangleMesh(tensor(np.ascontiguousarray(vertices[old])), tensor(np.ascontiguousarray(cut)))
    _, charts, _ = mesh.compute_uvatlas(
        size=max(MIN_PAGE_TEXELS, round(guess)), gutter=float(gutter), parallel_partitions=1
    )
    uv = np.zeros((len(faces), 3, 2), np.float32)
    uv[valid] = mesh.triangle["texture_uvs"].numpy()
    share = _uv_area(uv)
    if not np.isfinite(uv).all() or share <= 0:
        raise RuntimeError("UVAtlas returned no valid coordinates")
    side = _page_side(math.sqrt(area / share) / texel)
    return Unwrapped(uv, side, side, int(charts), "uvatlas")


def _xatlas(vertices: F32, faces: I32, texel: float, gutter: int) -> Unwrapped:
    """The xatlas library (Young), a fork of thekla_atlas."""
    import xatlas

    atlas = xatlas.Atlas()
    _kept.append(atlas)
    atlas.add_mesh(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, dtype=np.uint32))
    chart, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    chart.max_chart_area = MAX_CHART_TEXELS * min(texel, CHART_LIMIT_TEXEL_M) ** 2
    step = min(PACKING_STEP_TEXELS, gutter)
    pack.padding, pack.texels_per_unit = math.ceil(gutter / step), 1.0 / (step * texel)
    atlas.generate(chart, pack)
    if not atlas.width or not atlas.height:
        raise RuntimeError("xatlas made no atlas")
    _, index, uv = atlas.get_mesh(0)
    return Unwrapped(
        np.ascontiguousarray(uv[index], np.float32),
        max(MIN_PAGE_TEXELS, step * int(atlas.width)),
        max(MIN_PAGE_TEXELS, step * int(atlas.height)),
        int(atlas.chart_count),
        "xatlas",
    )


def _page_side(side: float) -> int:
    """Width and height of a page in texels, rounded up to a multiple of 4."""
    return max(MIN_PAGE_TEXELS, math.ceil(side / 4) * 4)
