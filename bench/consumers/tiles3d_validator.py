"""Cesium's validator of 3D Tiles: the tileset, and every GLB by Khronos' validator within it."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from bench.consumers import Fault
from bench.gate.places import Places
from tests.cesium import node_module

FORMAT = "tiles3d"
NAME = "3d-tiles-validator"


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return "" if node_module(NAME) else f"{NAME} isn't installed (npm install -g {NAME})"


def check(export: Path, places: Places) -> dict[str, Any]:
    """Validate: neither an error nor a warning."""
    package = node_module(NAME)
    assert package is not None
    program = package / next(iter(json.loads((package / "package.json").read_text(encoding="utf-8"))["bin"].values()))
    with tempfile.TemporaryDirectory() as place:
        told = Path(place) / "report.json"
        done = subprocess.run(
            ["node", program, "--tilesetFile", export / "tileset.json", "--reportFile", told],
            capture_output=True, text=True,
        )  # fmt: skip
        if not told.is_file():
            raise Fault(f"it told nothing: {(done.stderr or done.stdout)[-500:]}")
        report = json.loads(told.read_text(encoding="utf-8"))
    figures = {"errors": report["numErrors"], "warnings": report["numWarnings"]}
    if any(figures.values()):
        raise Fault(f"{figures}: {json.dumps(report['issues'])[:500]}")
    return figures
