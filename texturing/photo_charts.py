"""Charts cut out of photos: faces that take their detail from one photo are laid flat as that photo sees them.

OpenMVS and mvs-texturing use the photo's own pixels; here every chart is projected on from the camera's centre to
the chart's own plane, so that texels are metric and alike in all directions, whatever the camera's model. What a
camera sees doesn't overlap itself, so nothing needs to be unfolded: a million faces take seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools, Mesh

TILT = 0.2
"""How far a chart's plane is turned from its faces' mean normal towards the camera."""
STRETCH = 4.0
"""Faces whose area changes by more than this factor are left to the unwrapper."""
COVERED = 0.6
"""Share of its texels that a face must keep where others lie over it."""

CELLS = 8
"""Charts are cut at a grid of this many cells along their largest side."""


@dataclass(frozen=True)
class Charts:
    """Faces laid flat.

    Attributes:
        face: (N,) indices of the faces.
        chart: (N,) which chart each belongs to, 0 to `count` - 1.
        flat: (N, 3, 2) float32 texels within the chart, from (0, 0).
        size: (C, 2) width and height of every chart, texels.
    """

    face: I64
    chart: I64
    flat: F32
    size: I64


def cut(mesh: Mesh, view: I32, centres: F64, texel: float, largest: int) -> Charts:
    """Charts of connected faces of one view; faces that can't be laid so are left out.

    Args:
        mesh: to be cut.
        view: (F,) view of every face, -1 for none.
        centres: (V, 3) camera centres, local metres.
        texel: metres a texel spans.
        largest: side of a chart, texels, that it must not exceed.
    """
    part = _components(mesh, view, largest * texel / CELLS)
    face = np.flatnonzero(part >= 0)
    chart = part[face]
    corners = mesh.corners[face].astype(np.float64)
    eye = centres[view[face]]
    normal, area = mesh.face_normal[face].astype(np.float64), mesh.face_area[face].astype(np.float64)
    count = int(chart.max()) + 1 if len(chart) else 0

    def mean(values: F64) -> F64:
        """Of every chart, weighted by area."""
        total = np.stack([np.bincount(chart, values[:, k] * area, count) for k in range(values.shape[1])], axis=1)
        return total / np.maximum(np.bincount(chart, area, count), 1e-12)[:, None]

    middle = corners.mean(axis=1)
    towards = _unit(eye - middle)
    plane = _unit((1 - TILT) * _unit(mean(normal)) + TILT * _unit(mean(towards)))
    at = mean(middle)
    # each corner along its ray from the eye to the chart's plane
    ray = corners - eye[:, None]
    n, foot = plane[chart][:, None], at[chart][:, None]
    along = np.einsum("nkc,nkc->nk", ray, np.broadcast_to(n, ray.shape))
    reach = np.einsum("nkc,nkc->nk", foot - eye[:, None], n)
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = eye[:, None] + ray * (reach / along)[..., None] - foot
    across, up = _axes(plane)
    flat = np.stack([np.einsum("nkc,nc->nk", hit, across[chart]), np.einsum("nkc,nc->nk", hit, up[chart])], axis=-1)
    flat = _upright(flat, chart, count) / texel
    drawn = _signed_area(flat) * texel**2
    good = np.isfinite(flat).all(axis=(1, 2)) & (reach / np.where(along == 0, 1, along) > 0).all(axis=1)
    good &= (drawn > area / STRETCH**2) & (drawn < area * STRETCH**2)
    # as many texels a chart as its area asks for
    total, wanted = (np.bincount(chart, np.where(good, value, 0), count) for value in (drawn, area))
    scale = np.sqrt(wanted / np.maximum(total, 1e-12))[chart]
    flat, drawn = flat * scale[:, None, None], drawn * scale**2
    good &= (drawn > area / STRETCH) & (drawn < area * STRETCH)
    face, chart, flat = face[good], chart[good], flat[good]
    used, chart = np.unique(chart, return_inverse=True)
    low, high = np.full((len(used), 2), np.inf), np.full((len(used), 2), -np.inf)
    np.minimum.at(low, chart, flat.min(axis=1))
    np.maximum.at(high, chart, flat.max(axis=1))
    size = np.ceil(high - low).astype(np.int64) + 1
    small = (size <= largest).all(axis=1)
    keep = small[chart]
    renamed = np.cumsum(small) - 1
    flat = (flat - low[chart][:, None]).astype(np.float32)
    return Charts(face[keep], renamed[chart[keep]], flat[keep], size[small])


def pack(size: I64, side: int, gutter: int) -> tuple[I64, I64, list[tuple[int, int]]]:
    """Rectangles onto pages, on shelves of falling height.

    Args:
        size: (C, 2) width and height.
        side: of a page, at most.
        gutter: room around each.

    Returns:
        place (C, 2) of their lower corner, page (C,), and (width, height) of every page.
    """
    place, page = np.zeros((len(size), 2), np.int64), np.zeros(len(size), np.int64)
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
        place[k], page[k] = (x + gutter, y + gutter), len(pages)
        x, shelf, widest = x + w, max(shelf, h), max(widest, x + w)
    if len(size):
        pages.append((widest, y + shelf))
    return place, page, pages


def overlapping(flat: F32, page: I64, pages: list[tuple[int, int]]) -> Bools:
    """(N,) faces of which others cover too much; `flat` (N, 3, 2) texels of their page."""
    from scan2sim.texturing.bake.texel_map import owners

    area = np.abs(_signed_area(flat))
    covered = np.zeros(len(flat), bool)
    for k, (width, height) in enumerate(pages):
        on = np.flatnonzero(page == k)
        owner = owners(flat[on], width, height)
        texels = np.bincount(owner[owner >= 0], minlength=len(on))
        covered[on] = texels < COVERED * area[on] - 3 - np.sqrt(area[on])
    return covered


def _components(mesh: Mesh, view: I32, cell: float) -> I64:
    """(F,) connected faces of one view within one cell of a grid (metres); -1 without a view."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    from scan2sim.texturing.view_selection.mrf import adjacent

    pairs, _ = adjacent(mesh.faces)
    place = np.floor(mesh.corners.mean(axis=1) / cell).astype(np.int64)
    same = (view[pairs[:, 0]] == view[pairs[:, 1]]) & (place[pairs[:, 0]] == place[pairs[:, 1]]).all(axis=1)
    p = pairs[same & (view[pairs[:, 0]] >= 0)]
    links = coo_array((np.ones(len(p), np.int8), (p[:, 0], p[:, 1])), shape=(len(mesh), len(mesh)))
    _, part = connected_components(links, directed=False)
    out = np.full(len(mesh), -1, np.int64)
    seen = view >= 0
    out[seen] = np.unique(part[seen], return_inverse=True)[1]
    return out


def _signed_area(flat: npt.NDArray[np.floating]) -> F64:
    """(N,) of triangles (N, 3, 2); positive if they run counter-clockwise."""
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return np.asarray((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2, np.float64)


def _unit(v: F64) -> F64:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))


def _axes(normal: F64) -> tuple[F64, F64]:
    """Two unit vectors (C, 3) each, across every normal (C, 3), right-handed with it."""
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = _unit(np.cross(helper, normal))
    return across, np.cross(normal, across)


def _upright(flat: F64, chart: I64, count: int) -> F64:
    """Charts turned so that their longest extent lies along x."""
    points = np.nan_to_num(flat.mean(axis=1))
    n = np.maximum(np.bincount(chart, minlength=count), 1)
    mean = np.stack([np.bincount(chart, points[:, k], count) / n for k in range(2)], axis=1)
    d = points - mean[chart]
    xx, yy, xy = (np.bincount(chart, v, count) for v in (d[:, 0] ** 2, d[:, 1] ** 2, d[:, 0] * d[:, 1]))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    c, s = np.cos(angle)[chart][:, None], np.sin(angle)[chart][:, None]
    return np.stack([c * flat[..., 0] + s * flat[..., 1], c * flat[..., 1] - s * flat[..., 0]], axis=-1)
