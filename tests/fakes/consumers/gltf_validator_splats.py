"""Khronos' glTF validator on GLBs of splats: nothing beside attributes of the extension, which it doesn't know."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.fakes.consumers.gltf_validator import issues, missing
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

__all__ = ["FORMAT", "check", "missing"]

FORMAT = "splats"
UNKNOWN = "/attributes/KHR_gaussian_splatting:"
WARNING = 1
"""Severity of warnings; errors have 0."""


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Validate all GLBs."""
    files = sorted(export.glob("*.glb"))
    for path in files:
        found = [one for one in issues(path)["messages"] if one["severity"] <= WARNING]
        if wrong := [one for one in found if UNKNOWN not in one["pointer"]]:
            raise Fault(f"{path.name}: {wrong[0]['message']}", {"errors": len(wrong)})
    return {"files": len(files)}
