"""Debian's Blender (3.4; later versions don't read Collada) imports every DAE with all triangles and textures."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tests.fakes import blender
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "gazebo"
PROGRAM = ("blender", "--background", "--factory-startup", "--python-exit-code", "1", "--python")


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if shutil.which("blender") else "Blender isn't installed (apt-get install blender)"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Import all files and count objects, triangles and textures."""
    files = sorted(export.rglob("*.dae"))
    return blender.check(PROGRAM, export, files, ".dae", sum(map(_double, files)))


def _double(path: Path) -> int:
    """Number of triangles with the same three vertices as another one; Blender keeps one of them, whatever its side."""
    import collada

    parts = [part.vertex_index for shape in collada.Collada(str(path)).geometries for part in shape.primitives]
    return sum(len(part) - len(np.unique(np.sort(part, axis=1), axis=0)) for part in parts)
