"""Acceptance gate: exported worlds are run in the programs that use them.

`make gate`, or `python -m bench.gate [--out bench-out/gate] [--worlds demo raw0009 ...] [--consumers gazebo ...]`.
The demo tile, a real street, a world of ten tiles and a robot's map of a building are built with default settings (the
ten tiles coarser) if missing, exported in each consumer's format, and read, driven on or rendered by the consumer (a
file each in `tests/fakes/consumers`). Further checks: height steps at tile borders, labels compared with the photos'
true ones, roads compared with those of the generated streets, surveyed points through all formats, and Gazebo's loading
cost (`bench/gate`). Consumers and worlds that aren't available are reported as skipped.

Ends with `RESULT {json}`: number of `consumers` without a fault on any world, `skipped`, `faults`, and metrics, the
worst of all worlds. Exit status 1 if there is a fault.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from bench.gate.borders import border_steps
from bench.gate.georeference import georeference
from bench.gate.labels import label_agreement
from bench.gate.load import load
from bench.gate.worlds import WORLDS, GateWorld, WorldUnavailable, scan2sim
from bench.paths import ROOT
from bench.roads import line_errors, summary
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.io import robot_formats
from scan2sim.pipeline.io.worlds.scene import read_scene
from tests.fakes import consumers
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import find

MAX_METRICS = (
    "drop_max_m", "border_step_max_m", "robot_off_way_max_m", "picture_off_px", "road_centre_p95_m", "lane_edge_p95_m",
)  # fmt: skip
"""Metrics of which the largest value is reported."""
LEFT_ROAD = "robot_left_road"
"""Metric that is summed: number of updates with a robot off the road."""


def main() -> None:
    """Build the worlds, run the consumers and print a table."""
    known = plugins.names(consumers.__name__)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "gate")
    parser.add_argument("--worlds", nargs="+", choices=list(WORLDS), default=list(WORLDS))
    parser.add_argument("--consumers", nargs="*", choices=known, default=known)
    parser.add_argument(
        "--no-load", action="store_true", help="skip the comparison of loading costs, which takes a minute"
    )
    arguments = parser.parse_args()
    result: dict[str, Any] = {"skipped": [], "faults": []}
    available = {name: plugins.module(consumers.__name__, name) for name in arguments.consumers}
    for name, module in available.items():
        if reason := module.missing():
            result["skipped"].append(f"{name}: {reason}")
    available = {name: module for name, module in available.items() if not module.missing()}
    runs: dict[str, Path] = {}
    for name in arguments.worlds:
        try:
            subject = WORLDS[name](arguments.out / name)
        except WorldUnavailable as reason:
            result["skipped"].append(f"{name}: {reason}")
            continue
        runs[name] = subject.run
        _check_world(subject, available, result)
    if "gazebo" in available and not arguments.no_load:
        result |= load(arguments.out / "load", runs)
    result |= georeference(arguments.out / "georeference")
    faulty = {fault.split(" ")[0] for fault in result["faults"]}
    print("RESULT", json.dumps({"consumers": len(set(available) - faulty), **result}))
    sys.exit(bool(result["faults"]))


def _check_world(subject: GateWorld, available: dict[str, Any], result: dict[str, Any]) -> None:
    """Export a world, run all consumers on it, and add their metrics to `result`."""
    scene = read_scene(subject.run)
    reference = find(scene, subject.run, subject.tiles)
    if not scene.has_splats:
        available = {name: module for name, module in available.items() if not module.FORMAT.startswith("splats")}
    formats = sorted({module.FORMAT for module in available.values()})
    for form in formats:
        folder = subject.run.parent / "exports" / form
        shutil.rmtree(folder, ignore_errors=True)
        driven = ["--robot"] if form in plugins.names(robot_formats.PACKAGE) else []
        scan2sim("export", subject.run, "--to", form, "--out", folder, *driven)
    for name, module in available.items():
        try:
            _record(subject, name, module.check(subject.run.parent / "exports" / module.FORMAT, reference), result)
        except Fault as reason:
            _record(subject, name, reason.metrics, result)
            print(f"{subject.name:8} {name:10} FAULT: {reason}", flush=True)
            result["faults"].append(f"{name} on {subject.name}: {reason}")
    if len(scene.tiles) > 1:
        _record(subject, "borders", border_steps(scene, subject.tiles), result)
    if subject.street is not None:
        _record(subject, "labels", label_agreement(scene, subject.street), result)
    if subject.layout is not None:
        _record(subject, "roads", summary(line_errors(subject.run / "world", subject.layout)), result)


def _record(subject: GateWorld, what: str, metrics: dict[str, Any], result: dict[str, Any]) -> None:
    """Print metrics of a world and add the gate's own to the result."""
    print(f"{subject.name:8} {what:10} {json.dumps(metrics)}", flush=True)
    for name in MAX_METRICS:
        if metrics.get(name) is not None:
            result[name] = max(result.get(name, 0.0), metrics[name])
    if LEFT_ROAD in metrics:
        result[LEFT_ROAD] = result.get(LEFT_ROAD, 0) + metrics[LEFT_ROAD]
    if "labels_agree" in metrics:
        result["labels_agree"] = metrics["labels_agree"]
