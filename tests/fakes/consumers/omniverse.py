"""NVIDIA's Omniverse asset validator, recommended for Isaac Sim; warnings are counted only.

It warns about typical properties of scans, such as non-manifold edges.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "usd"
FAILED = ("ERROR", "FAILURE")


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    if importlib.util.find_spec("omni") and importlib.util.find_spec("omni.asset_validator"):
        return ""
    return "the asset validator isn't installed (pip install omniverse-asset-validator)"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Validate the stage with the default rules."""
    (stage,) = export.glob("*.usdc")
    issues = found(stage)
    failed = [text for severity, text in issues if severity in FAILED]
    if failed:
        raise Fault(f"{len(failed)} issues, the first: {failed[0]}")
    return {"warnings": len(issues)}


def found(path: Path) -> list[tuple[str, str]]:
    """Severity and text of each issue."""
    from omni.asset_validator import ValidationEngine

    return [(issue.severity.name, str(issue.message)) for issue in ValidationEngine().validate(str(path)).issues()]
