"""Whole frames: renderings of a world against all of a held-out photo, not only where the world has a surface.

What a robot's camera sees in the world: surfaces, what is behind them (backdrop), and the sky's colour where nothing
is. Only vehicles and people that the world leaves out are not counted, instance by instance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.types import F32, I64, U8, Bools, Frame, Mesh
from scan2sim.pipeline.dynamic_objects.instance_boxes import boxes, is_parked
from scan2sim.pipeline.io.images import image
from scan2sim.texturing import evaluate
from scan2sim.texturing.ms_ssim import ms_ssim

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Image, Renderer
    from scan2sim.texturing.evaluate import Errors, HeldOut

MOVABLE = tuple(PHOTO_CLASSES.index(name) for name in ("vehicle", "person"))
SKY = PHOTO_CLASSES.index("sky")
NO_SURFACE = ("no surface: sky", "no surface: other")
"""Parts of a frame in which the world has no surface, by what the photo shows; without classes of the photo: other."""
BOX_BEHIND_M = 0.5
"""Metres by which a removed vehicle may be behind the surface that the world shows there: filled ground."""
BEYOND_MEASURED_M = 1.5
"""Metres to which a vehicle or person extends beyond what was measured of it: roofs above the lidar's view."""
PICTURE_WIDTH_PX = 1600
PALE_LEVEL = 210
"""Grey level to which pixels that don't count are blended in pictures."""


@dataclass(frozen=True)
class WholeFrame:
    """A held-out photo and the world as a camera sees it.

    Attributes:
        rgb: (H, W, 3) the rendered frame.
        mask: (H, W) pixels that are counted.
        errors: their errors; the gain is solved on the surfaces (`HeldOut.mask`).
        ms_ssim: multi-scale SSIM after the gain; NaN for photos of less than `ms_ssim.SIDE_MIN_PX`.
        excluded: share of the photo's pixels that show vehicles and people that the world leaves out.
        by_class, by_distance: (H, W) index of each pixel's part: of the world's bodies and then `NO_SURFACE`, and of
            `evaluate.BAND_NAMES` and then "no surface".
    """

    rgb: U8
    mask: Bools
    errors: Errors
    ms_ssim: float
    excluded: float
    by_class: I64
    by_distance: I64


def whole_frame(
    result: HeldOut,
    bodies: int,
    depth: F32,
    labels: U8 | None = None,
    boxes: Renderer | None = None,
    backdrop: Renderer | None = None,
    shown: U8 | None = None,
) -> WholeFrame | None:
    """Score the whole frame of a held-out photo; None if all of it is masked out.

    Args:
        result: the photo and the rendering of the surfaces.
        bodies: number of bodies of the world.
        depth: (h, w) the photo's depth map in metres, of everything that was scanned.
        labels: (h, w, C) probabilities of the photo's classes, if known.
        boxes: boxes of the vehicles and people that the world leaves out (`box_mesh`).
        backdrop: what is behind the surfaces; its `sky` is the colour where nothing is.
        shown: (H, W, 3) another image of the world to score, such as that of its splats; the gain is solved on all.
    """
    from scan2sim.pipeline.camera.models import pixel_angle

    view, render = result.view, result.render
    rgb = render.rgb if shown is None else shown
    if backdrop is not None and shown is None:
        behind = backdrop.view(view.camera, view.T_world_cam, samples=evaluate.RAYS_PER_PIXEL_SIDE)
        rgb = np.where((behind.range < render.range)[..., None], behind.rgb, rgb)
    behind_boxes = None if boxes is None else boxes.view(view.camera, view.T_world_cam)
    excluded = left_out(render, depth, pixel_angle(view.camera), labels, behind_boxes)
    allowed = image.read_mask(view)
    mask = ~excluded if allowed is None else ~excluded & (allowed > 0)
    if not mask.any():
        return None
    if shown is None:
        gain = evaluate.solve_gain(result.photo, render.rgb, result.mask & mask)
    else:
        gain = evaluate.solve_gain(result.photo, shown, mask)
    is_sky = np.zeros(mask.shape, bool) if labels is None else _full_size(labels.argmax(axis=2) == SKY, mask)
    return WholeFrame(
        rgb,
        mask,
        evaluate.errors(result.photo, rgb, mask, gain),
        ms_ssim(result.photo, evaluate.apply_gain(rgb, gain), mask),
        float(excluded.mean()),
        np.where(render.hit, render.body, np.where(is_sky, bodies, bodies + 1)).astype(np.int64),
        np.where(render.hit, np.digitize(render.range, evaluate.BAND_EDGES_M), len(evaluate.BAND_NAMES)),
    )


def left_out(render: Image, depth: F32, pixel: float, labels: U8 | None, boxes: Image | None) -> Bools:
    """(H, W) pixels of a photo that show a vehicle or person that the world leaves out.

    These are boxes of detected instances where the world shows nothing in front of them, and what the network sees as
    vehicle or person within `BEYOND_MEASURED_M` of where it was measured in front of the world's surfaces or lies in
    such a box. Without classes of a network: everything measured in front of the surfaces.

    Args:
        render: rendering of the surfaces.
        depth: (h, w) the photo's depth map, metres.
        pixel: radians that a pixel of the photo spans.
        labels: (h, w, C) probabilities of the photo's classes, or None.
        boxes: rendering of the boxes, or None.
    """
    import cv2

    first = cv2.resize(depth, render.hit.shape[::-1], interpolation=cv2.INTER_NEAREST)
    nearer = ~(render.range <= first * 1.02 + 0.1) & np.isfinite(first)
    in_box = np.zeros_like(nearer) if boxes is None else boxes.hit & (boxes.range < render.range + BOX_BEHIND_M)
    if labels is None:
        return np.asarray(nearer | in_box)
    movable = _full_size(np.isin(labels.argmax(axis=2), MOVABLE), nearer)
    measured = movable & (nearer | in_box)
    if not measured.any():
        return in_box
    away, nearest = cv2.distanceTransformWithLabels(
        (~measured).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    ranges = first if boxes is None else np.where(in_box, np.minimum(first, boxes.range), first)
    range_of = np.zeros(int(nearest.max()) + 1, np.float32)
    range_of[nearest[measured]] = ranges[measured]
    return np.asarray(in_box | (movable & (away * pixel * range_of[nearest] < BEYOND_MEASURED_M)))


def _full_size(values: Bools, like: Bools) -> Bools:
    import cv2

    return np.asarray(cv2.resize(values.astype(np.uint8), like.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def box_mesh(geojson: Path, frame: Frame, *, keep_vehicles: bool) -> Mesh:
    """Boxes of the instances that the world leaves out: people, and vehicles that moved or, unless kept, parked.

    Args:
        geojson: boxes on the ground, from the step `instances`.
        frame: frame of the mesh.
        keep_vehicles: whether parked vehicles are in the world.
    """
    return boxes(geojson, frame, lambda about: not is_parked(about) or not keep_vehicles)


def picture(photo: U8, frame: WholeFrame) -> U8:
    """Photo and whole frame side by side, (H, W, 3), at most `PICTURE_WIDTH_PX` wide; what isn't counted is pale."""
    import cv2

    height, width = photo.shape[:2]
    part = max(1, min(width, (PICTURE_WIDTH_PX - evaluate.ERROR_IMAGE_GAP_PX) // 2))
    size = part, max(1, round(height * part / width))
    pale = [
        np.where(frame.mask[..., None], rgb, rgb // 3 + PALE_LEVEL * 2 // 3).astype(np.uint8)
        for rgb in (photo, frame.rgb)
    ]
    small = [np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8) for rgb in pale]
    return np.hstack([small[0], np.full((size[1], evaluate.ERROR_IMAGE_GAP_PX, 3), 255, np.uint8), small[1]])


def caption(figures: Mapping[str, float | None]) -> str:
    """One sentence about a photo's figures."""
    parts = [f"{figures['psnr_gain_db']:.1f} dB after a gain per channel", f"SSIM {figures['ssim']:.2f}"]
    multi = figures["ms_ssim"]
    parts += [] if multi is None or math.isnan(multi) else [f"MS-SSIM {multi:.2f}"]
    return ", ".join(parts) + "."
