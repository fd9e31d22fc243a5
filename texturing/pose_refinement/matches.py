"""Correspondences between photos on a known surface: corners of one photo, matched in its neighbours.

The depth map gives the surface point at a corner of a photo, and the plane of the surface around it. The plane predicts
where another photo should show the corner, and how the patch around it is warped; the offset at which the corner is
found is the error of the poses (and of the surface). Patches are aligned from coarse to fine after normalising mean
and contrast (Lucas and Kanade 1981; Baker and Matthews 2004). Import late: loads numba.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.camera.depth_map import DepthMap, visible
from scan2sim.pipeline.camera.image_sampling import mixed, taps
from scan2sim.pipeline.camera.models import pixel_rays, project_point, unproject, unproject_pixel
from scan2sim.pipeline.camera.projection import PosedCamera, posed_camera, to_camera
from scan2sim.pipeline.core.types import F32, F64, I64, U8, Bools, Camera, View

PATCH_RADIUS_PX = 5
"""Patches extend this many pixels to each side of their corner, on every pyramid level."""
PLANE_RADIUS_PX = 3
"""Radius in pixels of the depth map within which the surface must be flat."""
MAX_ITERATIONS = 12
MIN_CORRELATION = 0.85
"""Normalised correlation (ZNCC) above which two patches match."""
SEARCH_RADIUS_PX = 24.0
"""Distance in pixels from the prediction within which a corner is searched."""
PATCH_AREA_RATIO = (0.4, 2.5)
"""Range of the ratio of a patch's areas in two photos."""
PLANE_TOLERANCE = (0.03, 0.006)
"""Distance in metres, plus share of the range, that the surface may depart from its plane: noise of a voxel."""
PLANE_MIN_COS = 0.08
"""Cosine between plane normal and ray below which the plane is too uncertain."""
CORNER_QUALITY = 0.003
"""Strength of a corner relative to the photo's strongest (`qualityLevel` of OpenCV)."""
VISIBILITY_BIAS_M = 0.3
"""Metres that a point may lie behind another photo's depth map: large, as depth edges are wide."""


@dataclass(frozen=True)
class GreyPhoto:
    """A photo to be matched: grey image pyramid at the compared size.

    Attributes:
        camera: camera of the photo, scaled to the compared size.
        levels: (h, w) uint8 each: full, half and quarter resolution.
        usable: (h, w) where the photo may be used.
    """

    camera: Camera
    levels: tuple[U8, U8, U8]
    usable: Bools


@dataclass(frozen=True)
class Matches:
    """Points on the surface and their observations in photos; all pixels are of the compared size.

    Attributes:
        point: (P, 3) position of the corner in local metres, from the depth map of its first photo.
        normal: (P, 3) unit normal of the surface there.
        first: (P,) view in which the corner was detected.
        corner: (P, 2) pixel of the corner in that view.
        point_index: (N,) index of the observed point.
        view: (N,) view that observes it, other than the first.
        uv: (N, 2) pixel in that view.
    """

    point: F64
    normal: F64
    first: I64
    corner: F64
    point_index: I64
    view: I64
    uv: F64


def grey_photo(rgb: U8, mask: U8, camera: Camera) -> GreyPhoto:
    """A photo (H, W, 3) and its mask (0 where it must not be used; (0, 0): no mask), resized to the camera's size."""
    import cv2

    size = (camera.width, camera.height)
    grey = np.asarray(cv2.cvtColor(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY), np.uint8)
    half = np.asarray(cv2.pyrDown(grey), np.uint8)
    usable = np.ones(grey.shape, bool)
    if mask.size:
        usable = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)) > 0
    return GreyPhoto(camera, (grey, half, np.asarray(cv2.pyrDown(half), np.uint8)), usable)


def matches(
    views: Sequence[View],
    photos: Mapping[int, GreyPhoto],
    depth: Callable[[int], DepthMap],
    neighbours: Mapping[int, Sequence[int]],
    *,
    count: int,
    max_distance: float,
) -> Matches:
    """Match the corners of every photo in its neighbours.

    Args:
        views: posed photos.
        photos: grey photos of the views to be matched, by index.
        depth: function of a view's index that returns its depth map; half the photo's resolution is enough.
        neighbours: view to the views in which its corners are searched.
        count: maximum number of corners per photo.
        max_distance: metres from the camera beyond which surface points are not used.
    """
    point, normal, first, corner = [], [], [], []
    point_index, seen_by, uv = [], [], []
    total = 0
    for i, others in neighbours.items():
        own, T = photos[i], views[i].T_world_cam
        at, p, n = _corners(own, depth(i), count, max_distance)
        world, world_normal = p @ T[:3, :3].T + T[:3, 3], n @ T[:3, :3].T
        for j in others:
            other = photos[j]
            seen = np.flatnonzero(visible(depth(j), world, world_normal, bias=VISIBILITY_BIAS_M))
            found, ok = _find(
                _with_channel(own.levels), _with_channel(other.levels), other.usable, at[seen], p[seen], n[seen],
                posed_camera(own.camera, T), posed_camera(other.camera, views[j].T_world_cam, T),
            )  # fmt: skip
            point_index.append(total + seen[ok])
            seen_by.append(np.full(int(ok.sum()), j))
            uv.append(found[ok])
        point.append(world)
        normal.append(world_normal)
        first.append(np.full(len(at), i))
        corner.append(at)
        total += len(at)

    def joined(parts: list[F64], width: int) -> F64:
        return np.concatenate(parts) if parts else np.zeros((0, width))

    def numbers(parts: list[I64]) -> I64:
        return np.concatenate(parts).astype(np.int64) if parts else np.zeros(0, np.int64)

    return Matches(
        joined(point, 3), joined(normal, 3), numbers(first), joined(corner, 2), numbers(point_index),
        numbers(seen_by), joined(uv, 2),
    )  # fmt: skip


def _with_channel(levels: tuple[U8, ...]) -> tuple[U8, ...]:
    """Images (h, w) as (h, w, 1), as `pipeline.camera.image_sampling` takes them."""
    return tuple(level[..., None] for level in levels)


def _corners(photo: GreyPhoto, depth: DepthMap, count: int, max_distance: float) -> tuple[F64, F64, F64]:
    """Corners where the surface is flat: pixels (N, 2), and points (N, 3) and normals (N, 3) in camera axes."""
    import cv2

    rays = pixel_rays(depth.camera)
    points = rays * np.where(depth.range < max_distance, depth.range, np.nan)[..., None].astype(np.float32)
    plane = _planes(points)
    flat = np.isfinite(plane[..., 0])
    flat = cv2.erode(flat.astype(np.uint8), np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    height, width = photo.usable.shape
    rows, columns = (
        ((np.arange(size) + 0.5) * coarse / size).astype(int)
        for size, coarse in zip((height, width), flat.shape, strict=True)
    )
    usable = flat[np.ix_(rows, columns)] & photo.usable
    min_distance = max(4.0, 0.6 * math.sqrt(max(1, int(usable.sum())) / count))
    mask = usable.astype(np.uint8)
    detected = cv2.goodFeaturesToTrack(photo.levels[0], count, CORNER_QUALITY, min_distance, mask=mask, blockSize=7)
    if detected is None:
        return np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3))
    at = np.round(np.asarray(detected, np.float64).reshape(-1, 2)).astype(int)
    depth_pixel = rows[at[:, 1]], columns[at[:, 0]]
    normal, on = plane[depth_pixel].astype(np.float64), points[depth_pixel].astype(np.float64)
    ray = unproject(photo.camera, at)
    far = np.einsum("ij,ij->i", on, normal) / np.einsum("ij,ij->i", ray, normal)
    return at.astype(np.float64), ray * far[:, None], normal


@njit(cache=True, parallel=True)
def _planes(points: F32) -> F32:
    """(H, W, 3) unit normals, towards the camera, of the plane around each point; NaN where the surface is not flat."""
    height, width = points.shape[:2]
    out = np.full((height, width, 3), np.nan, np.float32)
    for v in prange(PLANE_RADIUS_PX, height - PLANE_RADIUS_PX):
        a, b, n = np.zeros(3), np.zeros(3), np.zeros(3)
        for u in range(PLANE_RADIUS_PX, width - PLANE_RADIUS_PX):
            p = points[v, u]
            r = math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
            if not r > 0.1:
                continue
            for k in range(3):
                a[k] = points[v, u + PLANE_RADIUS_PX, k] - points[v, u - PLANE_RADIUS_PX, k]
                b[k] = points[v + PLANE_RADIUS_PX, u, k] - points[v - PLANE_RADIUS_PX, u, k]
            n[0], n[1], n[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            size = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            if not size > 1e-12:
                continue
            along = (n[0] * p[0] + n[1] * p[1] + n[2] * p[2]) / size
            if abs(along) < PLANE_MIN_COS * r:
                continue
            size = -size if along > 0 else size
            limit = PLANE_TOLERANCE[0] + PLANE_TOLERANCE[1] * r
            flat = True
            for dv in range(-PLANE_RADIUS_PX, PLANE_RADIUS_PX + 1, PLANE_RADIUS_PX):
                for du in range(-PLANE_RADIUS_PX, PLANE_RADIUS_PX + 1, PLANE_RADIUS_PX):
                    q = points[v + dv, u + du]
                    off = n[0] * (q[0] - p[0]) + n[1] * (q[1] - p[1]) + n[2] * (q[2] - p[2])
                    flat &= abs(off) < limit * abs(size)  # NaN is not flat
            if flat:
                for k in range(3):
                    out[v, u, k] = n[k] / size
    return out


@njit(cache=True, parallel=True)
def _find(
    a: Sequence[U8],
    b: Sequence[U8],
    usable: Bools,
    corner: F64,
    point: F64,
    normal: F64,
    camera_a: PosedCamera,
    camera_b: PosedCamera,
) -> tuple[F64, Bools]:
    """Pixels (N, 2) of the first photo's corners in the second photo, and whether each was found (N,).

    Args:
        a, b: image pyramids of both photos.
        usable: where the second photo may be used.
        corner: (N, 2) pixels in the first photo.
        point, normal: (N, 3) points and normals in the first camera's axes.
        camera_a, camera_b: both cameras; the second takes points in the first camera's axes.
    """
    found = np.zeros((len(corner), 2))
    good = np.zeros(len(corner), np.bool_)
    for i in prange(len(corner)):
        u, v = corner[i, 0], corner[i, 1]
        x0, y0, ok = _through_plane(camera_a, u, v, point[i], normal[i], camera_b)
        ax, ay, ok1 = _through_plane(camera_a, u + 2, v, point[i], normal[i], camera_b)
        bx, by, ok2 = _through_plane(camera_a, u - 2, v, point[i], normal[i], camera_b)
        cx, cy, ok3 = _through_plane(camera_a, u, v + 2, point[i], normal[i], camera_b)
        dx, dy, ok4 = _through_plane(camera_a, u, v - 2, point[i], normal[i], camera_b)
        if not (ok and ok1 and ok2 and ok3 and ok4):
            continue
        A = np.array([[(ax - bx) / 4, (cx - dx) / 4], [(ay - by) / 4, (cy - dy) / 4]])
        area = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
        if not PATCH_AREA_RATIO[0] < area < PATCH_AREA_RATIO[1]:  # also rejects the seam of equirectangular photos
            continue
        shift = np.zeros(2)  # pixels of the first photo
        ok = _align(a[2], b[2], 4.0, u, v, x0, y0, A, shift) >= 0
        ok = ok and _align(a[1], b[1], 2.0, u, v, x0, y0, A, shift) >= 0
        if not ok or _align(a[0], b[0], 1.0, u, v, x0, y0, A, shift) < MIN_CORRELATION:
            continue
        x = x0 + A[0, 0] * shift[0] + A[0, 1] * shift[1]
        y = y0 + A[1, 0] * shift[0] + A[1, 1] * shift[1]
        if (x - x0) ** 2 + (y - y0) ** 2 > SEARCH_RADIUS_PX**2 or not usable[int(y + 0.5), int(x + 0.5)]:
            continue
        found[i, 0], found[i, 1], good[i] = x, y, True
    return found, good


@njit(cache=True)
def _through_plane(
    camera_a: PosedCamera, u: float, v: float, point: F64, normal: F64, camera_b: PosedCamera
) -> tuple[float, float, bool]:
    """(u, v, ok): transfers a pixel of the first camera to the second via a plane, given in the first's axes."""
    x, y, z = unproject_pixel(camera_a.model, camera_a.p, u, v)
    along = x * normal[0] + y * normal[1] + z * normal[2]
    t = (point[0] * normal[0] + point[1] * normal[1] + point[2] * normal[2]) / along if along < -1e-4 else -1.0
    if not t > 0:
        return 0.0, 0.0, False
    x, y, z = to_camera(camera_b.T, x * t, y * t, z * t)
    return project_point(camera_b.model, camera_b.p, x, y, z)


@njit(cache=True)
def _align(a: U8, b: U8, size: float, u: float, v: float, x0: float, y0: float, A: F64, shift: F64) -> float:
    """Refine `shift` (2,), in place, on one pyramid level; returns the patches' correlation, -1 if it fails.

    Args:
        a, b: (h, w, 1) uint8 images of this level, whose pixels are `size` pixels of the finest level.
        u, v: corner in the first photo.
        x0, y0: predicted position in the second photo.
        A: (2, 2) affine warp from the first to the second photo.
        shift: offset from the prediction, pixels of the first photo.
    """
    n = 2 * PATCH_RADIUS_PX + 1
    uc, vc = (u + 0.5) / size - 0.5, (v + 0.5) / size - 0.5
    if (
        uc < PATCH_RADIUS_PX + 1
        or vc < PATCH_RADIUS_PX + 1
        or uc >= a.shape[1] - PATCH_RADIUS_PX - 2
        or vc >= a.shape[0] - PATCH_RADIUS_PX - 2
    ):
        return -1.0
    reference, gu, gv, current = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    mean = 0.0
    for r in range(n):
        for c in range(n):
            x, y = uc + c - PATCH_RADIUS_PX, vc + r - PATCH_RADIUS_PX
            reference[r, c] = _at(a, x, y)
            gu[r, c] = 0.5 * (_at(a, x + 1, y) - _at(a, x - 1, y))
            gv[r, c] = 0.5 * (_at(a, x, y + 1) - _at(a, x, y - 1))
            mean += reference[r, c]
    mean /= n * n
    variance = huu = huv = hvv = 0.0
    mu, mv = gu.mean(), gv.mean()
    for r in range(n):
        for c in range(n):
            reference[r, c] -= mean
            gu[r, c] -= mu
            gv[r, c] -= mv
            variance += reference[r, c] ** 2
            huu += gu[r, c] ** 2
            huv += gu[r, c] * gv[r, c]
            hvv += gv[r, c] ** 2
    det = huu * hvv - huv * huv
    # less than two grey levels of contrast, or an edge instead of a corner (aperture problem)
    if variance < 4.0 * n * n or det < 1e-3 * (huu + hvv) ** 2:
        return 1.0 if size > 1 else -1.0  # finer levels may have more structure
    correlation = -1.0
    du, dv = shift[0] / size, shift[1] / size
    for _ in range(MAX_ITERATIONS):
        x = (x0 + (A[0, 0] * du + A[0, 1] * dv) * size + 0.5) / size - 0.5
        y = (y0 + (A[1, 0] * du + A[1, 1] * dv) * size + 0.5) / size - 0.5
        wide = PATCH_RADIUS_PX * (abs(A[0, 0]) + abs(A[0, 1])) + 1
        high = PATCH_RADIUS_PX * (abs(A[1, 0]) + abs(A[1, 1])) + 1
        if not (x >= wide and y >= high and x < b.shape[1] - wide - 1 and y < b.shape[0] - high - 1):
            return -1.0
        total = 0.0
        for r in range(n):
            for c in range(n):
                s, t = c - PATCH_RADIUS_PX, r - PATCH_RADIUS_PX
                current[r, c] = _at(b, x + A[0, 0] * s + A[0, 1] * t, y + A[1, 0] * s + A[1, 1] * t)
                total += current[r, c]
        total /= n * n
        current_variance = cross = 0.0
        for r in range(n):
            for c in range(n):
                current[r, c] -= total
                current_variance += current[r, c] ** 2
                cross += current[r, c] * reference[r, c]
        if current_variance < 1e-6:
            return -1.0
        correlation = cross / math.sqrt(current_variance * variance)
        gain = math.sqrt(variance / current_variance)
        eu = ev = 0.0
        for r in range(n):
            for c in range(n):
                e = reference[r, c] - gain * current[r, c]
                eu += gu[r, c] * e
                ev += gv[r, c] * e
        su, sv = (hvv * eu - huv * ev) / det, (huu * ev - huv * eu) / det
        long = math.sqrt(su * su + sv * sv)
        if long > 2:  # beyond the range of the linearisation
            su, sv = 2 * su / long, 2 * sv / long
        du, dv = du + su, dv + sv
        if long < 0.01:
            break
    shift[0], shift[1] = du * size, dv * size
    return correlation if size == 1 or correlation > 0.5 else -1.0


@njit(cache=True, inline="always")
def _at(image: npt.NDArray[Any], x: float, y: float) -> float:
    """Bilinear grey level of an image (H, W, 1) at a pixel."""
    return mixed(image, 0, taps(image, x, y, False))
