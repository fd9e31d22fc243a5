"""A survey of one kilometre in ten tiles: workers, rerun, borders, Prefect's overhead; and what a change costs.

`python -m bench.survey [--out bench-out/survey] [--parts plain one two ray rerun photo tile plan] [--fine]`. The
synthetic street is generated and cut once; every part runs the same survey into its own folder, each task on one core,
so that two workers are two cores and one is one. Settings are coarser than the defaults (`COARSE_SETTINGS`), so that
five runs of a kilometre take one hour instead of three (Prefect's share is larger then); `--fine` uses the defaults.
Part `photo` has a street of its own, two tiles with 51 photos; `plan` plans a thousand tiles that don't exist. Results
of parts that aren't run are read from their last run. Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.measure import measure
from bench.paths import ROOT
from scan2sim.data_samples.photos import Effects
from scan2sim.data_samples.street import generate
from scan2sim.flows.commands import unchanged
from scan2sim.flows.commands.survey import plan_survey
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey

PARTS = ("plain", "one", "two", "ray", "rerun", "photo", "tile", "plan")
WITHOUT_STREET = ("photo", "plan")
MIDDLE = "street_0004"
PLANNED_TILES = 1000
LENGTH, POINTS, PHOTOS, WIDTH, SEED = 1000.0, 1.0e7, 200, 800, 3
RUNS = {  # part: options of `scan2sim survey`
    "plain": ("--runner", "processes", "--jobs", "1"),
    "one": ("--runner", "dask", "--jobs", "1"),
    "two": ("--runner", "dask", "--jobs", "2"),
    "ray": ("--runner", "ray", "--jobs", "2"),
}
COARSE_SETTINGS = ("voxel.size=0.2", "unwrap.texel=0.04", "visibility.pixels=500000", "pictures.width=640")
EMPTY_FLOW = """
import scan2sim.flows.deployed.prefect_settings
from prefect import flow
flow(lambda: None, name="empty")()
"""


def main() -> None:
    """Run the parts and print their results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "survey")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--fine", action="store_true", help="default settings: takes three hours")
    arguments = parser.parse_args()
    settings = () if arguments.fine else tuple(part for value in COARSE_SETTINGS for part in ("--set", value))
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    survey = out / "tiles" if set(arguments.parts) <= set(WITHOUT_STREET) else street(out)
    notes = out / "notes.json"
    known: dict[str, dict[str, Any]] = json.loads(notes.read_text(encoding="utf-8")) if notes.is_file() else {}
    for part in (name for name in PARTS if name in arguments.parts):
        if part in RUNS:
            known[part] = run_survey(survey, out / part, (*RUNS[part], *settings))
        elif part == "rerun":
            known[part] = rerun(survey, out / "two", (*RUNS["two"], *settings))
        elif part == "photo":
            known[part] = photo(out / "photo", settings)
        elif part == "plan":
            known[part] = plan_many(PLANNED_TILES)
        else:
            known[part] = one_tile(survey / MIDDLE, out / "tile")
        print(part, json.dumps(known[part]), flush=True)
        notes.write_text(json.dumps(known, indent=1), encoding="utf-8")
    report(known, out)


def street(out: Path) -> Path:
    """The kilometre, generated and cut if missing; returns the folder of its survey."""
    corridor, survey = out / "street", out / "tiles"
    if not (corridor / "tile.toml").is_file():
        generate(
            corridor, length=LENGTH, points=POINTS, photos=PHOTOS, seed=SEED, photo_width=WIDTH, truth_density=20.0,
            effects=Effects(quality=90),
        )  # fmt: skip
    if not (survey / "survey.toml").is_file():
        began = time.perf_counter()
        cut_survey(corridor, survey, CutParams.model_validate({"length": 100.0, "buffer": 5.0}))
        print(f"cut: {time.perf_counter() - began:.1f} s")
    return survey


def command(survey: Path, out: Path, options: tuple[str, ...]) -> list[str]:
    """Command that runs a survey with one core per task."""
    scan2sim = str(Path(sys.executable).parent / "scan2sim")
    return [scan2sim, "survey", str(survey), "--out", str(out), "--cores", "1", *options]


def run_survey(survey: Path, out: Path, options: tuple[str, ...]) -> dict[str, Any]:
    """Run all tiles from scratch."""
    shutil.rmtree(out, ignore_errors=True)
    ran = measure(command(survey, out, options))
    if ran.status != 0:
        sys.exit(f"{' '.join(options)}: exit status {ran.status}")
    body = json.loads((out / "survey.json").read_text(encoding="utf-8"))
    figures = [tile["figures"] for tile in body["tiles"].values()]
    return {
        "seconds": round(ran.seconds, 1),
        "peak_gb": round(ran.peak_gb, 2),
        "step_seconds": round(sum(f["seconds"] for f in figures), 1),
        "largest_step_gb": round(max(f["peak_mb"] for f in figures) / 1000, 2),
        "gb_written": round(sum(f["bytes_written"] for f in figures) / 1e9, 2),
        "gb_worlds": round(sum(f["bytes"] for f in figures) / 1e9, 2),
        "contents": hashlib.sha256(json.dumps(contents(out), sort_keys=True).encode()).hexdigest()[:16],
    }


def rerun(survey: Path, out: Path, options: tuple[str, ...]) -> dict[str, Any]:
    """Run an unchanged survey again: with the record of its last run, and without it, when all keys are compared."""
    measure(command(survey, out, options))  # with the options of this part
    again = measure(command(survey, out, options))
    (out / unchanged.RECORD).unlink()
    compared, empty = measure(command(survey, out, options)), measure([sys.executable, "-c", EMPTY_FLOW])
    return {
        "seconds": round(again.seconds, 2),
        "compared_seconds": round(compared.seconds, 1),
        "empty_flow_seconds": round(empty.seconds, 1),
    }


def plan_many(count: int) -> dict[str, Any]:
    """Plan a survey of many tiles in a row, copies of the sample tile, none of which was run."""
    first, names = read_tile(ROOT / "data_samples" / "tile"), [f"street_{i:04d}" for i in range(count)]
    x, y, _ = first.frame.origin
    seeds = [(x + 20.0 * i, y) for i in range(count)]
    tiles = {}
    for i, name in enumerate(names):
        near = {names[k]: seeds[k] for k in (i - 1, i + 1) if 0 <= k < count}
        tiles[name] = replace(first, name=name, cell=Cell(seeds[i], near))
    with tempfile.TemporaryDirectory() as empty:
        began = time.perf_counter()
        planned = plan_survey(tiles, Store(Path(empty)), Settings(), Digests(Path(empty) / "digests.json"))
        return {"seconds": round(time.perf_counter() - began, 1), "tasks": len(planned)}


def one_tile(tile: Path, out: Path) -> dict[str, Any]:
    """Run one tile with default settings, one core per task, to extrapolate to many kilometres.

    Bytes read are clouds and photos once, and the inputs of each task from other tasks' results.
    """
    shutil.rmtree(out, ignore_errors=True)
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ[name] = "1"
    measure([str(Path(sys.executable).parent / "scan2sim"), "run", str(tile), "--out", str(out), "--jobs", "1"])
    body = json.loads((out / "report.json").read_text(encoding="utf-8"))
    made = {
        path.parent.name: json.loads(path.read_text(encoding="utf-8"))
        for path in (out / "steps").glob("*/*/manifest.json")
    }
    sources = read_tile(tile)
    read = sum(path.stat().st_size for path in (*sources.clouds, *(view.photo for view in sources.views)))
    between = sum(input_bytes(made, source) for manifest in made.values() for source in manifest["inputs"].values())
    return {
        "step_seconds": body["seconds"],
        "largest_step_gb": round(body["peak_mb"] / 1000, 2),
        "gb_sources": round(read / 1e9, 3),
        "gb_read": round((read + between) / 1e9, 2),
        "gb_written": round(sum(sum(m["sizes"].values()) for m in made.values()) / 1e9, 2),
        "gb_world": round(body["world"]["bytes"] / 1e9, 2),
        "points": body["steps"]["ingest"]["metrics"]["points"],
    }


def input_bytes(made: dict[str, Any], source: str) -> int:
    """Bytes of an input `KEY/NAME` that is another task's output; 0 for source files."""
    key, _, name = source.partition("/")
    if key not in made or not name:
        return 0
    path = made[key]["files"][name]
    return sum(count for file, count in made[key]["sizes"].items() if file == path or file.startswith(f"{path}/"))


def photo(out: Path, options: tuple[str, ...]) -> dict[str, Any]:
    """Change one of 51 photos of a survey of two tiles, and report what that costs beside the whole survey.

    Once a patch gets a little brighter (another exposure, a new JPEG encoder), once the photo shows something else.
    """
    corridor, survey, made = out / "street", out / "tiles", out / "made"
    if not (survey / "survey.toml").is_file():
        generate(
            corridor, length=52.0, points=1.5e6, photos=51, seed=SEED, photo_width=WIDTH, truth_density=20.0,
            effects=Effects(quality=90),
        )  # fmt: skip
        cut_survey(corridor, survey, CutParams.model_validate({"length": 26.0, "buffer": 5.0}))
    run = command(survey, made, options)
    shutil.rmtree(made, ignore_errors=True)
    whole = measure(run).seconds
    found: dict[str, Any] = {"whole_seconds": round(whole, 1)}
    photos = sorted((corridor / "photos").glob("*.jpg"))
    changed, other = photos[len(photos) // 2], photos[len(photos) // 2 + 4]
    original, stat = changed.read_bytes(), changed.stat()
    try:
        for name, picture in {"brighter": _brighter(changed), "other": other.read_bytes()}.items():
            changed.write_bytes(picture)
            before = _results(made)
            seconds = measure(run).seconds
            after = _results(made)
            found[f"{name}_seconds"], found[f"{name}_share"] = round(seconds, 1), round(seconds / whole, 3)
            found[f"{name}_ran"] = sorted(task for task, one in after.items() if one[0] != before.get(task, ("",))[0])
            found[f"{name}_changed"] = sum(before.get(task, ("", ""))[1] != one[1] for task, one in after.items())
        found["results"] = len(after)
    finally:
        changed.write_bytes(original)
        os.utime(changed, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return found


def _brighter(path: Path) -> bytes:
    """The photo as JPEG, with a patch of a tenth of its width brighter by two grey levels."""
    import cv2

    picture = cv2.imread(str(path))
    size = picture.shape[1] // 10
    patch = picture[-2 * size : -size, :size]
    patch[...] = np.minimum(patch.astype(int) + 2, 255)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def _results(out: Path) -> dict[str, tuple[str, str]]:
    """When each result was computed (its files' inodes: a reused one keeps them), and its content, by tile and step."""
    found = {}
    for path in (out / "steps").glob("*/*/*/manifest.json"):
        manifest = json.loads(path.read_text(encoding="utf-8"))
        inodes = sorted((path.parent / name).stat().st_ino for name in manifest["sizes"])
        found[manifest["label"]] = (json.dumps(inodes), manifest["content"])
    return found


def contents(out: Path) -> dict[str, str]:
    """Digests of all results of a run, by tile and step."""
    manifests = [json.loads(path.read_text(encoding="utf-8")) for path in (out / "steps").glob("*/*/*/manifest.json")]
    return {manifest["label"]: manifest["content"] for manifest in manifests}


def borders(out: Path) -> dict[str, float]:
    """Widest gap, mean colour step, and lengths over all borders."""
    body = json.loads((out / "survey.json").read_text(encoding="utf-8"))["borders"]
    length = np.array([b["length_m"] for b in body])
    return {
        "border_gap_m": max(b["gap_m"] for b in body),
        "border_gap_p99_m": round(float(np.average([b["gap_p99_m"] for b in body], weights=length)), 6),
        "border_colour_step": round(float(np.average([b["colour_step"] for b in body], weights=length)), 3),
        "border_one_sided": round(float(sum(b["one_sided_m"] for b in body) / length.sum() / 2), 4),
        "border_shared": round(float(np.average([b["shared"] for b in body], weights=length)), 4),
    }


def report(known: dict[str, dict[str, Any]], out: Path) -> None:
    """Print the table and RESULT."""
    for part, values in known.items():
        print(f"{part:<8}", " ".join(f"{name} {value}" for name, value in values.items()))
    result: dict[str, Any] = {}
    if {"one", "two"} <= known.keys():
        result["speedup_two_workers"] = round(known["one"]["seconds"] / known["two"]["seconds"], 2)
        result["same_bytes"] = known["one"]["contents"] == known["two"]["contents"]
    if {"one", "ray"} <= known.keys():
        result["speedup_ray"] = round(known["one"]["seconds"] / known["ray"]["seconds"], 2)
        result["same_bytes_ray"] = known["one"]["contents"] == known["ray"]["contents"]
    if "rerun" in known:
        result["rerun_seconds"] = known["rerun"]["seconds"]
    if "photo" in known:
        result["photo_changed_share"] = known["photo"]["other_share"]
        result["photo_brighter_share"] = known["photo"]["brighter_share"]
    if "plan" in known:
        result["plan_1000_seconds"] = known["plan"]["seconds"]
    for part in RUNS:
        if part in known:
            result |= borders(out / part)
            break
    if {"one", "plain"} <= known.keys():
        one, plain = known["one"], known["plain"]
        result["prefect_overhead"] = round(one["seconds"] / plain["seconds"] - 1, 3)
        # the machine's speed varies from hour to hour, and steps take most of the time: compare the time beside them
        more = (one["seconds"] - one["step_seconds"]) - (plain["seconds"] - plain["step_seconds"])
        result["prefect_overhead_beside_steps"] = round(more / plain["seconds"], 3)
    if "tile" in known:
        cost = {name: round(1000 * value, 1) for name, value in known["tile"].items() if name.startswith("gb_")}
        cost["cpu_hours"] = round(1000 * known["tile"]["step_seconds"] / 3600, 1)
        print("100 km, a thousand of these tiles:", json.dumps(cost))
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()
