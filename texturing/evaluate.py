"""How good a texture is: renderings against photos that were held out of texturing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pipeline.types import U8

if TYPE_CHECKING:
    from pipeline.render import Image
    from pipeline.types import View

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class HeldOut:
    """A photo that was held out, and how it was met.

    Attributes:
        view: posed photo.
        photo, render: (H, W, 3) uint8 RGB.
        mask: (H, W) pixels that count: a surface that another photo saw, hidden from this one by nothing that
            the world leaves out (a parked car), and not masked out.
        coverage: share of the pixels with a surface that another photo saw.
        psnr_db, psnr_gain_db, ssim: see `score`.
    """

    view: View
    photo: U8
    render: Image
    mask: Mask
    coverage: float
    psnr_db: float
    psnr_gain_db: float
    ssim: float


def score(photo: U8, render: U8, mask: Mask) -> dict[str, float]:
    """Likeness of a rendering to a photo where `mask` (H, W) holds.

    Returns:
        psnr_db: as it is; psnr_gain_db: after the least-squares gain of each channel; ssim: mean structural
        similarity of the grey images (Wang et al. 2004), where the window lies mostly in the mask; NaN for an
        empty mask.
    """
    if not mask.any():
        return {"psnr_db": float("nan"), "psnr_gain_db": float("nan"), "ssim": float("nan")}
    a, b = photo[mask].astype(np.float64), render[mask].astype(np.float64)
    gain = (a * b).sum(axis=0) / np.maximum((b * b).sum(axis=0), 1.0)
    return {
        "psnr_db": _psnr(a, b),
        "psnr_gain_db": _psnr(a, np.clip(b * gain, 0, 255)),
        "ssim": _ssim(photo, render, mask),
    }


def _psnr(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> float:
    return float(10 * np.log10(255**2 / max(float(((a - b) ** 2).mean()), 1e-3)))


def _ssim(photo: U8, render: U8, mask: Mask) -> float:
    """Gaussian windows of sigma 1.5; pixels outside the mask have no say in them."""
    import cv2

    def blur(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        return np.asarray(cv2.GaussianBlur(image, (11, 11), 1.5), np.float32)

    m = mask.astype(np.float32)
    weight = blur(m)
    x, y = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) * m for image in (photo, render))
    scale = 1 / np.maximum(weight, 1e-6)
    mx, my = blur(x) * scale, blur(y) * scale
    vx, vy, cov = blur(x * x) * scale - mx * mx, blur(y * y) * scale - my * my, blur(x * y) * scale - mx * my
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    index = (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    inner = mask & (weight > 0.5)
    return float(index[inner].mean()) if inner.any() else float("nan")


def held_out(folders: Sequence[Path], views: Sequence[View], depths: Sequence[Path] | None = None) -> Iterator[HeldOut]:
    """Render textured meshes from each of the views, and score; unreadable photos are skipped.

    Args:
        folders: of the step `texture`.
        views: held out.
        depths: files of the views' depth maps, which tell where a photo shows something that the world leaves
            out; None: every pixel with a surface counts.
    """
    import cv2

    from pipeline.io import image
    from pipeline.render import Renderer, textured
    from texturing.texture import read_mask

    renderer = Renderer([textured(folder) for folder in folders])
    files: list[Path | None] = list(depths) if depths is not None else [None] * len(views)
    for view, depth in zip(views, files, strict=True):
        photo = image.read_rgb(view.photo)
        if photo is None or photo.shape[:2] != (view.camera.height, view.camera.width):
            continue
        render = renderer.view(view.camera, view.T_world_cam)
        allowed = read_mask(view) if view.mask is not None else None
        surface = render.hit if allowed is None else render.hit & (allowed > 0)
        if depth is not None:
            first = cv2.resize(np.load(depth), surface.shape[::-1], interpolation=cv2.INTER_NEAREST)
            surface &= render.range <= first * 1.02 + 0.1
        mask = surface & (render.seen == 255)
        coverage = float(mask.sum() / max(1, surface.sum()))
        yield HeldOut(view, photo, render, mask, coverage, **score(photo, render.rgb, mask))
