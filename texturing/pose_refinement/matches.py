"""Where photos show the same place of the surface: corners of one, found again in those around it. Import late: numba.

A corner of a photo is a place on the surface that its depth map shows there, with the plane that the surface is
about it. The plane predicts where another photo should show the corner, and how its patch is deformed; how far from it
the corner is found is what poses (and the surface) are wrong by. Patches are compared with mean and contrast taken out,
coarse to fine (Lucas and Kanade 1981; Baker and Matthews 2004).
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
from scan2sim.pipeline.camera.projection import Eye, eye, to_camera
from scan2sim.pipeline.core.types import F32, F64, I64, U8, Bools, Camera, View

HALF = 5
"""Patches reach so many pixels to each side of their corner, on every level."""
WINDOW = 3
"""Pixels of the depth map, likewise, about which the surface must be flat."""
ITERATIONS = 12
ALIKE = 0.85
"""Correlation above which two patches show the same."""
FARTHEST = 24.0
"""Pixels within which a corner is looked for."""
SCALES = (0.4, 2.5)
"""Between these the area of a patch may change from photo to photo."""
FLAT = (0.03, 0.006)
"""Metres, and share of the range, that the surface about a corner may leave its plane by: a voxel's noise."""
GRAZING = 0.08
"""Cosine to the ray below which a plane isn't known well enough."""
QUALITY = 0.003
"""Strength of a corner against the photo's strongest."""
BEHIND = 0.3
"""Metres that a place may lie behind what another photo's depth map shows: edges are wide."""


@dataclass(frozen=True)
class Picture:
    """A photo to be compared: grey, at the compared size.

    Attributes:
        camera: the photo's, scaled.
        levels: (h, w) uint8: at this size, halved, and halved again.
        usable: (h, w), where the photo may be used.
    """

    camera: Camera
    levels: tuple[U8, U8, U8]
    usable: Bools


@dataclass(frozen=True)
class Matches:
    """Places, and the photos that show them.

    Attributes:
        place, normal: (P, 3) local metres and unit: where the first photo's depth map has the corner, and its plane.
        first: (P,) view in which the corner was chosen.
        corner: (P, 2) its pixel there.
        of: (N,) index of the place that an observation is of.
        view: (N,) view that shows it, not the first.
        uv: (N, 2) pixel there. All pixels are of the compared size.
    """

    place: F64
    normal: F64
    first: I64
    corner: F64
    of: I64
    view: I64
    uv: F64


def picture(rgb: U8, mask: U8, camera: Camera) -> Picture:
    """A photo (H, W, 3), and its mask (0 where it must not be used; (0, 0): none), at the camera's size."""
    import cv2

    size = (camera.width, camera.height)
    grey = np.asarray(cv2.cvtColor(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY), np.uint8)
    half = np.asarray(cv2.pyrDown(grey), np.uint8)
    usable = np.ones(grey.shape, bool)
    if mask.size:
        usable = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)) > 0
    return Picture(camera, (grey, half, np.asarray(cv2.pyrDown(half), np.uint8)), usable)


def matches(
    views: Sequence[View],
    pictures: Mapping[int, Picture],
    depth: Callable[[int], DepthMap],
    around: Mapping[int, Sequence[int]],
    *,
    count: int,
    max_distance: float,
) -> Matches:
    """Find the corners of every photo in those around it.

    Args:
        views: posed photos.
        pictures: of those that are compared.
        depth: a view's depth map; half as wide as its picture will do.
        around: view to the views in which its corners are looked for.
        count: corners of a photo, at most.
        max_distance: metres beyond which a place is not asked.
    """
    place, normal, first, corner = [], [], [], []
    of, seen_by, uv = [], [], []
    total = 0
    for i, others in around.items():
        mine, T = pictures[i], views[i].T_world_cam
        at, p, n = _corners(mine, depth(i), count, max_distance)
        world, facing = p @ T[:3, :3].T + T[:3, 3], n @ T[:3, :3].T
        for j in others:
            theirs = pictures[j]
            sees = np.flatnonzero(visible(depth(j), world, facing, bias=BEHIND))
            found, ok = _find(
                _with_channel(mine.levels), _with_channel(theirs.levels), theirs.usable, at[sees], p[sees], n[sees],
                eye(mine.camera, T), eye(theirs.camera, views[j].T_world_cam, T),
            )  # fmt: skip
            of.append(total + sees[ok])
            seen_by.append(np.full(int(ok.sum()), j))
            uv.append(found[ok])
        place.append(world)
        normal.append(facing)
        first.append(np.full(len(at), i))
        corner.append(at)
        total += len(at)

    def joined(parts: list[F64], width: int) -> F64:
        return np.concatenate(parts) if parts else np.zeros((0, width))

    def numbers(parts: list[I64]) -> I64:
        return np.concatenate(parts).astype(np.int64) if parts else np.zeros(0, np.int64)

    return Matches(
        joined(place, 3), joined(normal, 3), numbers(first), joined(corner, 2), numbers(of), numbers(seen_by),
        joined(uv, 2),
    )  # fmt: skip


def _with_channel(levels: tuple[U8, ...]) -> tuple[U8, ...]:
    """(h, w) pictures as `pipeline.camera.image_sampling` takes them: (h, w, 1)."""
    return tuple(level[..., None] for level in levels)


def _corners(picture: Picture, depth: DepthMap, count: int, max_distance: float) -> tuple[F64, F64, F64]:
    """Pixels (N, 2), places (N, 3) and normals (N, 3) in camera axes of corners where the surface is flat."""
    import cv2

    rays = pixel_rays(depth.camera)
    points = rays * np.where(depth.range < max_distance, depth.range, np.nan)[..., None].astype(np.float32)
    plane = _planes(points)
    flat = np.isfinite(plane[..., 0])
    flat = cv2.erode(flat.astype(np.uint8), np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    height, width = picture.usable.shape
    rows, columns = (
        ((np.arange(size) + 0.5) * coarse / size).astype(int)
        for size, coarse in zip((height, width), flat.shape, strict=True)
    )
    usable = flat[np.ix_(rows, columns)] & picture.usable
    apart = 0.6 * math.sqrt(max(1, int(usable.sum())) / count)
    mask = usable.astype(np.uint8)
    chosen = cv2.goodFeaturesToTrack(picture.levels[0], count, QUALITY, max(4.0, apart), mask=mask, blockSize=7)
    if chosen is None:
        return np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3))
    at = np.round(np.asarray(chosen, np.float64).reshape(-1, 2)).astype(int)
    near = rows[at[:, 1]], columns[at[:, 0]]
    normal, on = plane[near].astype(np.float64), points[near].astype(np.float64)
    ray = unproject(picture.camera, at)
    far = np.einsum("ij,ij->i", on, normal) / np.einsum("ij,ij->i", ray, normal)
    return at.astype(np.float64), ray * far[:, None], normal


@njit(cache=True, parallel=True)
def _planes(points: F32) -> F32:
    """(H, W, 3) unit normals towards the camera of the plane through a patch; NaN where the surface is not flat."""
    height, width = points.shape[:2]
    out = np.full((height, width, 3), np.nan, np.float32)
    for v in prange(WINDOW, height - WINDOW):
        a, b, n = np.zeros(3), np.zeros(3), np.zeros(3)
        for u in range(WINDOW, width - WINDOW):
            p = points[v, u]
            r = math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
            if not r > 0.1:
                continue
            for k in range(3):
                a[k] = points[v, u + WINDOW, k] - points[v, u - WINDOW, k]
                b[k] = points[v + WINDOW, u, k] - points[v - WINDOW, u, k]
            n[0], n[1], n[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            size = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            if not size > 1e-12:
                continue
            along = (n[0] * p[0] + n[1] * p[1] + n[2] * p[2]) / size
            if abs(along) < GRAZING * r:
                continue
            size = -size if along > 0 else size
            limit = FLAT[0] + FLAT[1] * r
            flat = True
            for dv in range(-WINDOW, WINDOW + 1, WINDOW):
                for du in range(-WINDOW, WINDOW + 1, WINDOW):
                    q = points[v + dv, u + du]
                    off = n[0] * (q[0] - p[0]) + n[1] * (q[1] - p[1]) + n[2] * (q[2] - p[2])
                    flat &= abs(off) < limit * abs(size)  # NaN is not flat
            if flat:
                for k in range(3):
                    out[v, u, k] = n[k] / size
    return out


@njit(cache=True, parallel=True)
def _find(
    a: Sequence[U8], b: Sequence[U8], usable: Bools, corner: F64, place: F64, normal: F64, eye_a: Eye, eye_b: Eye
) -> tuple[F64, Bools]:
    """Pixels (N, 2) at which the second photo shows corners of the first, and whether it was found (N,).

    Args:
        a, b: `levels` of both pictures; usable: of the second.
        corner, place, normal: (N, 2) pixels of the first, (N, 3) and (N, 3) in its camera's axes.
        eye_a, eye_b: of both photos; the second's takes places in the first's axes.
    """
    found = np.zeros((len(corner), 2))
    good = np.zeros(len(corner), np.bool_)
    for i in prange(len(corner)):
        u, v = corner[i, 0], corner[i, 1]
        x0, y0, ok = _through_plane(eye_a, u, v, place[i], normal[i], eye_b)
        ax, ay, ok1 = _through_plane(eye_a, u + 2, v, place[i], normal[i], eye_b)
        bx, by, ok2 = _through_plane(eye_a, u - 2, v, place[i], normal[i], eye_b)
        cx, cy, ok3 = _through_plane(eye_a, u, v + 2, place[i], normal[i], eye_b)
        dx, dy, ok4 = _through_plane(eye_a, u, v - 2, place[i], normal[i], eye_b)
        if not (ok and ok1 and ok2 and ok3 and ok4):
            continue
        A = np.array([[(ax - bx) / 4, (cx - dx) / 4], [(ay - by) / 4, (cy - dy) / 4]])
        area = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
        if not SCALES[0] < area < SCALES[1]:  # at an equirectangular photo's seam, too
            continue
        shift = np.zeros(2)  # pixels of the first photo
        ok = _align(a[2], b[2], 4.0, u, v, x0, y0, A, shift) >= 0
        ok = ok and _align(a[1], b[1], 2.0, u, v, x0, y0, A, shift) >= 0
        if not ok or _align(a[0], b[0], 1.0, u, v, x0, y0, A, shift) < ALIKE:
            continue
        x = x0 + A[0, 0] * shift[0] + A[0, 1] * shift[1]
        y = y0 + A[1, 0] * shift[0] + A[1, 1] * shift[1]
        if (x - x0) ** 2 + (y - y0) ** 2 > FARTHEST**2 or not usable[int(y + 0.5), int(x + 0.5)]:
            continue
        found[i, 0], found[i, 1], good[i] = x, y, True
    return found, good


@njit(cache=True)
def _through_plane(eye_a: Eye, u: float, v: float, place: F64, normal: F64, eye_b: Eye) -> tuple[float, float, bool]:
    """(u, v, ok): where the second camera has what the first one's pixel shows of a plane (in the first's axes)."""
    x, y, z = unproject_pixel(eye_a.model, eye_a.p, u, v)
    along = x * normal[0] + y * normal[1] + z * normal[2]
    t = (place[0] * normal[0] + place[1] * normal[1] + place[2] * normal[2]) / along if along < -1e-4 else -1.0
    if not t > 0:
        return 0.0, 0.0, False
    x, y, z = to_camera(eye_b.T, x * t, y * t, z * t)
    return project_point(eye_b.model, eye_b.p, x, y, z)


@njit(cache=True)
def _align(a: U8, b: U8, size: float, u: float, v: float, x0: float, y0: float, A: F64, shift: F64) -> float:
    """Correlation of two patches after `shift` (2,), in place, was bettered on one level; -1: not to be had.

    Args:
        a, b: (h, w, 1) uint8 grey of this level, whose pixels are `size` of the finest's.
        u, v: the corner in the first photo; x0, y0: where it should be in the second; A: (2, 2) the way between them.
    """
    n = 2 * HALF + 1
    uc, vc = (u + 0.5) / size - 0.5, (v + 0.5) / size - 0.5
    if uc < HALF + 1 or vc < HALF + 1 or uc >= a.shape[1] - HALF - 2 or vc >= a.shape[0] - HALF - 2:
        return -1.0
    want, gu, gv, have = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    mean = 0.0
    for r in range(n):
        for c in range(n):
            x, y = uc + c - HALF, vc + r - HALF
            want[r, c] = _at(a, x, y)
            gu[r, c] = 0.5 * (_at(a, x + 1, y) - _at(a, x - 1, y))
            gv[r, c] = 0.5 * (_at(a, x, y + 1) - _at(a, x, y - 1))
            mean += want[r, c]
    mean /= n * n
    spread = huu = huv = hvv = 0.0
    mu, mv = gu.mean(), gv.mean()
    for r in range(n):
        for c in range(n):
            want[r, c] -= mean
            gu[r, c] -= mu
            gv[r, c] -= mv
            spread += want[r, c] ** 2
            huu += gu[r, c] ** 2
            huv += gu[r, c] * gv[r, c]
            hvv += gv[r, c] ** 2
    det = huu * hvv - huv * huv
    if spread < 4.0 * n * n or det < 1e-3 * (huu + hvv) ** 2:  # two grey levels of contrast; an edge slides
        return 1.0 if size > 1 else -1.0  # too little to see on this level: finer ones may show it
    alike = -1.0
    du, dv = shift[0] / size, shift[1] / size
    for _ in range(ITERATIONS):
        x = (x0 + (A[0, 0] * du + A[0, 1] * dv) * size + 0.5) / size - 0.5
        y = (y0 + (A[1, 0] * du + A[1, 1] * dv) * size + 0.5) / size - 0.5
        wide = HALF * (abs(A[0, 0]) + abs(A[0, 1])) + 1
        high = HALF * (abs(A[1, 0]) + abs(A[1, 1])) + 1
        if not (x >= wide and y >= high and x < b.shape[1] - wide - 1 and y < b.shape[0] - high - 1):
            return -1.0
        total = 0.0
        for r in range(n):
            for c in range(n):
                s, t = c - HALF, r - HALF
                have[r, c] = _at(b, x + A[0, 0] * s + A[0, 1] * t, y + A[1, 0] * s + A[1, 1] * t)
                total += have[r, c]
        total /= n * n
        theirs = cross = 0.0
        for r in range(n):
            for c in range(n):
                have[r, c] -= total
                theirs += have[r, c] ** 2
                cross += have[r, c] * want[r, c]
        if theirs < 1e-6:
            return -1.0
        alike = cross / math.sqrt(theirs * spread)
        gain = math.sqrt(spread / theirs)
        eu = ev = 0.0
        for r in range(n):
            for c in range(n):
                e = want[r, c] - gain * have[r, c]
                eu += gu[r, c] * e
                ev += gv[r, c] * e
        su, sv = (hvv * eu - huv * ev) / det, (huu * ev - huv * eu) / det
        long = math.sqrt(su * su + sv * sv)
        if long > 2:  # further than the slope can tell
            su, sv = 2 * su / long, 2 * sv / long
        du, dv = du + su, dv + sv
        if long < 0.01:
            break
    shift[0], shift[1] = du * size, dv * size
    return alike if size == 1 or alike > 0.5 else -1.0


@njit(cache=True, inline="always")
def _at(image: npt.NDArray[Any], x: float, y: float) -> float:
    """Grey of a picture (H, W, 1) at a pixel."""
    return mixed(image, 0, taps(image, x, y, False))
