"""Score step: compares the textured world with photos held out of texturing, and with ground-truth colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.parameters import Distance
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, I64, Bools, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images.album import Album

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Renderer

SCORE_KEYS = ("psnr_db", "psnr_gain_db", "ssim", "sharpness")
CAMERA_CLEARANCE_M = 1.0
"""Metres around a camera in which there can't have been a surface."""


class ScoreParams(Params):
    """Settings of the evaluation.

    Attributes:
        truth_max_distance: largest distance in metres between a ground-truth sample and the mesh for it to be compared.
        truth_samples: maximum number of ground-truth samples that are compared.
        near: largest distance in metres between a ground-truth sample and a photo for `truth_psnr_near_db`.
    """

    truth_max_distance: Distance = 0.1
    truth_samples: int = Field(500_000, ge=1000, le=20_000_000)
    near: Distance = 15.0


def score(inputs: Inputs, params: ScoreParams, out: Path, report: Report) -> Done:
    """Compare the textured groups with held-out photos and with ground truth.

    Pixels are counted where another photo saw the surface and this one does, too: not where this photo shows a car or
    a person that the world leaves out (from the depth maps in the folder `depth`). Held-out photos without such pixels
    are scored as well, over other pixels (`evaluate.HeldOut.mask`).

    File: `error`, a folder with an image of photo, rendering and difference for every held-out photo, and an
    `index.json` of them. Metrics (None if no pixel is counted): `held_out`, number of photos; means over the photos of
    `psnr_db` (as rendered), `psnr_gain_db` (after a gain per channel), `ssim` and `sharpness`; `photos`, the same for
    each photo, and `coverage`, 0 if no other photo saw what it shows; `by_class` and `by_distance`, the same over
    their pixels, without sharpness; `truth_psnr_db` and `truth_psnr_near_db` for generated tiles; `cameras`, their
    number (`count`) and the distance in metres to the nearest surface of those within `CAMERA_CLEARANCE_M` of one
    (`near_m`). If `instances` are given, `residue_m2`: surface left of each removed vehicle
    (`pipeline.dynamic_objects.vehicle_residue`).
    """
    from scan2sim.pipeline.camera.renderer import Renderer, textured
    from scan2sim.pipeline.dynamic_objects.vehicle_residue import residue_areas
    from scan2sim.texturing import evaluate

    groups = [g for g in SURFACES if g in inputs]
    world = Renderer([textured(inputs[g]) for g in groups])
    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    index = [i for i, out_ in enumerate(held) if out_]
    depths = [inputs["depth"] / f"{i}.npy" for i in index]
    album = Album(out / "error")
    album.folder.mkdir()
    photos: dict[str, dict[str, float | None]] = {}
    unread = {views[i].name: views[i].photo for i in index}
    warnings: list[str] = []
    by_class, by_distance = np.zeros((len(groups), 5)), np.zeros((len(evaluate.BAND_NAMES), 5))
    results = evaluate.held_out(world, [views[i] for i in index], depths) if index else ()
    for i, result in enumerate(results):
        name = result.view.name
        report(0.9 * i / len(index), name)
        del unread[name]
        if not result.mask.any():
            warnings.append(f"{name}: held out, but not scored: all of it is masked out")
            continue
        photos[name] = _rounded({key: getattr(result, key) for key in (*SCORE_KEYS, "coverage")})
        by_class += evaluate.tally(result.errors, result.render.body, len(by_class))
        by_distance += evaluate.tally(result.errors, _band(result.render.range), len(by_distance))
        error_image, caption = evaluate.error_image(result), _caption(photos[name])
        album.add(f"{i:03d}_{Path(name).name}", error_image, "error", name, caption)
    album.save()
    warnings += [f"{file}: held out, but not scored: the photo or its mask can't be read" for file in unread.values()]
    metrics: dict[str, Any] = {"held_out": len(photos)}
    metrics |= {key: _mean([figures[key] for figures in photos.values()]) for key in SCORE_KEYS}
    metrics["photos"] = photos
    metrics["by_class"] = {g: _rounded(evaluate.figures(sums)) for g, sums in zip(groups, by_class, strict=True)}
    metrics["by_distance"] = {
        band: _rounded(evaluate.figures(sums)) for band, sums in zip(evaluate.BAND_NAMES, by_distance, strict=True)
    }
    if "truth.points" in inputs:
        report(0.9, "comparing with ground-truth colours")
        metrics |= _truth(inputs, world, params)
    metrics["cameras"] = _cameras(world, views)
    if "instances" in inputs:
        others = [body.mesh for group, body in zip(groups, world.bodies, strict=True) if group != "vehicle"]
        left = residue_areas(others, inputs["instances"])
        metrics["residue_m2"] = [round(area, 2) for area in left]
    return Done({"error": album.folder}, metrics, warnings)


def _rounded(figures: dict[str, Any]) -> dict[str, Any]:
    """Figures for JSON: rounded, None for NaN."""
    return {name: None if math.isnan(value) else round(value, 4) for name, value in figures.items()}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(sum(known) / len(known), 4) if known else None


def _caption(figures: dict[str, float | None]) -> str:
    gain, ssim, sharp = figures["psnr_gain_db"], figures["ssim"], figures["sharpness"]
    parts = [f"{gain:.1f} dB after a gain per channel"]
    parts += [f"SSIM {ssim:.2f}"] if ssim is not None else []
    parts += [f"{100 * sharp:.0f} % as sharp"] if sharp is not None else []
    return ", ".join(parts) + "."


def _band(distance: F32) -> I64:
    """(H, W) index of each pixel's distance band, -1 where there is no surface."""
    from scan2sim.texturing.evaluate import BAND_EDGES_M

    return np.where(np.isfinite(distance), np.digitize(distance, BAND_EDGES_M), -1)


def _cameras(world: Renderer, views: Sequence[View]) -> dict[str, Any]:
    """Number of photos, and distances of those taken within `CAMERA_CLEARANCE_M` of a surface, nearest first."""
    photos = [view for view in views if view.camera.model != "orthographic"]  # orthophotos have no camera position
    centres = np.array([view.centre for view in photos], np.float32).reshape(-1, 3)
    nearest, _ = world.closest_points(centres)
    metres = {v.name: float(m) for v, m in zip(photos, np.linalg.norm(nearest - centres, axis=1), strict=True)}
    near = sorted((name for name, m in metres.items() if m < CAMERA_CLEARANCE_M), key=lambda name: metres[name])
    return {"count": len(photos), "near_m": {name: round(metres[name], 2) for name in near}}


def _truth(inputs: Inputs, world: Renderer, params: ScoreParams) -> dict[str, float | None]:
    """PSNR of the texture against ground-truth colours, where any photo and where a near photo saw the surface.

    None where no photo did.
    """
    from scan2sim.pipeline.io.clouds import las
    from scan2sim.texturing.evaluate import psnr

    truth = las.read(inputs["truth.points"], world.bodies[0].mesh.frame)
    truth = truth.take(slice(None, None, max(1, len(truth) // params.truth_samples)))
    assert truth.rgb is not None
    rgb, seen, distance = world.nearest(truth.xyz)
    squared = ((rgb.astype(np.float64) - truth.rgb) ** 2).mean(axis=1)
    counted = (seen == 255) & (distance < params.truth_max_distance)
    near = counted.copy()
    near[counted] = _seen_from_near(inputs, *world.closest_points(truth.xyz[counted]), params.near)

    def over(chosen: Bools) -> float | None:
        return round(psnr(float(squared[chosen].mean())), 2) if chosen.any() else None

    return {"truth_psnr_db": over(counted), "truth_psnr_near_db": over(near)}


def _seen_from_near(inputs: Inputs, points: F32, normals: F32, near: float) -> Bools:
    """(N,) which points (N, 3) on the meshes are seen from within `near` metres by a photo that is not held out."""
    from scan2sim.pipeline.camera.depth_map import load_depth_map, visible

    seen = np.zeros(len(points), bool)
    for i, (view, held) in enumerate(
        zip(views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"]), strict=True)
    ):
        unseen = np.flatnonzero(~seen & (np.linalg.norm(points - view.centre, axis=1) <= near))
        if len(unseen) and not held:
            depth = load_depth_map(inputs["depth"] / f"{i}.npy", view.camera, view.T_world_cam)
            seen[unseen] = visible(depth, points[unseen], normals[unseen])
    return seen


SCORE = Step("score", 4, score, ScoreParams, side_product=True, memory=(1.3, 3))
