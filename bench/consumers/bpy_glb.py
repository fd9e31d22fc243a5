"""Blender as a module (PyPI's bpy): it imports every GLB, all triangles and textures among them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench.consumers import blender
from bench.gate.places import Places

FORMAT = "glb"


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return blender.module_missing()


def check(export: Path, places: Places) -> dict[str, Any]:
    """Import, and count what is there."""
    return blender.check(blender.module(), export, sorted(export.glob("*.glb")), ".glb")
