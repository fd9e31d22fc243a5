"""`blend.accumulate` without haste: what a photo says of a page's texels, in plain NumPy, all texels at once."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from scan2sim.pipeline.camera.models import ALIKE, inside, project_exactly
from scan2sim.pipeline.camera.projection import MAX_SLOPE, SLOPE_SHARE
from scan2sim.pipeline.core.types import F32, F64, Camera
from scan2sim.texturing.bake import blend_numba
from scan2sim.texturing.bake.blend_numba import EDGE, WHITE
from scan2sim.texturing.photo_cache import OFFSET


def accumulate(
    sums: blend_numba.Sums,
    laid: blend_numba.Laid,
    faces: npt.NDArray[np.int64],
    share: F32,
    source: blend_numba.Source,
    weighing: blend_numba.Weighing,
    camera: Camera,
) -> npt.NDArray[np.int64]:
    """Add what a photo says of `faces` to `sums`; returns the (N, 2) row and column of the texels that it sees.

    Args:
        sums, laid, faces, share, source, weighing: of `blend.accumulate` and `blend.Rows.add`.
        camera: the photo's.
    """
    picture, occlusion = source.picture, source.occlusion
    row, column = np.nonzero(np.isin(laid.owner, faces))
    face = laid.owner[row, column]
    share = share[np.argsort(faces)[np.searchsorted(np.sort(faces), face)]]

    # where the texels are, in the camera's axes
    part = barycentric(laid.flat[face].astype(float), column, row)
    place = np.einsum("nc,nck->nk", part, laid.corners[face]) @ source.eye.T[:3, :3].T + source.eye.T[:3, 3]
    normal = laid.normals[face] @ source.eye.T[:3, :3].T
    uv, ok = project_exactly(camera, place)

    # how they are seen: from what distance, how squarely, and how many pixels wide
    focal = camera.width / (2 * np.pi) if camera.model == "equirectangular" else min(camera.fx, camera.fy)
    if camera.model == "orthographic":
        distance, cos = place[:, 2], -normal[:, 2]
        away, metre = np.full(len(place), ALIKE / focal), focal
    else:
        distance = away = np.linalg.norm(place, axis=1)
        cos, metre = -np.einsum("nk,nk->n", place, normal) / distance, focal / distance
    wide = texel_size(laid.flat.astype(float), laid.corners.astype(float))[face] * metre

    # which of them it sees
    slope = np.minimum(np.tan(np.arccos(np.clip(np.abs(cos), 1e-6, 1))), MAX_SLOPE)
    lean = slope * occlusion.pixel * (1 if camera.model == "orthographic" else distance)
    ok &= inside(camera, uv) & (cos >= 0.5 * weighing.min_cos)
    if picture.mask.size:
        ok &= nearest(picture.mask, uv, camera) > 0
    ok &= distance <= nearest(occlusion.first, uv, camera) + weighing.bias + SLOPE_SHARE * lean
    row, column, part, share, uv = row[ok], column[ok], part[ok], share[ok], uv[ok]
    distance, away, cos, wide, lean = (a[ok] for a in (distance, away, cos, wide, lean))

    # what it shows there
    at = uv
    if picture.warp.size:
        at = uv + bilinear(picture.warp, uv, camera)
    chosen = share.sum(axis=1) > 0
    rgb = np.where((wide < 3.2)[:, None], bilinear(picture.half, at, camera), bilinear(picture.quarter, at, camera))
    sharp = chosen | (weighing.band < 0)
    finest = np.where(sharp[:, None], bicubic(picture.whole, at, camera), bilinear(picture.whole, at, camera))
    rgb = np.where((wide < 1.6)[:, None], finest, rgb)

    # how much that counts
    border = np.stack([uv[:, 1] + 0.5, camera.height - 0.5 - uv[:, 1], uv[:, 0] + 0.5, camera.width - 0.5 - uv[:, 0]])
    inwards = np.min(border[:2] if camera.model == "equirectangular" else border, axis=0)
    worth = (cos / away) ** (2 * weighing.power) * (0.02 + 0.98 * np.minimum(1, inwards / weighing.feather))
    worth = np.where(rgb.max(axis=1) > WHITE, EDGE, 1) * worth
    beside = distance > nearest(occlusion.apart, uv, camera) + weighing.bias + (occlusion.reach + 0.5) * lean
    low = np.where(beside, EDGE, 1) * worth
    beside = distance > nearest(occlusion.near, uv, camera) + weighing.bias + 1.5 * lean
    detail = np.where(beside, EDGE, 1) * (1e-4 * worth + np.maximum(0, np.einsum("nc,nc->n", part, share)))

    # exposure undone; low frequencies and what is finer, each to its sum
    middle = (np.array([camera.width, camera.height]) - 1) / 2
    q = ((uv - middle) ** 2).sum(axis=1) / (middle**2).sum()
    light = np.exp(picture.exposure[:3] + (picture.exposure[3] * q + picture.exposure[4] * q**2)[:, None])
    coarse = {-1: rgb, 0: rgb}.get(weighing.band, bilinear(picture.low, at, camera))
    base = (coarse + OFFSET) * light - OFFSET if weighing.band else np.zeros_like(rgb)
    fine = (rgb + OFFSET) * light - OFFSET - base
    sums.low[row, column] += low[:, None] * np.column_stack([base, np.ones(len(base))])
    sums.detail[row, column] += detail[:, None] * np.column_stack([fine, np.ones(len(fine))])
    return np.column_stack([row, column])


def barycentric(flat: F64, x: npt.NDArray[Any], y: npt.NDArray[Any]) -> F64:
    """(N, 3) weights of a triangle's corners (N, 3, 2) at (x, y)."""
    edges = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=2)
    st = np.linalg.solve(edges, (np.column_stack([x, y]) - flat[:, 0])[..., None])[..., 0]
    return np.column_stack([1 - st.sum(axis=1), st])


def texel_size(flat: F64, corners: F64) -> F64:
    """(F,) metres that a texel spans, across or down, whichever is more."""
    edges = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=2)
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    return np.linalg.norm(sides @ np.linalg.inv(edges), axis=1).max(axis=1)


def rescaled(picture: npt.NDArray[Any], uv: F64, camera: Camera) -> F64:
    """(N, 2) where in a picture of any size is what a photo's pixels show."""
    size = np.array([camera.width, camera.height])
    return (uv + 0.5) * (picture.shape[1::-1] / size) - 0.5


def nearest(picture: npt.NDArray[Any], uv: F64, camera: Camera) -> npt.NDArray[Any]:
    """(N,) what the picture's pixels hold that places of the photo are in."""
    column, row = np.floor(rescaled(picture, uv, camera) + 0.5).astype(int).T
    return picture[row.clip(0, picture.shape[0] - 1), column.clip(0, picture.shape[1] - 1)]


def bilinear(picture: npt.NDArray[Any], uv: F64, camera: Camera) -> F64:
    """(N, C)."""
    x, y = rescaled(picture, uv, camera).T
    around: Literal["wrap", "edge"] = "wrap" if camera.model == "equirectangular" else "edge"
    wider = np.pad(picture.astype(float), ((0, 0), (2, 2), (0, 0)), around)
    channels = [map_coordinates(c, [y, x + 2], order=1, mode="nearest") for c in np.moveaxis(wider, 2, 0)]
    return np.stack(channels, axis=1)


def bicubic(picture: npt.NDArray[Any], uv: F64, camera: Camera) -> F64:
    """(N, C) by Keys' kernel with a = -1/2."""

    def kernel(d: F64) -> F64:
        d = np.abs(d)
        return np.where(d < 1, 1.5 * d**3 - 2.5 * d**2 + 1, -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2)

    (height, width), whole = picture.shape[:2], np.floor(uv).astype(int)
    total = np.zeros((len(uv), picture.shape[2]))
    for column in (whole[:, 0] + i for i in range(-1, 3)):
        for row in (whole[:, 1] + j for j in range(-1, 3)):
            weight = kernel(uv[:, 0] - column) * kernel(uv[:, 1] - row)
            there = column % width if camera.model == "equirectangular" else column.clip(0, width - 1)
            total = total + weight[:, None] * picture[row.clip(0, height - 1), there]
    return total
