"""NVIDIA's asset validator of Omniverse, which Isaac Sim's users are pointed to: warnings don't count.

It warns of what scans are like, such as edges of more than two faces.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from bench.consumers import Fault
from bench.gate.places import Places

FORMAT = "usd"
FAILED = ("ERROR", "FAILURE")


def missing() -> str:
    """Why it can't run here, or an empty text."""
    if importlib.util.find_spec("omni") and importlib.util.find_spec("omni.asset_validator"):
        return ""
    return "the asset validator isn't installed (pip install omniverse-asset-validator)"


def check(export: Path, places: Places) -> dict[str, Any]:
    """Validate the stage by its default rules."""
    (stage,) = export.glob("*.usdc")
    issues = found(stage)
    failed = [text for severity, text in issues if severity in FAILED]
    if failed:
        raise Fault(f"{len(failed)}, the first: {failed[0]}")
    return {"warnings": len(issues)}


def found(path: Path) -> list[tuple[str, str]]:
    """Severity and text of each issue."""
    from omni.asset_validator import ValidationEngine

    return [(issue.severity.name, str(issue.message)) for issue in ValidationEngine().validate(str(path)).issues()]
