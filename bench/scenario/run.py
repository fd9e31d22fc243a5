"""Tracks of real streets and of synthetic streets with traffic, compared with the truth.

`--worlds` is the output folder of `bench.street`, whose cached steps are read (streets that are missing are built
there). The step `tracks` runs again on them. Sweeps that were held out of a world are unknown to it: in their frames,
interpolated boxes are scored. Pictures of boxes over points and over photos are written to `--out`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from bench.paths import ROOT
from bench.scenario import kitti, metrics, pictures, standards, synthetic
from bench.street.run import STREETS, build_world
from scan2sim.data_samples.street import generate
from scan2sim.pipeline.core.classes import group_of
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, PointCloud, Trajectory
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.pipeline.scenario.motion_check import ImpossibleMotion, impossible_motions
from scan2sim.pipeline.scenario.scenario import from_tracks
from scan2sim.pipeline.steps.tracks import TracksParams
from scan2sim.pipeline.steps.tracks import tracks as tracks_step
from scan2sim.pipeline.tracking.tracks import Track, read_frame, read_tracks

PARTS = ("raw0009", "odo04", "raw0013", "synthetic")
STREET_M, STREET_POINTS, STREET_PHOTOS, STREET_SEEDS = 60.0, 1.5e6, 8, (3, 11)
"""Synthetic streets with traffic."""
INPUTS = {
    "cloud": "instances/*/cloud.npz", "instances": "instances/*/instances.geojson", "path": "path/*/path.npz",
    "moving": "dynamic_objects/*/moving.npz", "views": "views/*/cameras.json",
}  # fmt: skip
"""Inputs of the step `tracks` in the folder of cached steps."""


def follow(run: Path, out: Path) -> tuple[Mapping[str, Path], list[Track], float]:
    """Run the step `tracks` on the cached steps of a run; returns its inputs, the tracks, and its CPU seconds."""
    out.mkdir(parents=True, exist_ok=True)
    inputs = {
        name: max((run / "steps").glob(pattern), key=lambda file: file.stat().st_mtime)
        for name, pattern in INPUTS.items()
    }
    started = time.process_time()
    done = tracks_step(inputs, TracksParams(), out, silent)
    seconds = time.process_time() - started
    print(f"\n{out.name}: {done.metrics['moving']} moving, {done.metrics['parked']} parked")
    return inputs, read_tracks(out / "tracks.json"), seconds


def motions(inputs: Mapping[str, Path], tracks: list[Track]) -> list[ImpossibleMotion]:
    """Motions that no road user can do; the ground is that of the classified cloud."""
    cloud = PointCloud.load(inputs["cloud"])
    assert cloud.classification is not None
    ground = cloud.xyz[group_of()[cloud.classification] == 0][::5].astype(np.float64)
    tree = cKDTree(ground[:, :2])

    def height(places: F64) -> F64:
        distance, near = tree.query(places[:, :2], k=9)
        median = np.median(ground[near, 2], axis=1)
        return np.where(distance[:, -1] < 1.0, median, np.nan)

    found = impossible_motions(from_tracks("bench", tracks), height)
    for one in found:
        print(f"  impossible: {one}")
    return found


def real(name: str, worlds: Path, out: Path) -> dict[str, Any]:
    """Metrics of a real street."""
    street, folder = STREETS[name], worlds / name
    run = folder / "run"
    if not (run / "report.json").is_file():
        run = build_world(street, folder)[1]
    inputs, tracks, seconds = follow(run, out / name)
    total = float(json.loads((run / "report.json").read_text(encoding="utf-8"))["seconds"])
    views = sorted(views_io.load(inputs["views"]), key=lambda view: view.time or 0.0)
    truth = street.labels if street.labels and street.labels.is_file() else None
    pictures.plan(out / name / "plan.png", inputs, tracks, views, truth)
    pictures.photos(out / name / "photos.png", tracks, views[3::8])
    errors, plays = standards.check(name, tracks, read_scene(run), out / name)
    found: dict[str, Any] = {"impossible": len(motions(inputs, tracks)), "time_share": seconds / total}
    found |= {"schema_errors": errors} | ({} if plays is None else {"esmini": plays})
    return found | (kitti.score(truth, tracks, views) if truth else {})


def synthetic_streets(out: Path) -> dict[str, Any]:
    """Metrics of the synthetic streets with traffic."""
    streets = [_street(seed, out / f"street-{seed}") for seed in STREET_SEEDS]
    found: dict[str, Any] = {"impossible": sum(impossible for _, impossible in streets)}
    return found | synthetic.result([comparison for comparison, _ in streets])


def _street(seed: int, out: Path) -> tuple[synthetic.Comparison, int]:
    """A street compared with its truth, and its number of impossible motions."""
    tile, run = out / "tile", out / "run"
    if not (tile / "tile.toml").is_file():
        generate(
            tile, length=STREET_M, points=STREET_POINTS, photos=STREET_PHOTOS, photo_width=640, seed=seed,
            traffic=True, truth_density=5,
        )  # fmt: skip
    if not (run / "classified").is_dir():
        command = [sys.executable, "-m", "scan2sim.flows.cli", "segment", tile, "--out", run, "--overwrite"]
        subprocess.run([str(word) for word in command], check=True, cwd=ROOT)
    inputs, tracks, _ = follow(run, out / "tracks")
    cloud = PointCloud.load(next((run / "steps" / "ingest").glob("*/cloud.npz")))
    truth_file = tile / "truth" / "tracks.json"
    offset = np.array([*(np.array(read_frame(truth_file).origin) - np.array(cloud.frame.origin)), 0.0])
    truth = [replace(track, poses=track.poses + offset) for track in read_tracks(truth_file)]
    impossible = len(motions(inputs, tracks))
    return synthetic.compare(cloud, Trajectory.load(inputs["path"]), truth, tracks), impossible


def result(found: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Results that have targets; `players`: how many play the scenarios of all streets, None without esmini."""
    keys = ("mota", "hota", "position_m", "yaw_deg", "synthetic_recall", "synthetic_position_m")
    values: dict[str, Any] = {key: next((part[key] for part in found.values() if key in part), None) for key in keys}
    values["impossible_motions"] = sum(part["impossible"] for part in found.values()) if found else None
    values["time_share"] = max((part["time_share"] for part in found.values() if "time_share" in part), default=None)
    values["schema_errors"] = sum(part.get("schema_errors", 0) for part in found.values()) if found else None
    played = [part["esmini"] for part in found.values() if "esmini" in part]
    values["players"] = int(all(played)) if played else None
    return {key: round(value, 4) if isinstance(value, float) else value for key, value in values.items()}


def main() -> None:
    """Run the parts and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--worlds", type=Path, default=ROOT / "bench-out" / "street", help="output of bench.street")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "scenario")
    arguments = parser.parse_args()
    out, worlds = arguments.out.resolve(), arguments.worlds.resolve()
    metrics.check()
    found: dict[str, dict[str, Any]] = {}
    for part in arguments.parts:
        if part == "synthetic":
            found[part] = synthetic_streets(out)
        elif STREETS[part].data.is_dir():
            found[part] = real(part, worlds, out)
        else:
            print(f"{part}: skipped, {STREETS[part].data} doesn't exist")
            continue
        print("  " + ", ".join(f"{key} {value:.4g}" for key, value in found[part].items()))
    print("RESULT " + json.dumps(result(found)))
