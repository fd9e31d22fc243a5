"""How good a texture is: renderings against photos that were held out of texturing."""

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


SAMPLES = 3
"""Rays a pixel each way: a rendering is as soft with distance as a simulator's, which filters with mip-maps."""
BANDS = (5.0, 10.0, 20.0, 40.0)
"""Metres from the camera at which one distance band ends and the next begins."""
BAND_NAMES = ("0-5 m", "5-10 m", "10-20 m", "20-40 m", "40+ m")
SCALE = 64
"""Grey levels apart at which an error picture is at its brightest."""
GAP = 4  # pixels between the parts of an error picture
NOT_COUNTED = 128


@dataclass(frozen=True)
class Errors:
    """How a rendering differs from its photo, pixel by pixel: (H, W) float32, NaN where nothing counts.

    Attributes:
        squared: squared difference, mean of the channels.
        squared_gain: the same, after the least-squares gain of each channel over the whole photo.
        ssim: structural similarity of the grey images in the window about the pixel (Wang et al. 2004); NaN too where
            the window lies mostly outside of what counts.
    """

    squared: F32
    squared_gain: F32
    ssim: F32


@dataclass(frozen=True)
class HeldOut:
    """A photo that was held out, and how it was met.

    Attributes:
        view: posed photo.
        photo: (H, W, 3) uint8 RGB.
        render: what the world looks like from there, with the index of the folder (`body`) and the metres from the
            camera (`range`) of every pixel.
        mask: (H, W) pixels that count: a surface that another photo saw, hidden from this one by nothing that
            the world leaves out (a parked car), and not masked out. Of a photo that shows none, any surface; of one
            that shows no surface at all, everything: what the world lacks there is its fault, and counts.
        errors: pixel by pixel.
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
    """Likeness of a rendering to a photo (H, W, 3) where `mask` (H, W) holds.

    Returns:
        psnr_db: as it is; psnr_gain_db: after the least-squares gain of each channel, and so are ssim, the mean
        structural similarity, and sharpness (see there): a photo's exposure is not the texture's. NaN where nothing
        counts.
    """
    return _score(errors(photo, render, mask), photo, render, mask)


def _score(of: Errors, photo: U8, render: U8, mask: Bools) -> dict[str, float]:
    whole = figures(tally(of, np.zeros(mask.shape, np.int64), 1)[0])
    return {name: whole[name] for name in ("psnr_db", "psnr_gain_db", "ssim")} | {
        "sharpness": sharpness(photo, matched(photo, render, mask), mask)
    }


def errors(photo: U8, render: U8, mask: Bools) -> Errors:
    """The errors of a rendering (H, W, 3) against a photo, where `mask` (H, W) holds."""
    like = matched(photo, render, mask)
    squared, squared_gain = (np.full(mask.shape, np.nan, np.float32) for _ in range(2))
    squared[mask] = ((photo[mask].astype(np.float64) - render[mask]) ** 2).mean(axis=1)
    squared_gain[mask] = ((photo[mask].astype(np.float64) - like[mask]) ** 2).mean(axis=1)
    return Errors(squared, squared_gain, _ssim(photo, like, mask))


def matched(photo: U8, render: U8, mask: Bools) -> U8:
    """The rendering (H, W, 3) with the least-squares gain of each channel that makes it most like the photo."""
    a, b = photo[mask].astype(np.float64), render[mask].astype(np.float64)
    gain = (a * b).sum(axis=0) / np.maximum((b * b).sum(axis=0), 1.0)
    return np.clip(np.round(render * gain), 0, 255).astype(np.uint8)


def sharpness(photo: U8, render: U8, mask: Bools) -> float:
    """Mean absolute Laplacian of the grey rendering over that of the photo: 1 is as sharp as it, less is softer.

    Pixels count whose eight neighbours are in the mask; NaN where there are none, or the photo has no detail there.
    """
    import cv2

    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    if not inner.any():
        return math.nan

    def detail(image: U8) -> float:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)[inner]).mean())

    of_photo = detail(photo)
    return detail(render) / of_photo if of_photo > 0 else math.nan


def tally(of: Errors, part: npt.NDArray[Any], count: int) -> F64:
    """Sums of a photo's errors by part; those of several photos may be added up.

    Args:
        of: a photo's errors.
        part: (H, W) integers, the part that a pixel belongs to; negative: none.
        count: of parts.

    Returns:
        (count, 5): pixels, sums of `squared` and `squared_gain`, pixels with a window, sum of `ssim`.
    """

    def sums(values: F32) -> tuple[F64, F64]:
        counts = ~np.isnan(values) & (part >= 0)
        weights = np.stack([np.ones(counts.sum()), values[counts]])
        pixels, total = (np.bincount(part[counts], weight, count).astype(np.float64) for weight in weights)
        return pixels, total

    pixels, squared = sums(of.squared)
    return np.stack([pixels, squared, sums(of.squared_gain)[1], *sums(of.ssim)], axis=1)


def figures(sums: F64) -> dict[str, Any]:
    """What sums (5,) of `tally` come to: `psnr_db`, `psnr_gain_db`, `ssim` (NaN where nothing counts), `pixels`."""
    pixels, squared, squared_gain, windows, ssim = sums.tolist()
    return {
        "psnr_db": psnr(squared / pixels) if pixels else math.nan,
        "psnr_gain_db": psnr(squared_gain / pixels) if pixels else math.nan,
        "ssim": ssim / windows if windows else math.nan,
        "pixels": int(pixels),
    }


def psnr(squared: float) -> float:
    """In dB, of a mean squared error of 8-bit values; at most 78."""
    return 10 * math.log10(255**2 / max(squared, 1e-3))


def _ssim(photo: U8, render: U8, mask: Bools) -> F32:
    """(H, W) by Gaussian windows of sigma 1.5; pixels outside the mask have no say in them."""
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
    """Render textured meshes from each of the views, and score; views whose photo or mask can't be read are skipped.

    Args:
        world: the textured meshes.
        views: held out.
        depths: files of the views' depth maps, which tell where a photo shows something that the world leaves
            out; None: every pixel with a surface counts.
    """
    import cv2

    files: list[Path | None] = list(depths) if depths is not None else [None] * len(views)
    for view, depth in zip(views, files, strict=True):
        try:
            photo, allowed = image.read_photo(view), image.read_mask(view)
        except InputError:  # `views` has told
            continue
        render = world.view(view.camera, view.T_world_cam, samples=SAMPLES)
        surface = render.hit if allowed is None else render.hit & (allowed > 0)
        if depth is not None:
            first = cv2.resize(np.load(depth), surface.shape[::-1], interpolation=cv2.INTER_NEAREST)
            surface &= render.range <= first * 1.02 + 0.1
        mask = surface & (render.seen == 255)
        coverage = float(mask.sum() / max(1, surface.sum()))
        if not mask.any():
            mask = surface if surface.any() else np.ones_like(surface) if allowed is None else allowed > 0
        of = errors(photo, render.rgb, mask)
        yield HeldOut(view, photo, render, mask, of, coverage, **_score(of, photo, render.rgb, mask))


def error_picture(result: HeldOut, *, width: int = 1600) -> U8:
    """Photo, rendering and their difference side by side: (H, W, 3) RGB, at most `width` pixels wide.

    The difference is the mean of the channels', from black (alike) to bright yellow (`SCALE` grey levels or more);
    grey where nothing counts.
    """
    import cv2

    height, wide = result.photo.shape[:2]
    across = max(1, min(wide, (width - 2 * GAP) // 3))
    size = (across, max(1, round(height * across / wide)))

    def small(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))

    counted = small(result.mask.astype(np.float32))
    apart = np.abs(result.photo.astype(np.float32) - result.render.rgb).mean(axis=2) * result.mask
    level = np.clip(small(apart) / np.maximum(counted, 1e-6) * (255 / SCALE), 0, 255).astype(np.uint8)
    coloured = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO))[..., ::-1]
    difference = np.where(counted[..., None] > 0.5, coloured, NOT_COUNTED).astype(np.uint8)
    gap = np.full((size[1], GAP, 3), 255, np.uint8)
    return np.hstack([small(result.photo), gap, small(result.render.rgb), gap, difference])
