"""Score: the textured world against photos held out of texturing, and against the true colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.parameters import Reach
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, I64, Bools, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.steps.pictures import Album

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Renderer

FIGURES = ("psnr_db", "psnr_gain_db", "ssim", "sharpness")
CLEARANCE = 1.0
"""Metres about a camera in which nothing can have been."""


class ScoreParams(Params):
    """How closely is looked.

    Attributes:
        truth_reach: metres from a true surface sample within which the mesh stands for it.
        truth_samples: true samples that are compared, at most.
        near: metres from a photo within which a true sample is near to it (`truth_psnr_near_db`).
    """

    truth_reach: Reach = 0.1
    truth_samples: int = Field(500_000, ge=1000, le=20_000_000)
    near: Reach = 15.0


def score(inputs: Inputs, params: ScoreParams, out: Path, report: Report) -> Done:
    """Compare the textured groups with held-out photos and with the truth.

    Pixels count where another photo saw the surface, and where this one does: not where it shows a car or
    person that the world leaves out (`depth`, the folder of depth maps, tells).

    Held-out photos that show nothing of that count all the same, as what they are (`evaluate.HeldOut`).

    File: `error`, a folder with a picture of photo, rendering and difference for every held-out photo, and
    `index.json`, which names them. Facts, None where nothing counts: `held_out` photos; their mean `psnr_db` (as it
    is), `psnr_gain_db` (after a gain a channel), `ssim` and `sharpness`; `photos`, the same for each, and `coverage`,
    0 where no other photo saw anything of what it shows; `by_class` and `by_distance`, the same but sharpness of all
    their pixels; `truth_psnr_db` and `truth_psnr_near_db` for generated tiles; `cameras`: how many there are
    (`count`), and metres to the nearest surface for those that are within `CLEARANCE` of one (`near_m`). Where `things`
    are listed, `remains_m2`: surface left of each vehicle that was taken out
    (`pipeline.dynamic_objects.vehicle_residue`).
    """
    from scan2sim.pipeline.camera.renderer import Renderer, textured
    from scan2sim.pipeline.dynamic_objects.vehicle_residue import left_of_vehicles
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
            warnings.append(f"{name}: held out, but all of it is masked out: it is not scored")
            continue
        photos[name] = _rounded({key: getattr(result, key) for key in (*FIGURES, "coverage")})
        by_class += evaluate.tally(result.errors, result.render.body, len(by_class))
        by_distance += evaluate.tally(result.errors, _band(result.render.range), len(by_distance))
        picture, caption = evaluate.error_picture(result), _caption(photos[name])
        album.add(f"{i:03d}_{Path(name).name}", picture, "error", name, caption)
    album.save()
    warnings += [f"{file}: held out, but it or its mask can't be read: it is not scored" for file in unread.values()]
    facts: dict[str, Any] = {"held_out": len(photos)}
    facts |= {key: _mean([figures[key] for figures in photos.values()]) for key in FIGURES}
    facts["photos"] = photos
    facts["by_class"] = {g: _rounded(evaluate.figures(sums)) for g, sums in zip(groups, by_class, strict=True)}
    facts["by_distance"] = {
        band: _rounded(evaluate.figures(sums)) for band, sums in zip(evaluate.BAND_NAMES, by_distance, strict=True)
    }
    if "truth.points" in inputs:
        report(0.9, "true colours")
        facts |= _truth(inputs, world, params)
    facts["cameras"] = _cameras(world, views)
    if "things" in inputs:
        others = [body.mesh for group, body in zip(groups, world.bodies, strict=True) if group != "vehicle"]
        left = left_of_vehicles(others, inputs["things"])
        facts["remains_m2"] = [round(area, 2) for area in left]
    return Done({"error": album.folder}, facts, warnings)


def _rounded(figures: dict[str, Any]) -> dict[str, Any]:
    """Figures as JSON takes them: None for NaN."""
    return {name: None if math.isnan(value) else round(value, 4) for name, value in figures.items()}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(sum(known) / len(known), 4) if known else None


def _caption(figures: dict[str, float | None]) -> str:
    gain, ssim, sharp = figures["psnr_gain_db"], figures["ssim"], figures["sharpness"]
    parts = [f"{gain:.1f} dB after a gain a channel"]
    parts += [f"SSIM {ssim:.2f}"] if ssim is not None else []
    parts += [f"{100 * sharp:.0f} % as sharp"] if sharp is not None else []
    return ", ".join(parts) + "."


def _band(distance: F32) -> I64:
    """(H, W) which band a pixel is in, -1 where there is no surface."""
    from scan2sim.texturing.evaluate import BANDS

    return np.where(np.isfinite(distance), np.digitize(distance, BANDS), -1)


def _cameras(world: Renderer, views: Sequence[View]) -> dict[str, Any]:
    """How many photos there are, and those taken within `CLEARANCE` of a surface, nearest first."""
    taken = [view for view in views if view.camera.model != "orthographic"]  # orthophotos were taken from nowhere
    centres = np.array([view.centre for view in taken], np.float32).reshape(-1, 3)
    places, _ = world.nearest_places(centres)
    metres = {v.name: float(m) for v, m in zip(taken, np.linalg.norm(places - centres, axis=1), strict=True)}
    near = sorted((name for name, m in metres.items() if m < CLEARANCE), key=lambda name: metres[name])
    return {"count": len(taken), "near_m": {name: round(metres[name], 2) for name in near}}


def _truth(inputs: Inputs, world: Renderer, params: ScoreParams) -> dict[str, float | None]:
    """PSNR of the texture against the true surface colours: where a photo saw it, and where one saw it from near.

    None where none did.
    """
    from scan2sim.pipeline.io.clouds import las
    from scan2sim.texturing.evaluate import psnr

    truth = las.read(inputs["truth.points"], world.bodies[0].mesh.frame)
    truth = truth.take(slice(None, None, max(1, len(truth) // params.truth_samples)))
    assert truth.rgb is not None
    rgb, seen, distance = world.nearest(truth.xyz)
    squared = ((rgb.astype(np.float64) - truth.rgb) ** 2).mean(axis=1)
    counts = (seen == 255) & (distance < params.truth_reach)
    near = counts.copy()
    near[counts] = _seen_from_near(inputs, *world.nearest_places(truth.xyz[counts]), params.near)

    def over(chosen: Bools) -> float | None:
        return round(psnr(float(squared[chosen].mean())), 2) if chosen.any() else None

    return {"truth_psnr_db": over(counts), "truth_psnr_near_db": over(near)}


def _seen_from_near(inputs: Inputs, places: F32, normals: F32, near: float) -> Bools:
    """(N,) which places (N, 3) on the meshes a photo that was not held out sees from `near` metres or nearer."""
    from scan2sim.pipeline.camera.depth_map import load_depth_map, visible

    seen = np.zeros(len(places), bool)
    for i, (view, held) in enumerate(
        zip(views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"]), strict=True)
    ):
        unseen = np.flatnonzero(~seen & (np.linalg.norm(places - view.centre, axis=1) <= near))
        if len(unseen) and not held:
            depth = load_depth_map(inputs["depth"] / f"{i}.npy", view.camera, view.T_world_cam)
            seen[unseen] = visible(depth, places[unseen], normals[unseen])
    return seen


SCORE = Step("score", 4, score, ScoreParams, side_product=True, memory=(1.3, 3))
