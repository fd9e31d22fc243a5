"""Cesium's 3D Tiles validator: the tileset, and every GLB with Khronos' validator."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from tests.fakes.cesium import node_module
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "tiles3d"
NAME = "3d-tiles-validator"


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if node_module(NAME) else f"{NAME} isn't installed (npm install -g {NAME})"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Validate: neither errors nor warnings."""
    package = node_module(NAME)
    assert package is not None
    program = package / next(iter(json.loads((package / "package.json").read_text(encoding="utf-8"))["bin"].values()))
    with tempfile.TemporaryDirectory() as work:
        report_path = Path(work) / "report.json"
        done = subprocess.run(
            ["node", program, "--tilesetFile", export / "tileset.json", "--reportFile", report_path],
            capture_output=True, text=True,
        )  # fmt: skip
        if not report_path.is_file():
            raise Fault(f"no report was written: {(done.stderr or done.stdout)[-500:]}")
        report = json.loads(report_path.read_text(encoding="utf-8"))
    metrics = {"errors": report["numErrors"], "warnings": report["numWarnings"]}
    if any(metrics.values()):
        raise Fault(f"{metrics}: {json.dumps(report['issues'])[:500]}")
    return metrics
