"""Placement of a service by measurements of sites."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.orchestration import placement


def measured(folder: Path, environment: str, toolbox: str = "detect", **failed: float | None) -> Path:
    """A site's measurement file; the given metrics fail."""
    rows: list[dict[str, Any]] = [{"metric": "delay", "required": "at most 100", "measured": 3.0, "passed": True}]
    for metric, value in failed.items():
        rows.append({"metric": metric, "required": "at least 8", "measured": value, "passed": False})
    path = folder / f"{environment}.json"
    path.write_text(
        json.dumps({"toolbox": toolbox, "environment": environment, "rows": rows, "more": 1}), encoding="utf-8"
    )
    return path


def test_sites_are_ordered_by_distance_and_list_unmet_requirements(tmp_path: Path) -> None:
    sites = [
        placement.read(measured(tmp_path, "cloud")),
        placement.read(measured(tmp_path, "robot", cpu_cores=2, gpu_cores=None)),
        placement.read(measured(tmp_path, "edge")),
    ]
    found = placement.place("detect", sites)
    assert [(one.environment, one.fits) for one in found] == [("robot", False), ("edge", True), ("cloud", True)]
    assert found[0].unmet == (
        "cpu cores: 2, required: at least 8",
        "gpu cores: not available, required: at least 8",
    )


def test_metrics_that_were_not_measured_are_named(tmp_path: Path) -> None:
    path = measured(tmp_path, "edge")
    site = json.loads(path.read_text(encoding="utf-8"))
    site["rows"].append({"metric": "gpu_memory", "required": "at least 2048", "measured": None, "passed": None})
    path.write_text(json.dumps(site), encoding="utf-8")
    (found,) = placement.place("detect", [placement.read(path)])
    assert found.fits and found.unknown == ("gpu memory",)


def test_measurements_of_another_service_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="measured with segment"):
        placement.place("detect", [placement.read(measured(tmp_path, "edge", "segment"))])
    bad = tmp_path / "bad.json"
    for text in ("{}", "[", "[" * 5000, '{"toolbox": "detect", "environment": "moon", "rows": []}'):
        bad.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="not a measurement file"):
            placement.read(bad)
