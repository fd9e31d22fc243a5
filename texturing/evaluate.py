"""Texture evaluation: PSNR, SSIM and sharpness of renderings against photos held out of texturing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, View
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Image, Renderer


RAYS_PER_PIXEL_SIDE = 3
"""Rays per pixel in each direction: renderings get as soft with distance as a simulator's, which uses mip-maps."""
BAND_EDGES_M = (5.0, 10.0, 20.0, 40.0)
"""Metres from the camera at which one distance band ends and the next begins."""
BAND_NAMES = ("0-5 m", "5-10 m", "10-20 m", "20-40 m", "40+ m")
ERROR_IMAGE_MAX_LEVELS = 64
"""Difference in grey levels that an error image shows at full brightness."""
ERROR_IMAGE_GAP_PX = 4
"""Pixels between the parts of an error image."""
ERROR_IMAGE_UNCOUNTED_LEVEL = 128
"""Grey level of pixels that are not counted."""


@dataclass(frozen=True)
class Errors:
    """Per-pixel errors of a rendering against its photo: (H, W) float32, NaN for pixels that are not counted.

    Attributes:
        squared: squared difference, mean of the channels.
        squared_gain: the same, after the least-squares gain of each channel over the whole photo.
        ssim: structural similarity of the grey images in the window around the pixel (Wang et al. 2004); also NaN
            where the window lies mostly outside the mask.
    """

    squared: F32
    squared_gain: F32
    ssim: F32


@dataclass(frozen=True)
class HeldOut:
    """A held-out photo and the scores of its rendering.

    Attributes:
        view: posed photo.
        photo: (H, W, 3) uint8 RGB.
        render: rendering of the world from the photo's pose, with the index of the folder (`body`) and the distance
            from the camera in metres (`range`) of every pixel.
        mask: (H, W) pixels that are counted: surfaces that another photo saw, that this photo sees without an object
            in front that the world leaves out (a parked car), and that are not masked out. If there are none, any
            surface is counted; if there is no surface at all, all pixels are: missing surfaces are errors of the world.
        errors: per-pixel errors.
        coverage: share of the pixels with a surface that another photo saw.
        psnr_db, psnr_gain_db, ssim, sharpness: see `score`.
    """

    view: View
    photo: U8
    render: Image
    mask: Bools
    errors: Errors
    coverage: float
    psnr_db: float
    psnr_gain_db: float
    ssim: float
    sharpness: float


def score(photo: U8, render: U8, mask: Bools) -> dict[str, float]:
    """Similarity of a rendering to a photo, (H, W, 3) each, over the pixels of `mask` (H, W).

    Returns:
        psnr_db: PSNR of the rendering as it is. psnr_gain_db: PSNR after the least-squares gain of each channel, which
        compensates the photo's exposure. ssim: mean structural similarity after the gain. sharpness: see `sharpness`,
        after the gain. NaN if no pixel is counted.
    """
    return _score(errors(photo, render, mask), photo, render, mask)


def _score(pixel_errors: Errors, photo: U8, render: U8, mask: Bools) -> dict[str, float]:
    scores = figures(tally(pixel_errors, np.zeros(mask.shape, np.int64), 1)[0])
    return {name: scores[name] for name in ("psnr_db", "psnr_gain_db", "ssim")} | {
        "sharpness": sharpness(photo, matched(photo, render, mask), mask)
    }


def errors(photo: U8, render: U8, mask: Bools, gain: F64 | None = None) -> Errors:
    """Per-pixel errors of a rendering (H, W, 3) against a photo (H, W, 3), within `mask` (H, W).

    `gain` (3,) is the gain of each channel; None: the least-squares gain within the mask.
    """
    like = apply_gain(render, solve_gain(photo, render, mask) if gain is None else gain)
    squared, squared_gain = (np.full(mask.shape, np.nan, np.float32) for _ in range(2))
    squared[mask] = ((photo[mask].astype(np.float64) - render[mask]) ** 2).mean(axis=1)
    squared_gain[mask] = ((photo[mask].astype(np.float64) - like[mask]) ** 2).mean(axis=1)
    return Errors(squared, squared_gain, _ssim(photo, like, mask))


def matched(photo: U8, render: U8, mask: Bools) -> U8:
    """The rendering (H, W, 3) scaled by the least-squares gain of each channel to match the photo."""
    return apply_gain(render, solve_gain(photo, render, mask))


def solve_gain(photo: U8, render: U8, mask: Bools) -> F64:
    """(3,) gain of each channel of the rendering with the least squared error within the mask; 1 if it is empty."""
    a, b = photo[mask].astype(np.float64), render[mask].astype(np.float64)
    return np.asarray((a * b).sum(axis=0) / np.maximum((b * b).sum(axis=0), 1.0)) if len(a) else np.ones(3)


def apply_gain(render: U8, gain: F64) -> U8:
    """The rendering (H, W, 3) times a gain (3,) per channel."""
    return np.clip(np.round(render * gain), 0, 255).astype(np.uint8)


def sharpness(photo: U8, render: U8, mask: Bools) -> float:
    """Sharpness ratio: mean absolute Laplacian of the grey rendering over that of the photo; below 1 is softer.

    Pixels are counted whose eight neighbours are in the mask; NaN if there are none, or the photo has no detail there.
    """
    import cv2

    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    if not inner.any():
        return math.nan

    def detail(image: U8) -> float:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)[inner]).mean())

    photo_detail = detail(photo)
    return detail(render) / photo_detail if photo_detail > 0 else math.nan


def tally(pixel_errors: Errors, part: npt.NDArray[Any], count: int) -> F64:
    """Sums of a photo's errors by part; sums of several photos can be added.

    Args:
        pixel_errors: errors of one photo.
        part: (H, W) integers, the part that a pixel belongs to (such as its class); negative: none.
        count: number of parts.

    Returns:
        (count, 5): pixels, sums of `squared` and `squared_gain`, pixels with a window, sum of `ssim`.
    """

    def sums(values: F32) -> tuple[F64, F64]:
        counts = ~np.isnan(values) & (part >= 0)
        weights = np.stack([np.ones(counts.sum()), values[counts]])
        pixels, total = (np.bincount(part[counts], weight, count).astype(np.float64) for weight in weights)
        return pixels, total

    pixels, squared = sums(pixel_errors.squared)
    return np.stack([pixels, squared, sums(pixel_errors.squared_gain)[1], *sums(pixel_errors.ssim)], axis=1)


def figures(sums: F64) -> dict[str, Any]:
    """Scores from sums (5,) of `tally`: `psnr_db`, `psnr_gain_db`, `ssim` (NaN if no pixel is counted), `pixels`."""
    pixels, squared, squared_gain, windows, ssim = sums.tolist()
    return {
        "psnr_db": psnr(squared / pixels) if pixels else math.nan,
        "psnr_gain_db": psnr(squared_gain / pixels) if pixels else math.nan,
        "ssim": ssim / windows if windows else math.nan,
        "pixels": int(pixels),
    }


def psnr(squared: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared error of 8-bit values; at most 78."""
    return 10 * math.log10(255**2 / max(squared, 1e-3))


def _ssim(photo: U8, render: U8, mask: Bools) -> F32:
    """(H, W) SSIM with Gaussian windows of sigma 1.5; pixels outside the mask are excluded from the windows."""
    import cv2

    def blur(image: F32) -> F32:
        return np.asarray(cv2.GaussianBlur(image, (11, 11), 1.5), np.float32)

    m = mask.astype(np.float32)
    weight = blur(m)
    x, y = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) * m for image in (photo, render))
    scale = 1 / np.maximum(weight, 1e-6)
    mx, my = blur(x) * scale, blur(y) * scale
    vx, vy, cov = blur(x * x) * scale - mx * mx, blur(y * y) * scale - my * my, blur(x * y) * scale - mx * my
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    index = (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return np.where(mask & (weight > 0.5), index, np.float32(np.nan)).astype(np.float32)


def held_out(world: Renderer, views: Sequence[View], depths: Sequence[Path] | None = None) -> Iterator[HeldOut]:
    """Render textured meshes from each held-out view and score the renderings; skips unreadable photos and masks.

    Args:
        world: renderer of the textured meshes.
        views: held-out views.
        depths: depth map file of each view; pixels where it shows an object that the world leaves out are not
            counted. None: every pixel with a surface is counted.
    """
    import cv2

    files: list[Path | None] = list(depths) if depths is not None else [None] * len(views)
    for view, depth in zip(views, files, strict=True):
        try:
            photo, allowed = image.read_photo(view), image.read_mask(view)
        except InputError:  # the step `views` has warned about it
            continue
        render = world.view(view.camera, view.T_world_cam, samples=RAYS_PER_PIXEL_SIDE)
        surface = render.hit if allowed is None else render.hit & (allowed > 0)
        if depth is not None:
            first = cv2.resize(np.load(depth), surface.shape[::-1], interpolation=cv2.INTER_NEAREST)
            surface &= render.range <= first * 1.02 + 0.1
        mask = surface & (render.seen == 255)
        coverage = float(mask.sum() / max(1, surface.sum()))
        if not mask.any():
            mask = surface if surface.any() else np.ones_like(surface) if allowed is None else allowed > 0
        pixel_errors = errors(photo, render.rgb, mask)
        scores = _score(pixel_errors, photo, render.rgb, mask)
        yield HeldOut(view, photo, render, mask, pixel_errors, coverage, **scores)


def error_image(result: HeldOut, *, width: int = 1600) -> U8:
    """Photo, rendering and their difference side by side: (H, W, 3) RGB, at most `width` pixels wide.

    The difference, averaged over the channels, is drawn from black (equal) to bright yellow
    (`ERROR_IMAGE_MAX_LEVELS` grey levels or more); grey where pixels are not counted.
    """
    import cv2

    photo_height, photo_width = result.photo.shape[:2]
    part_width = max(1, min(photo_width, (width - 2 * ERROR_IMAGE_GAP_PX) // 3))
    size = (part_width, max(1, round(photo_height * part_width / photo_width)))

    def small(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))

    counted = small(result.mask.astype(np.float32))
    absolute = np.abs(result.photo.astype(np.float32) - result.render.rgb).mean(axis=2) * result.mask
    scale = 255 / ERROR_IMAGE_MAX_LEVELS
    level = np.clip(small(absolute) / np.maximum(counted, 1e-6) * scale, 0, 255).astype(np.uint8)
    coloured = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO))[..., ::-1]
    difference = np.where(counted[..., None] > 0.5, coloured, ERROR_IMAGE_UNCOUNTED_LEVEL).astype(np.uint8)
    gap = np.full((size[1], ERROR_IMAGE_GAP_PX, 3), 255, np.uint8)
    return np.hstack([small(result.photo), gap, small(result.render.rgb), gap, difference])
