"""Effect of pose refinement: on a street with known poses, and on two real ones.

`python -m bench.texture.pose_refinement [--parts synthetic raw0009 odo04] [--out bench-out/refine]`

- synthetic: 40 m of the synthetic street with front and side cameras and panoramas; poses of the photos are disturbed
  by 3 cm and 2 mrad each, and each camera by 5 cm and 5 mrad (lengths of random vectors). Errors in pixels: `absolute`,
  the displacement of surface points within 20 m relative to the truth; `between`, the relative displacement of the same
  point in two successive photos, which blurs textures. With true poses nothing may move.
- raw0009, odo04: the real streets of `bench.street` without and with the step `pose_refinement`, scored by that
  benchmark: held-out photos, and their outlines.

Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.paths import ROOT
from bench.street import run as street
from bench.texture.scenes import Scene, fresh, make
from scan2sim.pipeline.camera.depth_map import DepthMap, depth_map, scene, visible
from scan2sim.pipeline.camera.models import unproject
from scan2sim.pipeline.camera.projection import pixels
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, Mesh, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.photo_prediction import surface
from scan2sim.texturing.pose_refinement.step import PoseRefinementParams, group_by_camera, pose_refinement

PARTS = ("synthetic", "raw0009", "odo04")
PHOTO_ERROR, CAMERA_ERROR = (0.002, 0.03), (0.005, 0.05)
"""Disturbances of each photo and of each camera: radians and metres."""
MAX_RANGE_M, SAMPLES, DEPTH_MAP_PIXELS = 20.0, 4000, 200_000


def disturbed(views: Sequence[View], rng: np.random.Generator) -> list[View]:
    """Views with poses disturbed by an error of each photo and one of its camera."""

    def random_errors(count: int, lengths: tuple[float, float]) -> tuple[F64, F64]:
        ways = rng.normal(size=(2, count, 3))
        turn, shift = ways / np.linalg.norm(ways, axis=2, keepdims=True)
        return turn * lengths[0], shift * lengths[1]

    names, camera = group_by_camera(views)
    turn, shift = (
        own + lens[camera]
        for own, lens in zip(
            random_errors(len(views), PHOTO_ERROR), random_errors(len(names), CAMERA_ERROR), strict=True
        )
    )
    out = []
    for k, view in enumerate(views):
        T = view.T_world_cam.copy()
        T[:3, 3] += T[:3, :3] @ shift[k]
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(turn[k]).as_matrix()
        out.append(replace(view, T_world_cam=T))
    return out


def errors(views: Sequence[View], truth: Sequence[View], maps: Sequence[DepthMap]) -> dict[str, float]:
    """Median pixel displacements relative to the true poses, see the module's docstring."""
    rng = np.random.default_rng(0)
    absolute: list[F64] = []
    between: list[F64] = []
    for k, (view, true, depth) in enumerate(zip(views, truth, maps, strict=True)):
        shown = surface(depth.camera, depth)
        samples, normal = shown.sample(SAMPLES, MAX_RANGE_M, rng)
        absolute.append(np.linalg.norm(_pixels(view, samples) - _pixels(true, samples), axis=1))
        ray = unproject(view.camera, _pixels(true, samples)) @ view.T_world_cam[:3, :3].T
        far = np.einsum("ij,ij->i", samples - view.centre, normal) / np.einsum("ij,ij->i", ray, normal)
        taken = view.centre + ray * far[:, None]  # position of the photo's content according to these poses
        for j in (k - 1, k + 1):
            if 0 <= j < len(views):
                seen = visible(maps[j], samples, normal)
                off = _pixels(views[j], taken[seen]) - _pixels(truth[j], samples[seen])
                between.append(np.linalg.norm(off, axis=1))
    return {
        "absolute": float(np.nanmedian(np.concatenate(absolute))),
        "between": float(np.nanmedian(np.concatenate(between))),
    }


def _pixels(view: View, samples: F64) -> F64:
    """(N, 2) pixels of points in a photo; NaN outside of it."""
    uv, shown = pixels(view.camera, view.T_world_cam, samples)
    return np.where(shown[:, None], uv, np.nan).astype(np.float64)


def synthetic(folder: Path) -> dict[str, Any]:
    """Refine disturbed poses of the synthetic street."""
    made = Scene(folder / "street_clean")
    if not made.views.is_file():
        make("street_clean", made)
    truth, held = views_io.load(made.views), views_io.load_held_out(made.views)
    hides = scene([Mesh.load(made.mesh)], PointCloud.join([PointCloud.load(path) for path in made.clouds.values()]))
    maps = [depth_map(v.camera, v.T_world_cam, hides, time=v.time, pixels=DEPTH_MAP_PIXELS) for v in truth]
    scan = {"mesh.surface": made.mesh} | {k: path for k, path in made.clouds.items() if k == "cloud.rest"}

    settings = PoseRefinementParams.of("pose_refinement", {})

    def refined(views: Sequence[View]) -> tuple[tuple[View, ...], dict[str, Any], float]:
        out = fresh(folder / "refined")
        views_io.save(folder / "views.json", views, held)
        start = time.perf_counter()
        done = pose_refinement({"views": folder / "views.json", **scan}, settings, out, silent)
        return views_io.load(done.files["views"]), done.metrics, time.perf_counter() - start

    refined(truth)  # warm up: compile kernels
    _, still, _ = refined(truth)
    wrong = disturbed(truth, np.random.default_rng(0))
    found, facts, seconds = refined(wrong)
    before, after = errors(wrong, truth, maps), errors(found, truth, maps)
    print(
        f"synthetic, {len(truth)} photos, pixels: between {before['between']:.2f} -> {after['between']:.2f}, ", end=""
    )
    print(f"absolute {before['absolute']:.2f} -> {after['absolute']:.2f}; {seconds:.1f} s")
    return {
        "between_before_px": before["between"], "between_after_px": after["between"],
        "absolute_before_px": before["absolute"], "absolute_after_px": after["absolute"],
        "matches_before_px": facts["displaced_px"], "matches_after_px": facts.get("displaced_after_px"),
        "true_poses_moved": still["moved"], "seconds": seconds,
    }  # fmt: skip


def real(name: str, folder: Path) -> dict[str, Any]:
    """Compare a real street without and with refined poses."""
    metrics = {}
    for when in ("never", "auto"):
        at = folder / name / when
        if when == "auto" and not at.is_dir():
            shutil.copytree(folder / name / "never", at, symlinks=True)  # reuse identical results
        tile, run = street.build_world(street.STREETS[name], at, (f"pose_refinement.when={when}",))
        metrics[when] = street.score_world(street.STREETS[name], tile, run, folder / "pictures" / f"{name}_{when}")
    refined = json.loads((run / "report.json").read_text(encoding="utf-8"))["steps"]["pose_refinement"]
    return compare(name, metrics, refined)


def compare(name: str, metrics: dict[str, dict[str, Any]], refined: dict[str, Any]) -> dict[str, Any]:
    """Metrics of both worlds of a street, and of the step."""
    never, auto = metrics["never"], metrics["auto"]
    outlines = {when: float(np.median(f["displacements_px"])) for when, f in metrics.items()}
    facts = refined["metrics"]
    print(
        f"{name}: matches {facts['displaced_px']:.2f} -> {facts.get('displaced_after_px')} pixels; held-out photos ",
        end="",
    )
    print(
        f"{never['psnr_db']:.2f} -> {auto['psnr_db']:.2f} dB, SSIM {never['ssim']:.3f} -> {auto['ssim']:.3f}; ", end=""
    )
    print(f"outlines {outlines['never']:.2f} -> {outlines['auto']:.2f} pixels; {refined['seconds']:.1f} s")
    return {
        "matches_before_px": facts["displaced_px"], "matches_after_px": facts.get("displaced_after_px"),
        "psnr_before_db": never["psnr_db"], "psnr_after_db": auto["psnr_db"],
        "ssim_before": never["ssim"], "ssim_after": auto["ssim"],
        "outline_before_px": outlines["never"], "outline_after_px": outlines["auto"], "seconds": refined["seconds"],
    }  # fmt: skip


def main() -> None:
    """Run the parts, print a line for each, and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "pose_refinement")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = {}
    for part in arguments.parts:
        if part != "synthetic" and not street.STREETS[part].data.is_dir():
            print(f"{part}: skipped, {street.STREETS[part].data} doesn't exist")
            continue
        metrics = synthetic(arguments.out) if part == "synthetic" else real(part, arguments.out)
        found |= {f"{part}_{k}": round(v, 3) if isinstance(v, float) else v for k, v in metrics.items()}
    print("RESULT " + json.dumps(found))


if __name__ == "__main__":
    main()
