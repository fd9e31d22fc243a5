"""All validators of OpenUSD."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "usd"


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if importlib.util.find_spec("pxr") else "OpenUSD isn't installed (pip install usd-core)"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Validate the stage with all its payloads."""
    (stage,) = export.glob("*.usdc")
    count, found = faults(stage)
    if found:
        raise Fault(f"{len(found)} issues, the first: {found[0]}")
    return {"validators": count}


def faults(path: Path) -> tuple[int, list[str]]:
    """Number of validators, and the issues that they find."""
    from pxr import Usd, UsdValidation

    every = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(every).Validate(Usd.Stage.Open(str(path)))
    return len(every), [fault.GetErrorAsString() for fault in found]
