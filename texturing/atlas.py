"""Texture coordinates of one block of a mesh: UVAtlas and xatlas behind one function.

Both are native code that can hang or crash; `texturing.unwrap` calls them in a child process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.types import F32, I32

Backend = Literal["uvatlas", "xatlas"]
SMALLEST = 16
"""Pages are at least this wide (texels)."""
COARSE = 4
"""xatlas packs in steps of this many texels at most: its search for places slows with their number."""
CHART = 30_000
"""xatlas' charts are at most this many texels: growing one takes the square of its faces."""
FINEST = 0.01
"""Metres of a texel; wider ones don't make charts larger, for the same reason."""


@dataclass(frozen=True)
class Unwrapped:
    """A block's place on its page.

    Attributes:
        uv: (F, 3, 2) float32 in [0, 1], origin at the lower left.
        width, height: texels the page needs for the asked density.
        charts: number of them.
        backend: which one made them.
    """

    uv: F32
    width: int
    height: int
    charts: int
    backend: Backend


def unwrap_blocks(
    backend: Backend, blocks: Sequence[tuple[F32, I32]], texel: float, gutter: int
) -> list[Unwrapped | str]:
    """Unwrap blocks (vertices (V, 3) metres, faces (F, 3)), each onto a page of its own, or the reason why not."""
    backends = {"uvatlas": _uvatlas, "xatlas": _xatlas}
    out: list[Unwrapped | str] = []
    for vertices, faces in blocks:
        try:
            out.append(backends[backend](vertices, faces, texel, gutter))
        except RuntimeError as error:
            out.append(str(error).strip().splitlines()[-1])
    return out


def manifold(faces: I32) -> tuple[I32, I32]:
    """Cut a mesh where it is no manifold: edges of three faces or of unlike winding, pinched vertices, twin faces.

    Args:
        faces: (F, 3) without repeated vertices within a face.

    Returns:
        The faces (F, 3) into new vertices, and the old vertex (N,) of each new one.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corner = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    loose = np.zeros(len(faces), bool)  # faces set free on all sides: what a cut along edges alone can't mend
    while True:
        a, b = corner.ravel(), corner[:, [1, 2, 0]].ravel()  # corners at the start and end of every directed edge
        start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
        key = np.minimum(start, end) << 32 | np.maximum(start, end)
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
        pairs = first[np.diff(np.r_[first, len(key)]) == 2]
        e, f = order[pairs], order[pairs + 1]
        whole = (start[e] == end[f]) & ~loose[e // 3] & ~loose[f // 3]
        e, f = e[whole], f[whole]
        rows, columns = np.r_[a[e], b[e]], np.r_[b[f], a[f]]
        links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(faces.size, faces.size))
        n, joined = connected_components(links, directed=False)
        new = joined.reshape(-1, 3).astype(np.int32)
        again = _crowded(new)
        if not again.any():
            old = np.empty(n, np.int32)
            old[new.ravel()] = faces.ravel()
            return new, old
        loose |= again


def _crowded(faces: I32) -> np.ndarray:
    """(F,) whether a face has an edge that more than two faces share, or two in the same direction, or has a twin."""
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

    It seeds itself from the system's entropy, which nothing can change from outside: charts differ by a
    fraction of a texel from run to run. xatlas repeats itself exactly.
    """
    import open3d as o3d

    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    cut, old = manifold(faces[whole])
    area = _area(vertices[faces])
    guess = math.sqrt(area / 0.6) / texel
    tensor: Any = o3d.core.Tensor
    mesh = o3d.t.geometry.TriangleMesh(tensor(np.ascontiguousarray(vertices[old])), tensor(np.ascontiguousarray(cut)))
    _, charts, _ = mesh.compute_uvatlas(size=max(SMALLEST, round(guess)), gutter=float(gutter), parallel_partitions=1)
    uv = np.zeros((len(faces), 3, 2), np.float32)
    uv[whole] = mesh.triangle["texture_uvs"].numpy()
    share = _uv_area(uv)
    if not np.isfinite(uv).all() or share <= 0:
        raise RuntimeError("UVAtlas returned no valid coordinates")
    side = _fit(math.sqrt(area / share) / texel)
    return Unwrapped(uv, side, side, int(charts), "uvatlas")


def _xatlas(vertices: F32, faces: I32, texel: float, gutter: int) -> Unwrapped:
    """By xatlas (Young), Thekla's atlas grown on."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, dtype=np.uint32))
    chart, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    chart.max_chart_area = CHART * min(texel, FINEST) ** 2
    coarse = min(COARSE, gutter)
    pack.padding, pack.texels_per_unit = math.ceil(gutter / coarse), 1.0 / (coarse * texel)
    atlas.generate(chart, pack)
    if not atlas.width or not atlas.height:
        raise RuntimeError("xatlas made no atlas")
    _, index, uv = atlas.get_mesh(0)
    return Unwrapped(
        np.ascontiguousarray(uv[index], np.float32),
        max(SMALLEST, coarse * int(atlas.width)),
        max(SMALLEST, coarse * int(atlas.height)),
        int(atlas.chart_count),
        "xatlas",
    )


def _fit(side: float) -> int:
    return max(SMALLEST, math.ceil(side / 4) * 4)
