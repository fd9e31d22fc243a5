"""Training of a street's splats with the inputs of its run, some of them or its settings changed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.street import lidar, splats
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.texturing.splats import step


def of_run(run: Path) -> tuple[dict[str, Path], dict[str, Any]]:
    """Inputs and settings of the newest splats of a run."""
    about = json.loads(lidar.newest(run, "splats", "manifest.json").read_text(encoding="utf-8"))
    inputs = {}
    for name, source in about["inputs"].items():
        key, output = source.split("/", 1)
        (folder,) = (run / "steps").glob(f"*/{key}")
        files = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["files"]
        inputs[name] = folder / files[output]
    return inputs, about["params"]


def train(inputs: dict[str, Path], params: Mapping[str, Any], folder: Path) -> tuple[SplatLayer, dict[str, float]]:
    """Run the step `splats` into an empty `folder`; returns the splats and what the training used."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "checkpoint").mkdir(parents=True)
    with splats.resources() as used:
        about = step.SplatsParams.model_validate(params)
        done = step.splats(inputs, about, folder, _report, folder / "checkpoint")
    shutil.rmtree(folder / "checkpoint")
    return SplatLayer.load(done.files["splats"]), used


def _report(fraction: float, message: str = "") -> None:
    print(f"\r{fraction:5.0%} {message:60}", end="", flush=True)
