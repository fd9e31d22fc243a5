"""Reference implementation of `blend_numba.accumulate` in plain NumPy, for all texels at once."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from scan2sim.pipeline.camera.models import ORTHO_EQUIVALENT_FOCAL_PX, inside, project_exactly
from scan2sim.pipeline.camera.projection import MAX_SLOPE, SLOPE_BIAS_FACTOR
from scan2sim.pipeline.core.types import F32, F64, Camera
from scan2sim.texturing.bake import blend_numba
from scan2sim.texturing.bake.blend_numba import OVEREXPOSED_LEVEL, UNRELIABLE_WEIGHT
from scan2sim.texturing.exposure_model import OVEREXPOSED_POWER
from scan2sim.texturing.photo_cache import SRGB_GAMMA, SRGB_OFFSET


def accumulate(
    sums: blend_numba.Sums,
    page_faces: blend_numba.PageFaces,
    faces: npt.NDArray[np.int64],
    share: F32,
    source: blend_numba.BlendSource,
    settings: blend_numba.BlendSettings,
    camera: Camera,
) -> npt.NDArray[np.int64]:
    """Add a photo to `sums` for `faces`; returns (N, 2) row and column of the texels that it sees.

    Args:
        sums, page_faces, faces, share, source, settings: as for `blend_numba.accumulate` and `RowBlender.add`.
        camera: camera of the photo.
    """
    photo, occlusion = source.photo, source.occlusion
    row, column = np.nonzero(np.isin(page_faces.owner, faces))
    face = page_faces.owner[row, column]
    share = share[np.argsort(faces)[np.searchsorted(np.sort(faces), face)]]

    # positions of the texels in camera axes
    part = barycentric(page_faces.flat[face].astype(float), column, row)
    to_camera = source.camera.T
    point = np.einsum("nc,nck->nk", part, page_faces.corners[face]) @ to_camera[:3, :3].T + to_camera[:3, 3]
    normal = page_faces.normals[face] @ to_camera[:3, :3].T
    uv, ok = project_exactly(camera, point)

    # distance, cosine of the incidence, and width in pixels
    focal = camera.width / (2 * np.pi) if camera.model == "equirectangular" else min(camera.fx, camera.fy)
    if camera.model == "orthographic":
        distance, cos = point[:, 2], -normal[:, 2]
        equivalent_distance, pixels_per_metre = np.full(len(point), ORTHO_EQUIVALENT_FOCAL_PX / focal), focal
    else:
        distance = equivalent_distance = np.linalg.norm(point, axis=1)
        cos, pixels_per_metre = -np.einsum("nk,nk->n", point, normal) / distance, focal / distance
    width = texel_size(page_faces.flat.astype(float), page_faces.corners.astype(float))[face] * pixels_per_metre

    # visibility
    slope = np.minimum(np.tan(np.arccos(np.clip(np.abs(cos), 1e-6, 1))), MAX_SLOPE)
    lean = slope * occlusion.pixel * (1 if camera.model == "orthographic" else distance)
    ok &= inside(camera, uv) & (cos >= 0.5 * settings.min_cos)
    if photo.mask.size:
        ok &= nearest(photo.mask, uv, camera) > 0
    ok &= distance <= nearest(occlusion.first, uv, camera) + settings.bias + SLOPE_BIAS_FACTOR * lean
    row, column, part, share, uv = row[ok], column[ok], part[ok], share[ok], uv[ok]
    distance, cos, width, lean = (a[ok] for a in (distance, cos, width, lean))
    equivalent_distance = equivalent_distance[ok]

    # colours
    at = uv
    if photo.warp.size:
        at = uv + bilinear(photo.warp, uv, camera)
    selected = share.sum(axis=1) > 0
    rgb = np.where((width < 3.2)[:, None], bilinear(photo.half, at, camera), bilinear(photo.quarter, at, camera))
    sharp = selected | (settings.band < 0)
    finest = np.where(sharp[:, None], bicubic(photo.full, at, camera), bilinear(photo.full, at, camera))
    rgb = np.where((width < 1.6)[:, None], finest, rgb)

    # weights
    border = np.stack([uv[:, 1] + 0.5, camera.height - 0.5 - uv[:, 1], uv[:, 0] + 0.5, camera.width - 0.5 - uv[:, 0]])
    border_distance = np.min(border[:2] if camera.model == "equirectangular" else border, axis=0)
    feather = 0.02 + 0.98 * np.minimum(1, border_distance / settings.feather)
    weight = (cos / equivalent_distance) ** (2 * settings.power) * feather
    overexposed = min(1.0, float(np.exp(OVEREXPOSED_POWER * SRGB_GAMMA * photo.exposure[:3].mean())))
    weight = np.where(rgb.max(axis=1) > OVEREXPOSED_LEVEL, overexposed, 1) * weight
    beside_edge = distance > nearest(occlusion.around, uv, camera) + settings.bias + (occlusion.radius + 0.5) * lean
    low = np.where(beside_edge, UNRELIABLE_WEIGHT, 1) * weight
    beside_edge = distance > nearest(occlusion.near, uv, camera) + settings.bias + 1.5 * lean
    own_share = np.maximum(0, np.einsum("nc,nc->n", part, share))
    detail = np.where(beside_edge, UNRELIABLE_WEIGHT, 1) * (1e-4 * weight + own_share)

    # correct the exposure; add low frequencies and detail to their sums
    middle = (np.array([camera.width, camera.height]) - 1) / 2
    q = ((uv - middle) ** 2).sum(axis=1) / (middle**2).sum()
    light = np.exp(photo.exposure[:3] + (photo.exposure[3] * q + photo.exposure[4] * q**2)[:, None])
    coarse = {-1: rgb, 0: rgb}.get(settings.band, bilinear(photo.low, at, camera))
    base = (coarse + SRGB_OFFSET) * light - SRGB_OFFSET if settings.band else np.zeros_like(rgb)
    fine = (rgb + SRGB_OFFSET) * light - SRGB_OFFSET - base
    sums.low[row, column] += low[:, None] * np.column_stack([base, np.ones(len(base))])
    sums.detail[row, column] += detail[:, None] * np.column_stack([fine, np.ones(len(fine))])
    return np.column_stack([row, column])


def barycentric(flat: F64, x: npt.NDArray[Any], y: npt.NDArray[Any]) -> F64:
    """(N, 3) barycentric coordinates of (x, y) in triangles (N, 3, 2)."""
    edges = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=2)
    st = np.linalg.solve(edges, (np.column_stack([x, y]) - flat[:, 0])[..., None])[..., 0]
    return np.column_stack([1 - st.sum(axis=1), st])


def texel_size(flat: F64, corners: F64) -> F64:
    """(F,) texel size in metres: the larger of width and height."""
    edges = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=2)
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    return np.linalg.norm(sides @ np.linalg.inv(edges), axis=1).max(axis=1)


def rescaled(image: npt.NDArray[Any], uv: F64, camera: Camera) -> F64:
    """(N, 2) positions in an image of any size that covers the photo, for pixels of the photo."""
    size = np.array([camera.width, camera.height])
    return (uv + 0.5) * (image.shape[1::-1] / size) - 0.5


def nearest(image: npt.NDArray[Any], uv: F64, camera: Camera) -> npt.NDArray[Any]:
    """(N,) values of the image's pixels nearest to the photo's pixels."""
    column, row = np.floor(rescaled(image, uv, camera) + 0.5).astype(int).T
    return image[row.clip(0, image.shape[0] - 1), column.clip(0, image.shape[1] - 1)]


def bilinear(image: npt.NDArray[Any], uv: F64, camera: Camera) -> F64:
    """(N, C) bilinear samples of an image of any size at the photo's pixels."""
    x, y = rescaled(image, uv, camera).T
    around: Literal["wrap", "edge"] = "wrap" if camera.model == "equirectangular" else "edge"
    wider = np.pad(image.astype(float), ((0, 0), (2, 2), (0, 0)), around)
    channels = [map_coordinates(c, [y, x + 2], order=1, mode="nearest") for c in np.moveaxis(wider, 2, 0)]
    return np.stack(channels, axis=1)


def bicubic(image: npt.NDArray[Any], uv: F64, camera: Camera) -> F64:
    """(N, C) bicubic samples, by Keys' kernel with a = -1/2."""

    def kernel(d: F64) -> F64:
        d = np.abs(d)
        return np.where(d < 1, 1.5 * d**3 - 2.5 * d**2 + 1, -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2)

    (height, width), pixel = image.shape[:2], np.floor(uv).astype(int)
    total = np.zeros((len(uv), image.shape[2]))
    for column in (pixel[:, 0] + i for i in range(-1, 3)):
        for row in (pixel[:, 1] + j for j in range(-1, 3)):
            weight = kernel(uv[:, 0] - column) * kernel(uv[:, 1] - row)
            there = column % width if camera.model == "equirectangular" else column.clip(0, width - 1)
            total = total + weight[:, None] * image[row.clip(0, height - 1), there]
    return total
