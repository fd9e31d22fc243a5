"""Benchmarks of the ML toolboxes and their quality of service.

`python -m bench.toolboxes [--parts tracks detect drives movement classes pixels batch clients load qos]
[--out DIR]`

- tracks: MOTA and IDF1 on degraded boxes of KITTI (bench/toolboxes/tracks.py).
- detect: the detector on synthetic images and KITTI's photos (bench/toolboxes/detect.py has more).
- drives: the detector trained on two real drives, on a third (bench/toolboxes/drives.py); three quarters of an hour.
- movement: moving or standing, by frame, in ten films of 1000 frames (bench/toolboxes/movement.py); rendering them
  takes a quarter of an hour the first time.
- classes, pixels: pretrained classification and segmentation (bench/toolboxes/classes.py).
- batch: time per image alone relative to time per image of four at once, on one thread; above 1, batching gains.
- clients: calls of Triton's client over HTTP and gRPC, and a slow-body attack (bench/toolboxes/clients.py).
- load: ten minutes at five times a toolbox's capacity, then its model is killed (bench/toolboxes/load.py).
- qos: all toolboxes in all environments; requires root.

Ends with `RESULT {json}`; null for parts that were not run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bench.toolboxes import classes, clients, drives, load, movement, tracks
from scan2sim.pipeline.core.types import U8
from scan2sim.services.qos.requirements import Environment, read
from scan2sim.services.toolboxes import tasks

KEYS = (
    "moving", "standing", "mota", "idf1", "detect_ap50_synthetic", "classify_top1", "segment_miou", "qos", "batch_gain",
    "kitti_vehicle_recall", "kitti_vehicle_precision", "people_false_per_photo", "drives_vehicle_recall",
    "triton_calls", "triton_failed", "slow_bodies_served", "overload_memory_growth", "recovery_s",
)  # fmt: skip
BATCH, ROUNDS = 4, 5
QOS_RATE, QOS_SECONDS = "1", "30"
Found = dict[str, Any]


def detect(out: Path) -> Found:
    """Result of bench.toolboxes.detect on synthetic images, and with default settings on KITTI's photos."""
    result = _result_of("bench.toolboxes.detect", "--parts", "synthetic", "defaults", "--out", str(out / "detect"))
    keys = ("detect_ap50_synthetic", "kitti_vehicle_recall", "kitti_vehicle_precision", "people_false_per_photo")
    return {key: result[key] for key in keys}


def _result_of(*module: str) -> Found:
    """Result of another benchmark."""
    done = subprocess.run([sys.executable, "-m", *module], stdout=subprocess.PIPE, text=True, check=True)
    print(done.stdout, end="", flush=True)
    found: Found = json.loads(done.stdout.splitlines()[-1].removeprefix("RESULT "))
    return found


def batch() -> Found:
    """Time per image alone relative to time per image of four at once, by toolbox."""
    gains = {}
    for name in ("detect", "classify", "segment"):
        size = read(name).image
        assert size
        model = tasks.find(name).load(tasks.find(name).Params(threads=1))
        image = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
        alone, together = [], []
        for _ in range(ROUNDS):
            alone.append(_seconds(model, [[image]] * BATCH))
            together.append(_seconds(model, [[image] * BATCH]))
        gains[name] = round(float(np.median(alone) / np.median(together)), 3)
        print(
            f"batch of {BATCH}, {name}: {np.median(alone) / BATCH:.4f} CPU seconds per image alone, gain {gains[name]}"
        )
    return {"batch_gain": gains}


def _seconds(model: tasks.Model, batches: list[list[U8]]) -> float:
    """CPU seconds."""
    began = time.process_time()
    for images in batches:
        model(images)
    return time.process_time() - began


def qos(out: Path) -> Found:
    """Whether each toolbox's service and the machine pass in each environment."""
    service: dict[str, dict[str, bool]] = {}
    machine: dict[str, dict[str, bool]] = {}
    for name in tasks.names():
        for environment in Environment:
            file = out / f"qos-{name}-{environment}.json"
            command = [sys.executable, "-m", "scan2sim.flows.cli", "qos", "measure", name, "--environment", environment]
            subprocess.run([*command, "--rate", QOS_RATE, "--seconds", QOS_SECONDS, "--out", str(file)], check=True)
            report = json.loads(file.read_text(encoding="utf-8"))
            service.setdefault(name, {})[environment] = report["passed"]
            machine.setdefault(name, {})[environment] = report["machine_passed"]
    return {"qos": service, "qos_machine": machine}


PARTS: dict[str, Callable[[Path], Found | None]] = {
    "tracks": lambda _: tracks.tracks(),
    "detect": detect,
    "drives": lambda out: drives.drives(out / "drives"),
    "movement": movement.movement_accuracy,
    "classes": lambda _: classes.classes(),
    "pixels": classes.pixels,
    "batch": lambda _: batch(),
    "clients": lambda _: clients.clients(),
    "load": lambda _: load.load(),
    "qos": qos,
}


def main() -> None:
    """Run the parts and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=Path("bench-out") / "toolboxes")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    result: Found = dict.fromkeys(KEYS)
    for name in given.parts:
        result |= PARTS[name](given.out) or {}
    print("RESULT " + json.dumps(result))
