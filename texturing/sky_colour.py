"""Step `sky_colour`: the colour of a world where it shows nothing, from its photos.

What a camera saw there is the sky, and trees, roofs and houses in the distance or above the lidar's view. By default
the colour is the mean of all of it, the constant with the least error; or it is the median of the sky alone. Either is
in the exposure of the world (step `exposure`), so that one colour fits photos of different exposure. Only pixels above
the horizon count: below it are holes in the surface.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, F64, U8, View
from scan2sim.pipeline.io import sky as sky_io
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.texturing.photo_cache import Exposures

SAMPLES_PER_PHOTO = 20_000
"""Pixels of a photo that are sampled, evenly, at most."""
PIXELS_SHARE_MIN = 0.001
"""Share of a photo's pixels that must show it for the photo to count."""


class SkyColourParams(Params):
    """Colour of the background.

    Attributes:
        source: "empty", mean of everything that photos show above the horizon where the world has no surface: sky,
            trees and roofs in the distance; "sky", median of the sky alone.
    """

    source: Literal["empty", "sky"] = "empty"


def sky_colour(inputs: Inputs, params: SkyColourParams, out: Path, report: Report) -> Done:
    """Colour of the background over all photos that are not held out.

    Inputs: `views`, `depth` (folder of depth maps), `exposures`, and optionally `labels` (of step `label`): sky is what
    the network classified as sky; otherwise smooth, bright and bluish pixels (`texturing.sky`).
    File: `sky`, JSON with `rgb`, three values from 0 to 255 (sRGB), or null if no photo shows it.
    Metrics: `rgb`, and `photos`, the number of photos that show it.
    """
    from scan2sim.texturing.photo_cache import Exposures

    views, held_out = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    exposures = Exposures.load(inputs["exposures"])
    samples: list[F64] = []
    for i, view in enumerate(views):
        report(i / len(views), view.name)
        photo = None if held_out[i] or view.camera.model == "orthographic" else image.usable_photo(view)
        if photo is None:
            continue
        pixels = _empty_pixels(view, photo, np.load(inputs["depth"] / f"{i}.npy"))
        if params.source == "sky":
            labels = inputs["labels"] / f"{i}.npy" if "labels" in inputs else None
            pixels = _sky_pixels(photo, pixels, np.load(labels) if labels is not None and labels.is_file() else None)
        if pixels.mean() >= PIXELS_SHARE_MIN:
            colours = photo[pixels > 0]
            samples.append(_in_world_exposure(colours[:: len(colours) // SAMPLES_PER_PHOTO + 1], exposures, view))
    rgb = None
    if samples:
        average = np.mean if params.source == "empty" else np.median
        rgb = average(np.concatenate(samples), axis=0).round().astype(int).tolist()
    sky_io.write(out / "sky.json", rgb and (rgb[0], rgb[1], rgb[2]))
    return Done({"sky": out / "sky.json"}, {"rgb": rgb, "photos": len(samples)})


def _empty_pixels(view: View, photo: U8, depth: F32) -> U8:
    """(H, W) 1 where a photo looks above the horizon and no surface was measured."""
    empty = _full_size((~np.isfinite(depth)).astype(np.uint8), photo) & _full_size(_above_horizon(view), photo)
    allowed = image.read_mask(view)
    return empty if allowed is None else empty & (allowed > 0).astype(np.uint8)


def _sky_pixels(photo: U8, empty: U8, labels: U8 | None) -> U8:
    """(H, W) 1 where a photo shows the sky; `labels` (h, w, C) are probabilities by class, if known."""
    from scan2sim.texturing.sky import sky_seeds

    if labels is None:
        return sky_seeds(photo, empty)
    return _full_size((labels.argmax(axis=2) == PHOTO_CLASSES.index("sky")).astype(np.uint8), photo) & empty


def _full_size(values: U8, photo: U8) -> U8:
    import cv2

    return np.asarray(cv2.resize(values, photo.shape[1::-1], interpolation=cv2.INTER_NEAREST), np.uint8)


def _above_horizon(view: View) -> U8:
    """(h, w) of about 100 pixels in width: 1 where the photo looks above the horizon."""
    from scan2sim.pipeline.camera.models import unproject

    small = view.camera.scaled(100 / max(view.camera.width, 100))
    row, column = np.mgrid[: small.height, : small.width]
    up = unproject(small, np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)) @ view.T_world_cam[2, :3]
    return (up.reshape(row.shape) > 0).astype(np.uint8)  # NaN, outside of a fisheye's image: False


def _in_world_exposure(colours: U8, exposures: Exposures, view: View) -> F64:
    """Colours (N, 3) of a photo after its gain, 0 to 255; vignetting is left out."""
    from scan2sim.texturing.photo_cache import SRGB_OFFSET

    factor = np.exp(exposures.of(view)[:3])
    return np.asarray(np.clip((colours + SRGB_OFFSET) * factor - SRGB_OFFSET, 0, 255), np.float64)


SKY_COLOUR = Step("sky_colour", 1, sky_colour, SkyColourParams)
