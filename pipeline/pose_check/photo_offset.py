"""Offset between photos and a cloud: by how many pixels the cloud must be shifted to match the photos of a camera.

Depth discontinuities are correlated with image edges, and the points' intensity with the image's contrast (as in
`pose_check.photo_fit`), over all shifts up to a few pixels of the reduced photos. The correlations of a camera's photos
are summed before the largest one is searched: an error of the camera's mounting shifts all photos alike, and a single
photo rarely constrains it. The offset is reported only if two halves of the photos give it independently.

On synthetic and real recordings with correct poses the offset is below 0.8 of these pixels (0.2 degrees for a focal
length of 0.6 image widths); added offsets of 0.3 degrees, and of 5 and 15 cm, are measured to 0.1 degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, PointCloud, View
from scan2sim.pipeline.pose_check.conventions import camera_rows
from scan2sim.pipeline.pose_check.photo_fit import LIMITS as FIT
from scan2sim.pipeline.pose_check.photo_fit import SmallPhoto, intensity_contrast, rendered, small_photo


@dataclass(frozen=True)
class OffsetLimits:
    """Parameters of the offset.

    Attributes:
        cameras, photos: largest numbers of cameras, and of photos of each.
        min_photos: photos of a camera that are needed.
        search_px: largest shift, pixels of the reduced photos.
        min_peak: height of the largest correlation over the median, in robust standard deviations over all shifts.
        min_photo_peak: the same of a single photo, below which it is unsure.
        halves_px: largest difference between both halves of the photos.
        notable_px: offset from which it is a warning.
        constant_px: largest median deviation of single photos from their median, for a constant offset.
    """

    cameras: int = 3
    photos: int = 8
    min_photos: int = 4
    search_px: int = 12
    min_peak: float = 3.5
    min_photo_peak: float = 3.0
    halves_px: float = 0.7
    notable_px: float = 1.0
    constant_px: float = 0.5


LIMITS = OffsetLimits()


@dataclass(frozen=True)
class CameraOffset:
    """Offset of a camera's photos.

    Attributes:
        photo: name of its first photo.
        photos: number of photos that were compared.
        unsure: number of those that don't show an offset by themselves.
        right_px, down_px: shift from the cloud to the photos, pixels of the full-size photos; None: not measurable.
        degrees: the same as an angle.
        centimetres: the same at the median distance of the points.
        distance_m: median distance of the points.
        constant: whether single photos agree on it.
        notable: whether it is more than correct poses give.
    """

    photo: str
    photos: int
    unsure: int
    right_px: float | None = None
    down_px: float | None = None
    degrees: float = 0.0
    centimetres: float = 0.0
    distance_m: float = 0.0
    constant: bool = False
    notable: bool = False

    def figures(self) -> dict[str, Any]:
        """Content for `photo_check.json`."""
        return asdict(self)

    def text(self) -> str:
        """Such as "front_0001.jpg and others: 4.1 px right, 1.0 px up (0.31 degrees, 7 cm at 14 m)"."""
        name = f"{self.photo} and {self.photos - 1} others"
        if self.right_px is None or self.down_px is None:
            return f"{name}: no offset from the cloud is measurable"
        horizontal = f"{abs(self.right_px):.1f} px {'right' if self.right_px > 0 else 'left'}"
        vertical = f"{abs(self.down_px):.1f} px {'down' if self.down_px > 0 else 'up'}"
        size = f"{self.degrees:.2f} degrees, {self.centimetres:.0f} cm at {self.distance_m:.0f} m"
        doubt = f"; {self.unsure} unsure alone" if self.unsure else ""
        return f"{name}: {horizontal}, {vertical} of the cloud ({size}{doubt})"

    def warning(self) -> str | None:
        """A warning if the offset is notable."""
        if not self.notable:
            return None
        how = "the same in all of them: " if self.constant else ""
        return (
            f"photos look shifted against the cloud, {how}{self.text()}; check the mounting of the camera (extrinsics) "
            "and the times of the photos"
        )


def offsets(views: Sequence[View], cloud: PointCloud) -> list[CameraOffset]:
    """Offsets of the cameras with most photos; cameras with too few are left out.

    Args:
        views: posed photos.
        cloud: points, in local coordinates.
    """
    groups = sorted(camera_rows([view.camera for view in views]), key=len, reverse=True)
    found = [_offset([(int(i), views[i]) for i in _even(rows)], cloud) for rows in groups[: LIMITS.cameras]]
    return [one for one in found if one is not None]


def _even(rows: np.ndarray) -> np.ndarray:
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(LIMITS.photos, len(rows))).round().astype(int))]


def _offset(views: Sequence[tuple[int, View]], cloud: PointCloud) -> CameraOffset | None:
    correlations, distances = list[F64](), list[float]()
    for i, view in views:
        photo = small_photo(i, view)
        if photo is not None:
            correlation, distance = _correlations(photo, view, cloud)
            correlations.append(correlation)
            distances.append(distance)
    if len(correlations) < LIMITS.min_photos:
        return None
    every = np.array(correlations)
    whole, single = _peak(every.sum(axis=0)), np.array([_peak(one) for one in every])
    halves = np.array([_peak(every[half::2].sum(axis=0)) for half in (0, 1)])
    sure = single[:, 2] >= LIMITS.min_photo_peak
    name, unsure = views[0][1].name, int((~sure).sum())
    apart = float(np.abs(halves[0, :2] - halves[1, :2]).max())
    if whole[2] < LIMITS.min_peak or apart > LIMITS.halves_px:
        return CameraOffset(name, len(every), unsure)
    camera = views[0][1].camera
    scale = camera.width / FIT.photo_width_px
    length = float(np.hypot(*whole[:2]))
    per_radian = camera.width / (2 * np.pi) if camera.model == "equirectangular" else camera.fx
    angle, distance = length * scale / per_radian, float(np.median(distances))
    spread = np.median(np.abs(single[sure, :2] - np.median(single[sure, :2], axis=0)), axis=0) if sure.any() else [9.0]
    return CameraOffset(
        name, len(every), unsure, round(whole[0] * scale, 2), round(whole[1] * scale, 2),
        round(float(np.degrees(angle)), 3), round(100 * angle * distance, 1), round(distance, 1),
        bool(np.max(spread) < LIMITS.constant_px), length > LIMITS.notable_px,
    )  # fmt: skip


def _correlations(photo: SmallPhoto, view: View, cloud: PointCloud) -> tuple[F64, float]:
    """Correlations (S, S) of cloud and photo by vertical and horizontal shift, and the points' median distance (m)."""
    seen = rendered(photo, view.camera, view.T_world_cam, cloud)
    size = 2 * LIMITS.search_px + 1
    total = np.zeros((size, size))
    if seen.front.sum() > FIT.min_pixels:
        gradient = photo.gradient - photo.gradient[seen.shown].mean()
        total += _shifted(seen.front, gradient) / (gradient.std() * np.sqrt(seen.front.sum()) + 1e-9)
    if cloud.intensity is not None and len(seen.index) > FIT.min_pixels:
        values = cloud.intensity[seen.index].astype(np.float32)
        contrast, on = intensity_contrast(photo, values, seen.column, seen.row)
        contrast = np.where(on, contrast - contrast[on].mean(), 0)
        scale = float(contrast[on].std()) + 1e-9
        contrast = np.clip(contrast, -3 * scale, 3 * scale)
        total += _shifted(contrast, photo.contrast) / (scale * photo.contrast.std() * np.sqrt(on.sum()) + 1e-9)
    return total, float(np.median(seen.distance)) if len(seen.distance) else 0.0


def _shifted(one: np.ndarray, other: np.ndarray) -> F64:
    """Sums (S, S) of products of `one` (H, W) with `other`, sampled at shifts up to `search_px`, by FFT."""
    reach = LIMITS.search_px
    shape = (one.shape[0] + 2 * reach, one.shape[1] + 2 * reach)
    product = np.conj(np.fft.rfft2(one, shape)) * np.fft.rfft2(other, shape)
    sums = np.roll(np.fft.irfft2(product, shape), (reach, reach), (0, 1))
    return np.asarray(sums[: 2 * reach + 1, : 2 * reach + 1], np.float64)


def _peak(sums: F64) -> tuple[float, float, float]:
    """Shift right and down (pixels) of the largest sum, refined by parabolas, and its height; 0 at the border."""
    y, x = (int(k) for k in np.unravel_index(sums.argmax(), sums.shape))
    middle = float(np.median(sums))
    height = float(sums.max() - middle) / (1.4826 * float(np.median(np.abs(sums - middle))) + 1e-12)
    reach = LIMITS.search_px
    if not (0 < y < 2 * reach and 0 < x < 2 * reach):
        return x - reach, y - reach, 0.0
    return x - reach + _vertex(sums[y, x - 1 : x + 2]), y - reach + _vertex(sums[y - 1 : y + 2, x]), height


def _vertex(values: F64) -> float:
    """Position of the vertex of the parabola through three values at -1, 0 and 1."""
    before, middle, after = values.tolist()
    return float(0.5 * (before - after) / (before - 2 * middle + after - 1e-12))
