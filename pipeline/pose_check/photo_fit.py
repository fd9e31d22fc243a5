"""How well posed photos fit a point cloud: a score per photo, comparable between different poses of the same photos.

Points are projected into small versions of the photos, with a range image against hidden ones. The score of a photo is
the sum of three terms, which are independent of exposure and of the colours of the points (an importer may have taken
those from the same photos at wrong poses):

- photo consistency: correlation of local contrast at points that another photo shows, too, over the other photos with
  the largest overlap (as zero-mean normalized cross-correlation does in multi-view stereo);
- edges: image gradient at depth discontinuities relative to that at all points (Levinson and Thrun, Automatic Online
  Calibration of Cameras and Lasers, RSS 2013);
- intensity: correlation of the points' intensity with the image's local contrast, if points have one (after Pandey et
  al., Automatic Targetless Extrinsic Calibration of a 3D Lidar and Camera, AAAI 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools, Camera, Frame, PointCloud, Tile, View
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.pose_check.conventions import camera_rows


@dataclass(frozen=True)
class FitLimits:
    """Parameters of the score.

    Attributes:
        max_points: points of the cloud that are used.
        max_photos: photos that are used.
        photo_width_px: width to which photos are reduced.
        near_m, far_m: distances of points that are used.
        occluder_share, occluder_m: points farther behind the range image are hidden: share of the range plus metres.
        discontinuity: ratio of ranges between neighbouring pixels that makes a depth discontinuity.
        contrast_sigma_px, texture_sigma_px: standard deviations of the Gaussians of the local contrast.
        partners: other photos that each is compared with.
        shrink_share: share of a photo's pixels at which the evidence of a correlation counts half.
        min_pixels: pixels with points below which a term is 0.
    """

    max_points: int = 120_000
    max_photos: int = 8
    photo_width_px: int = 400
    near_m: float = 0.5
    far_m: float = 50.0
    occluder_share: float = 0.05
    occluder_m: float = 0.1
    discontinuity: float = 1.2
    contrast_sigma_px: float = 8.0
    texture_sigma_px: float = 12.0
    partners: int = 3
    shrink_share: float = 0.02
    min_pixels: int = 100


LIMITS = FitLimits()


@dataclass(frozen=True)
class SmallPhoto:
    """A reduced photo.

    Attributes:
        index: index of its view.
        gradient: (H, W) image gradient relative to that of the surroundings.
        contrast: (H, W) grey value relative to the surroundings, in their standard deviations.
        usable: (H, W) bool, False where the mask excludes it.
    """

    index: int
    gradient: F32
    contrast: F32
    usable: Bools


@dataclass(frozen=True)
class Fit:
    """Scores (P,) of the photos by term, NaN for photos without a pose."""

    consistency: F64
    edges: F64
    intensity: F64

    @property
    def score(self) -> F64:
        """Sum (P,) of the terms."""
        return self.consistency + self.edges + self.intensity


def sample_points(tile: Tile) -> PointCloud:
    """About `max_points` of a tile's points, evenly in their order, with our class codes.

    Raises:
        ScanError: a cloud can't be read.
    """
    count = sum(clouds.read_header(path).count for path in tile.clouds)
    stride = max(1, count // LIMITS.max_points)
    parts = []
    for path in tile.clouds:
        table = clouds.code_table(path, tile.classes)
        for part in clouds.chunks(path, tile.frame):
            one = _in_frame(part.take(slice(0, None, stride)), tile.frame)
            parts.append(one if one.classification is None else replace(one, classification=table[one.classification]))
    return PointCloud.join(parts)


def _in_frame(cloud: PointCloud, frame: Frame) -> PointCloud:
    """The same points with another origin."""
    return replace(cloud, xyz=frame.to_local(cloud.frame.to_crs(cloud.xyz)).astype(np.float32), frame=frame)


def small_photos(views: Sequence[View]) -> list[SmallPhoto]:
    """Reduced versions of `chosen` photos; unreadable ones are left out."""
    chosen_views = chosen([view.camera for view in views])
    return [photo for i in chosen_views if (photo := small_photo(i, views[i])) is not None]


def chosen(cameras: Sequence[Camera]) -> list[int]:
    """Indices of at most `max_photos` photos: two runs of one or two cameras, as neighbours show the same surfaces.

    Args:
        cameras: camera of each photo, in order.
    """
    if len(cameras) <= LIMITS.max_photos:
        return list(range(len(cameras)))
    groups = sorted(camera_rows(cameras), key=len, reverse=True)
    found: set[int] = set()
    for group, middle in ((groups[0], 0.25), (groups[min(1, len(groups) - 1)], 0.75)):
        count = min(len(group), LIMITS.max_photos // 2)
        stride = 2 if len(group) >= 4 * count else 1
        first = round(np.clip(middle * len(group) - count * stride / 2, 0, len(group) - 1 - (count - 1) * stride))
        found |= set(group[first : first + count * stride : stride].tolist())
    return sorted(found)


def small_photo(index: int, view: View) -> SmallPhoto | None:
    """The reduced version of a photo; None if it can't be read."""
    import cv2

    rgb = image.usable_photo(view)
    if rgb is None:
        return None
    width = LIMITS.photo_width_px
    size = (width, max(8, round(width * rgb.shape[0] / rgb.shape[1])))
    grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA).astype(np.float32)
    levels = image.read_mask(view)
    usable = np.ones(grey.shape, bool) if levels is None else cv2.resize(levels, size, interpolation=0) > 0

    def blurred(values: F32, sigma: float) -> F32:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32)

    smooth = blurred(grey, 1.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    local = cv2.dilate(slope / (blurred(slope, LIMITS.texture_sigma_px) + 3), np.ones((3, 3)))
    detail = grey - blurred(grey, LIMITS.contrast_sigma_px)
    spread = np.sqrt(blurred(detail * detail, LIMITS.texture_sigma_px)) + 3
    return SmallPhoto(index, np.asarray(local, np.float32), blurred(detail / spread, 1.0), usable)


def fit(photos: Sequence[SmallPhoto], cameras: Sequence[Camera], T: F64, cloud: PointCloud) -> Fit:
    """Score the photos at given poses.

    Args:
        photos: the reduced photos (P).
        cameras: camera of each view (V).
        T: (V, 4, 4) camera to local coordinates; NaN: without a pose.
        cloud: points, in local coordinates.
    """
    terms = np.full((3, len(photos)), np.nan)
    contrast: list[F32 | None] = [None] * len(photos)
    for k, photo in enumerate(photos):
        if np.isfinite(T[photo.index]).all():
            terms[1:, k], contrast[k] = _alone(photo, cameras[photo.index], T[photo.index], cloud)
    seen = [k for k, values in enumerate(contrast) if values is not None]
    for k in seen:
        found = sorted((_consistency(contrast[k], contrast[j], photos[k]) for j in seen if j != k), reverse=True)
        best = [value for _, value in found[: LIMITS.partners]]
        terms[0, k] = float(np.mean(best)) if best else 0.0
    return Fit(terms[0], terms[1], terms[2])


@dataclass(frozen=True)
class Rendered:
    """A cloud's points in a reduced photo.

    Attributes:
        index: (M,) indices of the visible points.
        column, row: (M,) their pixels.
        distance: (M,) metres from the camera.
        shown: (H, W) pixels with points.
        front: (H, W) pixels in front of a depth discontinuity.
    """

    index: I64
    column: I64
    row: I64
    distance: F32
    shown: Bools
    front: Bools


def rendered(photo: SmallPhoto, camera: Camera, T: F64, cloud: PointCloud) -> Rendered:
    """The cloud as the photo should show it at a pose (4, 4), camera to local coordinates."""
    import cv2

    height, width = photo.contrast.shape
    index, column, row, distance = _projected(camera.resized(width, height), T, cloud.xyz)
    ranges = np.full((height, width), np.inf, np.float32)
    np.minimum.at(ranges, (row, column), distance)
    filled = cv2.erode(ranges, np.ones((3, 3)), borderType=cv2.BORDER_REPLICATE)
    visible = distance < filled[row, column] * (1 + LIMITS.occluder_share) + LIMITS.occluder_m
    visible &= photo.usable[row, column]
    shown = np.isfinite(filled) & photo.usable
    background = np.where(np.isfinite(filled), filled, np.float32(1e4))
    front = shown & (cv2.dilate(background, np.ones((3, 3))) > background * LIMITS.discontinuity)
    return Rendered(index[visible], column[visible], row[visible], distance[visible], shown, front)


def _alone(photo: SmallPhoto, camera: Camera, T: F64, cloud: PointCloud) -> tuple[F64, F32]:
    """Terms (2,) of edges and intensity, and contrast (N,) of the points; NaN: unseen."""
    seen = rendered(photo, camera, T, cloud)
    contrast = np.full(len(cloud), np.nan, np.float32)
    contrast[seen.index] = photo.contrast[seen.row, seen.column]
    terms = np.zeros(2)
    share = float(seen.shown.mean())
    if seen.front.sum() > LIMITS.min_pixels:
        there = photo.gradient[seen.shown]
        terms[0] = (photo.gradient[seen.front].mean() - there.mean()) / (there.std() + 1e-6)
    if cloud.intensity is not None and len(seen.index) > LIMITS.min_pixels:
        values, on = intensity_contrast(photo, cloud.intensity[seen.index].astype(np.float32), seen.column, seen.row)
        terms[1] = _correlation(values[on], photo.contrast[on])
    return terms * share / (share + LIMITS.shrink_share), contrast


def _projected(camera: Camera, T: F64, xyz: F32) -> tuple[np.ndarray, np.ndarray, np.ndarray, F32]:
    """Indices of the points inside a photo, their columns and rows, and their distances."""
    from scan2sim.pipeline.camera.projection import pixels

    distance = np.linalg.norm(xyz - T[:3, 3], axis=1)
    index = np.flatnonzero((distance < LIMITS.far_m) & (distance > LIMITS.near_m))
    found, inside = pixels(camera, T, xyz[index].astype(np.float64))
    index, found = index[inside], np.rint(found[inside]).astype(np.int64)
    on = np.flatnonzero(((found >= 0) & (found < (camera.width, camera.height))).all(axis=1))
    index, found = index[on], found[on]
    return index, found[:, 0], found[:, 1], distance[index].astype(np.float32)


def intensity_contrast(photo: SmallPhoto, values: F32, column: np.ndarray, row: np.ndarray) -> tuple[F32, Bools]:
    """Local contrast (H, W) of the points' intensity in the photo's pixels, and which (H, W) have points."""
    import cv2

    total, count = np.zeros(photo.contrast.shape, np.float32), np.zeros(photo.contrast.shape, np.float32)
    np.add.at(total, (row, column), values)
    np.add.at(count, (row, column), 1)

    def mean(sigma: float) -> F32:
        return np.asarray(cv2.GaussianBlur(total, (0, 0), sigma) / (cv2.GaussianBlur(count, (0, 0), sigma) + 1e-3))

    return mean(1.0) - mean(LIMITS.contrast_sigma_px), count > 0


def _consistency(one: F32 | None, other: F32 | None, photo: SmallPhoto) -> tuple[float, float]:
    """Overlap of two photos in points, and the correlation of their contrasts there, shrunk if the overlap is small."""
    assert one is not None and other is not None
    both = np.isfinite(one) & np.isfinite(other)
    overlap = int(both.sum())
    if overlap < LIMITS.min_pixels:
        return overlap, 0.0
    share = overlap / photo.contrast.size
    return overlap, _correlation(one[both], other[both]) * share / (share + LIMITS.shrink_share)


def _correlation(a: F32, b: F32) -> float:
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / scale if scale > 1e-9 else 0.0
