"""Blender as a module (PyPI's bpy) imports every GLB with all triangles and textures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.fakes import blender
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "glb"


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return blender.module_missing()


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Import all files and count objects, triangles and textures."""
    return blender.check(blender.module(), export, sorted(export.glob("*.glb")), ".glb")
