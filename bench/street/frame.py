"""Whole frames of held-out photos: what a camera sees in the world beside what it saw in the street.

Every pixel counts, except those of vehicles and people: sky and backdrop, too, and surface that is missing in the
world. Pixels are grouped by the surface that the world shows; where it shows none, by the photo's class (sky, or
anything else, according to the run's segmentation), and by the distance to the surface. A third grouping is by what
the frame shows: surfaces, the backdrop's layers by distance (and those that hide a surface), and sky.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.street import score
from bench.street.world import Photo, Rendering, World
from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.types import F64, I64, U8, Bools
from scan2sim.texturing.ms_ssim import ms_ssim

BAND_EDGES_M = (10.0, 20.0, 40.0)
BAND_NAMES = ("0-10 m", "10-20 m", "20-40 m", "40+ m", "no surface")
NO_SURFACE = ("no surface: sky", "no surface: other")
LAYER_EDGES_M = (20.0, 60.0)
SHOWN = ("surface", "layer 0-20 m", "layer 20-60 m", "layer 60+ m", "layer over surface", "dome: sky", "dome: other")
CLIPPED_LEVEL = 250
"""Grey level of all channels from which a pixel is clipped."""
ROAD_MAX_RANGE_M = 40.0
"""Distance up to which clipped pixels of the ground are counted."""
NEITHER_LEVEL = 128
Sums = dict[str, tuple[int, float]]
"""Pixels and sum of squared errors, by class or distance."""


def metrics(
    photo: Photo, rendering: Rendering, world: World, counts: Bools, gain: F64, sky: Bools
) -> tuple[dict[str, Any], Sums]:
    """Metrics of a frame, and its pixels and squared errors (after the gain) by class and by distance.

    Args:
        photo, rendering: the held-out photo, and the world from its pose.
        world: the world.
        counts: (H, W) pixels that show neither a vehicle nor a person.
        gain: (3,) gain of the photo, solved on the surfaces (`score.solve_gain`).
        sky: (H, W) pixels that show the sky.
    """
    like, whole = (
        score.apply_gain(rendering.whole, g) for g in (gain, score.solve_gain(photo.rgb, rendering.whole, counts))
    )
    found = {
        "shell_frame_psnr_db": score.psnr(score.squared_error(photo.rgb, whole, counts)),
        "frame_psnr_db": score.psnr(score.squared_error(photo.rgb, like, counts)),
        "frame_nogain_psnr_db": score.psnr(score.squared_error(photo.rgb, rendering.whole, counts)),
        "frame_ssim": score.ssim(photo.rgb, like, counts),
        "frame_msssim": ms_ssim(photo.rgb, np.round(like).astype(np.uint8), counts),
        "no_surface": float((~rendering.hit)[counts].mean()),
        **_clipped(photo.rgb, rendering, world, counts),
    }
    squared = ((like - photo.rgb) ** 2).mean(axis=2)
    names = [*dict.fromkeys(world.surfaces), *NO_SURFACE]
    surface = np.array([names.index(name) for name in world.surfaces], np.int64)
    by_class = np.where(rendering.hit, surface[rendering.surface], len(names) - 1 - sky.astype(np.int64))
    by_distance = np.where(rendering.hit, np.digitize(rendering.range, BAND_EDGES_M), len(BAND_NAMES) - 1)
    layer = np.isfinite(rendering.backdrop)
    shown = np.where(layer, 1 + np.digitize(rendering.backdrop, LAYER_EDGES_M), np.where(sky, 5, 6))
    shown = np.where(rendering.hit, np.where(layer, 4, 0), shown)
    groups = ((by_class, names), (by_distance, BAND_NAMES), (shown, SHOWN))
    return found, {k: v for part, of in groups for k, v in _sums(squared, part, counts, of).items()}


def _clipped(photo: U8, rendering: Rendering, world: World, counts: Bools) -> dict[str, float]:
    """Share of clipped pixels of the near ground: in the photo, and rendered without a gain."""
    terrain = np.array([name == "terrain" for name in world.surfaces])
    road = counts & rendering.hit & terrain[rendering.surface] & (rendering.range < ROAD_MAX_RANGE_M)
    return {
        f"clipped_{name}": float((image[road].min(axis=1) >= CLIPPED_LEVEL).mean()) if road.any() else 0.0
        for name, image in (("photo", photo), ("rendered", rendering.rgb))
    }


def clipped_share(photos: Iterable[Mapping[str, float]]) -> float:
    """Rendered minus photographed share of clipped ground, of the worst photo: others are darker than in the world."""
    return max(photo["clipped_rendered"] - photo["clipped_photo"] for photo in photos)


def _sums(squared: F64, part: I64, counts: Bools, names: Sequence[str]) -> Sums:
    pixels = np.bincount(part[counts], minlength=len(names)).tolist()
    errors = np.bincount(part[counts], squared[counts], minlength=len(names)).tolist()
    return {name: (pixels[i], errors[i]) for i, name in enumerate(names)}


def pooled(frames: Sequence[Sums]) -> dict[str, dict[str, float | None]]:
    """Pixels and errors by class, by distance and by what is shown, over all frames.

    Returns:
        `psnr_db` (None without a pixel), `share` of all pixels and `error_share` of the squared error.
    """
    total, squared = (sum(one[name][k] for one in frames for name in BAND_NAMES) for k in (0, 1))
    out = {}
    for name in dict.fromkeys(name for one in frames for name in one):
        pixels, error = (sum(one.get(name, (0, 0.0))[k] for one in frames) for k in (0, 1))
        out[name] = {
            "psnr_db": score.psnr(error / pixels) if pixels else None,
            "share": pixels / max(total, 1),
            "error_share": error / max(squared, 1e-9),
        }
    return out


def sky_pixels(run: Path, photo_index: int, shape: Sequence[int]) -> Bools:
    """(H, W) pixels of a photo that the run's segmentation classified as sky; none if it classified no photos."""
    import cv2

    found = sorted((run / "steps" / "label").glob(f"*/labels/{photo_index}.npy"), key=lambda path: path.stat().st_mtime)
    if not found:
        return np.zeros(tuple(shape[:2]), bool)
    sky = np.load(found[-1]).argmax(axis=2) == PHOTO_CLASSES.index("sky")
    size = (shape[1], shape[0])
    return np.asarray(cv2.resize(sky.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)


def picture(path: Path, photo: U8, whole: U8, counts: Bools) -> None:
    """Write a photo above the whole frame of the world, and their difference; pixels that don't count are pale."""
    from PIL import Image

    apart = np.abs(photo.astype(np.int64) - whole).mean(axis=2, keepdims=True).repeat(3, axis=2)
    shown = (photo, whole, np.clip(2 * apart, 0, 255))
    both = [np.where(counts[..., None], image, image // 3 + 2 * NEITHER_LEVEL // 3) for image in shown]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack(both).astype(np.uint8)).save(path)


def table(found: Mapping[str, Any]) -> None:
    """Print a street's whole frames."""
    print(
        f"  whole frame: {found['frame_psnr_db']:.2f} dB / SSIM {found['frame_ssim']:.3f} / MS-SSIM "
        f"{found['frame_msssim']:.3f}; without gain {found['frame_nogain_psnr_db']:.2f} dB; surfaces alone without "
        f"gain {found['nogain_psnr_db']:.2f} dB; {found['no_surface']:.0%} of the pixels have no surface"
    )
    for name, row in found["frame_parts"].items():
        if row["psnr_db"] is not None:
            print(f"    {name:18}{row['psnr_db']:>6.2f} dB {row['share']:>7.1%} of the pixels", end="")
            print(f" {row.get('error_share', float('nan')):>6.1%} of the error")
    more = clipped_share(found["photos"].values())
    print(
        f"  clipped pixels of the ground: photographed {found['clipped_photo']:.1%}, rendered "
        f"{found['clipped_rendered']:.1%}, in the worst photo {more:+.1%}"
    )
    print(f"  static returns wrongly removed: {found['wrongly_removed']:.2%}")
