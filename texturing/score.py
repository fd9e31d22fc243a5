"""Score step: compares the textured world with photos held out of texturing, and with ground-truth colours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.parameters import Distance
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, I64, U8, Bools, View
from scan2sim.pipeline.io import sky
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images.album import Album

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Renderer
    from scan2sim.texturing.whole_frame import WholeFrame

SCORE_KEYS = ("psnr_db", "psnr_gain_db", "ssim", "sharpness")
FRAME_KEYS = ("psnr_db", "psnr_gain_db", "ssim", "ms_ssim", "excluded")
"""Figures of whole frames: each photo's, with `frame_` or `splat_frame_` before them, and their means in `frame` and
`splat_frame`."""
EXPOSED_KEY = "psnr_exposed_db"
"""The same, of splats only: PSNR with the exposure of the nearest photos."""
CAMERA_CLEARANCE_M = 1.0
"""Metres around a camera in which there can't have been a surface."""
TRUTH_MAX_DISTANCE_M = 0.1
"""Largest distance between a ground-truth sample and the mesh for it to be compared."""
TRUTH_SAMPLES_MAX = 500_000
"""Maximum number of ground-truth samples that are compared."""


class ScoreParams(Params):
    """Settings of the evaluation.

    Attributes:
        near: largest distance in metres between a ground-truth sample and a photo for `truth_psnr_near_db`.
    """

    near: Distance = 15.0


def score(inputs: Inputs, params: ScoreParams, out: Path, report: Report) -> Done:
    """Compare the textured groups with held-out photos and with ground truth.

    Pixels are counted where another photo saw the surface and this one does, too: not where this photo shows a car or
    a person that the world leaves out (from the depth maps in the folder `depth`). Held-out photos without such pixels
    are scored as well, over other pixels (`evaluate.HeldOut.mask`).

    Whole frames are scored beside (`texturing.whole_frame`): all pixels of the held-out photos count except vehicles
    and people that the world leaves out, `backdrop` (a textured mesh behind the surfaces) and `sky` (colour where
    nothing is) are shown, and `labels` (classes of the photos) distinguish sky from missing surface.
    Splats are shown as simulators show them, with the exposure of the world, and once more with that of the nearest
    photos that aren't held out.

    Files: `error`, a folder with an image of photo, rendering and difference for every held-out photo, and an
    `index.json` of them; `frames`, the same with photo and whole frame; `splat_frames`, the same of `splats`, if given.

    Metrics (None if no pixel is counted):
        held_out: number of photos.
        psnr_db (as rendered), psnr_gain_db (after a gain per channel), ssim, sharpness: means over the photos.
        photos: the same for each photo; `coverage`, 0 if no other photo saw what it shows; `frame_...`, as in `frame`.
        by_class, by_distance: the same over their pixels, without sharpness.
        frame: `psnr_db`, `psnr_gain_db`, `ssim` and `ms_ssim` of whole frames, means over the photos; `excluded`, the
            share of pixels that don't count; `by_class` and `by_distance`. `splat_frame`: the same of the splats,
            and `psnr_exposed_db`, with the exposure of the nearest photos.
        truth_psnr_db, truth_psnr_near_db: for generated tiles.
        cameras: `count`, their number, and `near_m`, the distance in metres to the nearest surface of those within
            `CAMERA_CLEARANCE_M` of one.
        residue_m2: if `instances` are given, surface left of each removed vehicle
            (`pipeline.dynamic_objects.vehicle_residue`).
    """
    from scan2sim.pipeline.camera.renderer import Body, Renderer, textured
    from scan2sim.pipeline.dynamic_objects.vehicle_residue import residue_areas
    from scan2sim.texturing import evaluate
    from scan2sim.texturing.photo_cache import camera_of
    from scan2sim.texturing.splats.view import SplatRenderer
    from scan2sim.texturing.whole_frame import box_mesh, whole_frame

    groups, colour = [g for g in SURFACES if g in inputs], sky.read(inputs.get("sky"))
    world = Renderer([textured(inputs[g]) for g in groups], colour)
    backdrop = Renderer([textured(inputs["backdrop"])], colour) if "backdrop" in inputs else None
    boxes = None
    if "instances" in inputs and world.bodies:
        left_out = box_mesh(inputs["instances"], world.bodies[0].mesh.frame, keep_vehicles="vehicle" in groups)
        boxes = Renderer([Body(left_out)])
    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    index = [i for i, out_ in enumerate(held) if out_]
    depths = [inputs["depth"] / f"{i}.npy" for i in index]
    layer = SplatLayer.load(inputs["splats"]) if "splats" in inputs else SplatLayer.nothing()
    splats = SplatRenderer(layer) if len(layer.splats) else None
    album, frames = Album(out / "error"), Frames("frame", Album(out / "frames"), groups)
    splat_frames = Frames("splat_frame", Album(out / "splat_frames"), groups)
    for one in (album, frames.album, *([splat_frames.album] if splats else [])):
        one.folder.mkdir()
    photos: dict[str, dict[str, float | None]] = {}
    unread = {views[i].name: views[i].photo for i in index}
    index_of = {views[i].name: i for i in index}
    depth_of = dict(zip(index_of, depths, strict=True))
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
        labels = inputs["labels"] / f"{index_of[name]}.npy" if "labels" in inputs else None
        known = np.load(labels) if labels is not None and labels.is_file() else None
        whole = whole_frame(result, len(groups), np.load(depth_of[name]), known, boxes, backdrop)
        if whole is not None:
            photos[name] |= frames.add(f"{i:03d}_{Path(name).name}", name, result.photo, whole)
        if splats is not None and whole is not None:
            camera, pose = result.view.camera, result.view.T_world_cam
            shown = splats.view(camera, pose).rgb
            of_splats = whole_frame(result, len(groups), np.load(depth_of[name]), known, boxes, shown=shown)
            assert of_splats is not None
            photos[name] |= splat_frames.add(f"{i:03d}_{Path(name).name}", name, result.photo, of_splats)
            exposed = splats.view(camera, pose, as_photo=camera_of(result.view)).rgb
            squared = np.square(result.photo.astype(np.float64) - exposed)[of_splats.mask].mean()
            photos[name] |= _rounded({f"splat_frame_{EXPOSED_KEY}": evaluate.psnr(float(squared))})
    for one in (album, frames.album, *([splat_frames.album] if splats else [])):
        one.save()
    warnings += [f"{file}: held out, but not scored: the photo or its mask can't be read" for file in unread.values()]
    metrics: dict[str, Any] = {"held_out": len(photos)}
    metrics |= {key: _mean([figures[key] for figures in photos.values()]) for key in SCORE_KEYS}
    metrics["photos"] = photos
    metrics["by_class"] = {g: _rounded(evaluate.figures(sums)) for g, sums in zip(groups, by_class, strict=True)}
    metrics["by_distance"] = {
        band: _rounded(evaluate.figures(sums)) for band, sums in zip(evaluate.BAND_NAMES, by_distance, strict=True)
    }
    metrics["frame"] = frames.metrics(photos)
    if splats is not None:
        exposed_db = _mean([figures.get(f"splat_frame_{EXPOSED_KEY}") for figures in photos.values()])
        metrics["splat_frame"] = {EXPOSED_KEY: exposed_db} | splat_frames.metrics(photos)
    if "truth.points" in inputs:
        report(0.9, "comparing with ground-truth colours")
        metrics |= _truth(inputs, world, params)
    metrics["cameras"] = _cameras(world, views)
    if "instances" in inputs:
        others = [body.mesh for group, body in zip(groups, world.bodies, strict=True) if group != "vehicle"]
        left = residue_areas(others, inputs["instances"])
        metrics["residue_m2"] = [round(area, 2) for area in left]
    files = {"error": album.folder, "frames": frames.album.folder}
    files |= {"splat_frames": splat_frames.album.folder} if splats is not None else {}
    return Done(files, metrics, warnings)


class Frames:
    """Whole frames of the held-out photos: their figures, and an album.

    Args:
        kind: what they are called in the figures of a photo.
        album: receives an image of each.
        groups: names of the world's bodies.
    """

    def __init__(self, kind: str, album: Album, groups: Sequence[str]) -> None:
        from scan2sim.texturing.evaluate import BAND_NAMES
        from scan2sim.texturing.whole_frame import NO_SURFACE

        self.album, self._kind = album, kind
        self._names = {"by_class": [*groups, *NO_SURFACE], "by_distance": [*BAND_NAMES, "no surface"]}
        self._sums = {kind: np.zeros((len(names), 5)) for kind, names in self._names.items()}

    def add(self, file: str, name: str, photo: U8, frame: WholeFrame) -> dict[str, float | None]:
        """Add a photo's frame; returns its figures."""
        from scan2sim.texturing import evaluate, whole_frame

        for kind, sums in self._sums.items():
            sums += evaluate.tally(frame.errors, getattr(frame, kind), len(sums))
        whole = evaluate.figures(evaluate.tally(frame.errors, np.zeros(frame.mask.shape, np.int64), 1)[0])
        own = {key: whole[key] for key in ("psnr_db", "psnr_gain_db", "ssim")}
        own |= {"ms_ssim": frame.ms_ssim, "excluded": frame.excluded}
        figures = _rounded(own)
        self.album.add(file, whole_frame.picture(photo, frame), self._kind, name, whole_frame.caption(figures))
        return {f"{self._kind}_{key}": value for key, value in figures.items()}

    def metrics(self, photos: Mapping[str, Mapping[str, float | None]]) -> dict[str, Any]:
        """Means over the photos, and figures by class and by distance."""
        from scan2sim.texturing import evaluate

        means = {key: _mean([one.get(f"{self._kind}_{key}") for one in photos.values()]) for key in FRAME_KEYS}
        return means | {
            kind: {name: _rounded(evaluate.figures(row)) for name, row in zip(names, self._sums[kind], strict=True)}
            for kind, names in self._names.items()
        }


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
    truth = truth.take(slice(None, None, max(1, len(truth) // TRUTH_SAMPLES_MAX)))
    assert truth.rgb is not None
    rgb, seen, distance = world.nearest(truth.xyz)
    squared = ((rgb.astype(np.float64) - truth.rgb) ** 2).mean(axis=1)
    counted = (seen == 255) & (distance < TRUTH_MAX_DISTANCE_M)
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


SCORE = Step("score", 7, score, ScoreParams, memory=(1.3, 3))
