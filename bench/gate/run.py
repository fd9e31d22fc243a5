"""The gate: exported worlds go through those who use them.

`make gate`, or `python -m bench.gate [--out bench-out/gate] [--worlds demo raw0009 survey] [--consumers gazebo ...]`.
The demo tile, a real street and a world of ten tiles are made by the defaults (the ten tiles coarser) where they aren't
there yet, exported in the format that a consumer reads, and read, driven on or looked at by it (`bench/consumers`, a
file each). Beside that: steps of the ground at the tiles' borders, labels against the photos' true ones, roads against
the generated streets', surveyed points through all formats, and what loading costs Gazebo (`bench/gate_*.py`).
Consumers and worlds that aren't there are skipped, and said.

Ends with `RESULT {json}`: `consumers` that ran without a fault on every world, `skipped`, `faults`, and figures, the
worst of all worlds. Exit status 1 where there is a fault.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from bench import consumers
from bench.consumers import Fault
from bench.gate.borders import steps
from bench.gate.georeference import georeference
from bench.gate.labels import agreement
from bench.gate.load import load
from bench.gate.places import find
from bench.gate.worlds import WORLDS, Absent, Subject, scan2sim
from bench.paths import ROOT
from bench.roads import compared, summary
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.io import robot_formats
from scan2sim.pipeline.io.worlds.scene import read_scene

WORST = (
    "drop_max_m", "border_step_max_m", "robot_off_way_max_m", "picture_off_px", "road_centre_p95_m", "lane_edge_p95_m",
)  # fmt: skip
"""Figures of which the largest counts."""
LEFT = "robot_left_road"
"""Looks at robots that were beside the road, all together."""


def main() -> None:
    """Make the worlds, run the consumers, print a table."""
    known = plugins.names(consumers.__name__)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "gate")
    parser.add_argument("--worlds", nargs="+", choices=list(WORLDS), default=list(WORLDS))
    parser.add_argument("--consumers", nargs="*", choices=known, default=known)
    parser.add_argument(
        "--no-load", action="store_true", help="leave the comparison of loading times out: it takes a minute"
    )
    arguments = parser.parse_args()
    result: dict[str, Any] = {"skipped": [], "faults": []}
    able = {name: plugins.module(consumers.__name__, name) for name in arguments.consumers}
    for name, module in able.items():
        if why := module.missing():
            result["skipped"].append(f"{name}: {why}")
    able = {name: module for name, module in able.items() if not module.missing()}
    runs: dict[str, Path] = {}
    for name in arguments.worlds:
        try:
            subject = WORLDS[name](arguments.out / name)
        except Absent as why:
            result["skipped"].append(f"{name}: {why}")
            continue
        runs[name] = subject.run
        _through(subject, able, result)
    if "gazebo" in able and not arguments.no_load:
        result |= load(arguments.out / "load", runs)
    result |= georeference(arguments.out / "georeference")
    faulty = {fault.split(" ")[0] for fault in result["faults"]}
    print("RESULT", json.dumps({"consumers": len(set(able) - faulty), **result}))
    sys.exit(bool(result["faults"]))


def _through(subject: Subject, able: dict[str, Any], result: dict[str, Any]) -> None:
    """Export a world, let all consumers have it, and put their figures into `result`."""
    scene = read_scene(subject.run)
    places = find(scene, subject.run, subject.tiles)
    formats = sorted({module.FORMAT for module in able.values()})
    for form in formats:
        folder = subject.run.parent / "exports" / form
        shutil.rmtree(folder, ignore_errors=True)
        driven = ["--robot"] if form in plugins.names(robot_formats.PACKAGE) else []
        scan2sim("export", subject.run, "--to", form, "--out", folder, *driven)
    for name, module in able.items():
        try:
            _tell(subject, name, module.check(subject.run.parent / "exports" / module.FORMAT, places), result)
        except Fault as why:
            _tell(subject, name, why.figures, result)
            print(f"{subject.name:8} {name:10} FAULT: {why}", flush=True)
            result["faults"].append(f"{name} on {subject.name}: {why}")
    if len(scene.tiles) > 1:
        _tell(subject, "borders", steps(scene, subject.tiles), result)
    if subject.street is not None:
        _tell(subject, "labels", agreement(scene, subject.street), result)
    if subject.layout is not None:
        _tell(subject, "roads", summary(compared(subject.run / "world", subject.layout)), result)


def _tell(subject: Subject, what: str, figures: dict[str, Any], result: dict[str, Any]) -> None:
    """Print figures of a world, and keep those of the gate."""
    print(f"{subject.name:8} {what:10} {json.dumps(figures)}", flush=True)
    for name in WORST:
        if figures.get(name) is not None:
            result[name] = max(result.get(name, 0.0), figures[name])
    if LEFT in figures:
        result[LEFT] = result.get(LEFT, 0) + figures[LEFT]
    if "labels_agree" in figures:
        result["labels_agree"] = figures["labels_agree"]
