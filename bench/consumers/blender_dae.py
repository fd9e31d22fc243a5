"""Debian's Blender (3.4; later ones read no Collada): it imports every DAE, all triangles and textures among them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from bench import blender
from bench.gate_places import Places

FORMAT = "gazebo"
PROGRAM = ("blender", "--background", "--factory-startup", "--python-exit-code", "1", "--python")


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return "" if shutil.which("blender") else "Blender isn't installed (apt-get install blender)"


def check(export: Path, places: Places) -> dict[str, Any]:
    """Import, and count what is there."""
    return blender.check(PROGRAM, export, sorted(export.rglob("*.dae")), ".dae")
