"""Charts by projection into photos: faces that take their detail from one photo are flattened as the photo sees them.

OpenMVS and mvs-texturing use the pixels of the photo; here every chart is projected from the camera centre onto the
chart's own plane, so that texels are metric and isotropic for any camera model. What a camera sees doesn't overlap
itself, so no unfolding is needed: a million faces take seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools, Mesh

PLANE_TILT = 0.2
"""Weight of the direction to the camera in a chart's plane normal; the rest is the faces' mean normal."""
MAX_AREA_RATIO = 4.0
"""Faces whose area changes by more than this factor are left to the unwrapper."""
VISIBLE_TEXELS_MIN = 0.6
"""Share of its texels that a face must own where other faces overlap it."""
GRID_CELLS = 8
"""Cells of the grid that cuts charts, along the largest possible chart."""


@dataclass(frozen=True)
class Charts:
    """Flattened faces.

    Attributes:
        face: (N,) indices of the faces.
        chart: (N,) chart of each face, 0 to C - 1.
        flat: (N, 3, 2) float32 positions in texels within the chart, from (0, 0).
        size: (C, 2) width and height of every chart in texels.
    """

    face: I64
    chart: I64
    flat: F32
    size: I64


def cut(mesh: Mesh, view: I32, centres: F64, texel: float, largest: int) -> Charts:
    """Charts of connected faces of one view; faces that would be distorted too much are left out.

    Args:
        mesh: mesh to be cut into charts.
        view: (F,) view of every face, -1 for none.
        centres: (V, 3) camera centres, local metres.
        texel: texel size in metres.
        largest: largest side of a chart in texels.
    """
    part = _components(mesh, view, largest * texel / GRID_CELLS)
    face = np.flatnonzero(part >= 0)
    chart = part[face]
    corners = mesh.corners[face].astype(np.float64)
    centre = centres[view[face]]
    normal, area = mesh.face_normal[face].astype(np.float64), mesh.face_area[face].astype(np.float64)
    count = int(chart.max()) + 1 if len(chart) else 0

    def mean(values: F64) -> F64:
        """(C, K) mean over the faces of every chart, weighted by area."""
        total = np.stack([np.bincount(chart, values[:, k] * area, count) for k in range(values.shape[1])], axis=1)
        return total / np.maximum(np.bincount(chart, area, count), 1e-12)[:, None]

    middle = corners.mean(axis=1)
    towards = _unit(centre - middle)
    plane = _unit((1 - PLANE_TILT) * _unit(mean(normal)) + PLANE_TILT * _unit(mean(towards)))
    origin = mean(middle)
    # project each corner along its ray from the camera centre onto the chart's plane
    ray = corners - centre[:, None]
    n, foot = plane[chart][:, None], origin[chart][:, None]
    along = np.einsum("nkc,nkc->nk", ray, np.broadcast_to(n, ray.shape))
    distance = np.einsum("nkc,nkc->nk", foot - centre[:, None], n)
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = centre[:, None] + ray * (distance / along)[..., None] - foot
    across, up = _axes(plane)
    flat = np.stack([np.einsum("nkc,nc->nk", hit, across[chart]), np.einsum("nkc,nc->nk", hit, up[chart])], axis=-1)
    flat = _aligned(flat, chart, count) / texel
    drawn = _signed_area(flat) * texel**2
    good = np.isfinite(flat).all(axis=(1, 2)) & (distance / np.where(along == 0, 1, along) > 0).all(axis=1)
    good &= (drawn > area / MAX_AREA_RATIO**2) & (drawn < area * MAX_AREA_RATIO**2)
    # scale each chart to the texel density of its area
    total, wanted = (np.bincount(chart, np.where(good, value, 0), count) for value in (drawn, area))
    scale = np.sqrt(wanted / np.maximum(total, 1e-12))[chart]
    flat, drawn = flat * scale[:, None, None], drawn * scale**2
    good &= (drawn > area / MAX_AREA_RATIO) & (drawn < area * MAX_AREA_RATIO)
    face, chart, flat = face[good], chart[good], flat[good]
    used, chart = np.unique(chart, return_inverse=True)
    low, high = np.full((len(used), 2), np.inf), np.full((len(used), 2), -np.inf)
    np.minimum.at(low, chart, flat.min(axis=1))
    np.maximum.at(high, chart, flat.max(axis=1))
    size = np.ceil(high - low).astype(np.int64) + 1
    small = (size <= largest).all(axis=1)
    keep = small[chart]
    new_index = np.cumsum(small) - 1
    flat = (flat - low[chart][:, None]).astype(np.float32)
    return Charts(face[keep], new_index[chart[keep]], flat[keep], size[small])


def pack(size: I64, side: int, gutter: int) -> tuple[I64, I64, list[tuple[int, int]]]:
    """Pack rectangles onto pages by shelf packing, in order of decreasing height.

    Args:
        size: (C, 2) width and height.
        side: largest side of a page.
        gutter: margin around each rectangle.

    Returns:
        Position (C, 2) of their lower corner, page (C,), and (width, height) of every page.
    """
    position, page = np.zeros((len(size), 2), np.int64), np.zeros(len(size), np.int64)
    pages: list[tuple[int, int]] = []
    x = y = shelf = 0
    width = min(side, int(np.ceil(np.sqrt(float(((size + 2 * gutter).prod(axis=1)).sum()) * 1.1)))) if len(size) else 0
    width = max(width, int(size[:, 0].max(initial=0)) + 2 * gutter)
    widest = 0
    for k in np.lexsort((size[:, 0], -size[:, 1])):
        w, h = int(size[k, 0]) + 2 * gutter, int(size[k, 1]) + 2 * gutter
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        if y + h > side:
            pages.append((widest, y))
            x = y = shelf = widest = 0
        position[k], page[k] = (x + gutter, y + gutter), len(pages)
        x, shelf, widest = x + w, max(shelf, h), max(widest, x + w)
    if len(size):
        pages.append((widest, y + shelf))
    return position, page, pages


def overlapping(flat: F32, page: I64, pages: list[tuple[int, int]]) -> Bools:
    """(N,) faces that own too few of their texels because others overlap them; `flat` (N, 3, 2) texels of the page."""
    from scan2sim.texturing.texel_map import owners

    area = np.abs(_signed_area(flat))
    covered = np.zeros(len(flat), bool)
    for k, (width, height) in enumerate(pages):
        on = np.flatnonzero(page == k)
        owner = owners(flat[on], width, height)
        texels = np.bincount(owner[owner >= 0], minlength=len(on))
        covered[on] = texels < VISIBLE_TEXELS_MIN * area[on] - 3 - np.sqrt(area[on])
    return covered


def _components(mesh: Mesh, view: I32, cell: float) -> I64:
    """(F,) connected component of each face: same view, same cell of a grid (metres); -1 without a view."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    from scan2sim.texturing.view_selection.mrf import adjacent

    pairs, _ = adjacent(mesh.faces)
    cells = np.floor(mesh.corners.mean(axis=1) / cell).astype(np.int64)
    same = (view[pairs[:, 0]] == view[pairs[:, 1]]) & (cells[pairs[:, 0]] == cells[pairs[:, 1]]).all(axis=1)
    p = pairs[same & (view[pairs[:, 0]] >= 0)]
    links = coo_array((np.ones(len(p), np.int8), (p[:, 0], p[:, 1])), shape=(len(mesh), len(mesh)))
    _, part = connected_components(links, directed=False)
    out = np.full(len(mesh), -1, np.int64)
    seen = view >= 0
    out[seen] = np.unique(part[seen], return_inverse=True)[1]
    return out


def _signed_area(flat: npt.NDArray[np.floating]) -> F64:
    """(N,) signed area of triangles (N, 3, 2); positive if counter-clockwise."""
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return np.asarray((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2, np.float64)


def _unit(v: F64) -> F64:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))


def _axes(normal: F64) -> tuple[F64, F64]:
    """Two unit vectors (C, 3) perpendicular to every normal (C, 3), forming a right-handed frame with it."""
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = _unit(np.cross(helper, normal))
    return across, np.cross(normal, across)


def _aligned(flat: F64, chart: I64, count: int) -> F64:
    """Charts rotated so that their longest extent lies along x."""
    points = np.nan_to_num(flat.mean(axis=1))
    n = np.maximum(np.bincount(chart, minlength=count), 1)
    mean = np.stack([np.bincount(chart, points[:, k], count) / n for k in range(2)], axis=1)
    d = points - mean[chart]
    xx, yy, xy = (np.bincount(chart, v, count) for v in (d[:, 0] ** 2, d[:, 1] ** 2, d[:, 0] * d[:, 1]))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    c, s = np.cos(angle)[chart][:, None], np.sin(angle)[chart][:, None]
    return np.stack([c * flat[..., 0] + s * flat[..., 1], c * flat[..., 1] - s * flat[..., 0]], axis=-1)
