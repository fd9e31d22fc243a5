"""Import of exported files into Blender, run as a program or as a Python module, in a separate process."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.fakes.world_checks import Fault

TIMEOUT_S = 900.0
"""Time limit for all files."""
MAX_BOX_ERROR_M = 0.01
"""Maximum error of the corners of the bounding box."""
OUTPUT_PREFIX = "SAID "
SCRIPT = """
import bpy, json, sys
import mathutils
FILES = json.loads({files!r})
OPERATOR = {{".glb": lambda f: bpy.ops.import_scene.gltf(filepath=f),
            ".usdc": lambda f: bpy.ops.wm.usd_import(filepath=f),
            ".dae": lambda f: bpy.ops.wm.collada_import(filepath=f)}}[{suffix!r}]
bpy.ops.wm.read_factory_settings(use_empty=True)
for file in FILES:
    OPERATOR(file)
shown = [o for o in bpy.context.scene.objects if o.type == "MESH" and o.data.materials]
corners = [o.matrix_world @ mathutils.Vector(c) for o in shown for c in o.bound_box]
images = [i for i in bpy.data.images if i.source == "FILE"]
print({prefix!r} + json.dumps({{
    "objects": len(shown),
    "triangles": sum(len(o.data.polygons) for o in shown),
    "textures": sum(i.size[0] > 0 for i in images),
    "missing": [i.name for i in images if i.size[0] == 0],
    "untextured": [o.name for o in shown if not o.data.uv_layers],
    "low": [min(c[k] for c in corners) for k in range(3)],
    "high": [max(c[k] for c in corners) for k in range(3)],
}}))
"""


def module_missing() -> str:
    """Why Blender can't be imported here, or an empty text."""
    return "" if importlib.util.find_spec("bpy") else "bpy isn't installed (pip install bpy, with Python 3.11)"


def module() -> tuple[str, ...]:
    """Command that runs a script with Blender as a module."""
    return (sys.executable,)


def check(command: Sequence[str], export: Path, files: Sequence[Path], suffix: str, double: int = 0) -> dict[str, Any]:
    """Import files into one empty scene and compare it with the export's metadata.

    Args:
        command: command that runs a script in Blender.
        export: folder of the export, with `metadata.json`.
        files: files to import.
        suffix: their suffix, also of the files whose triangles `metadata.json` counts.
        double: number of duplicate triangles, which Blender drops.

    Raises:
        Fault: triangles or textures are missing, or coordinates are wrong.
    """
    about = json.loads((export / "metadata.json").read_text(encoding="utf-8"))
    wanted = sum(count for file, count in about["triangles_by_file"].items() if file.endswith(suffix)) - double
    found = _imported(command, files, suffix)
    metrics = {name: found[name] for name in ("objects", "triangles", "textures")}
    if found["triangles"] != wanted:
        raise Fault(f"{found['triangles']} triangles of {wanted}", metrics)
    if found["missing"] or found["untextured"]:
        raise Fault(f"without texture: {(found['missing'] + found['untextured'])[0]}", metrics)
    if suffix != ".dae":  # the SDF, not the DAE, positions models
        low, high = _box(about)
        far = max(abs(a - b) for a, b in zip([*low, *high], [*found["low"], *found["high"]], strict=True))
        if far > MAX_BOX_ERROR_M:
            raise Fault(f"its bounding box is {far:.3f} m off", metrics)
        metrics["box_off_m"] = round(far, 4)
    return metrics


def _imported(command: Sequence[str], files: Sequence[Path], suffix: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as work:
        script = Path(work) / "import.py"
        names = json.dumps([str(file.resolve()) for file in files])
        script.write_text(SCRIPT.format(files=names, suffix=suffix, prefix=OUTPUT_PREFIX), encoding="utf-8")
        done = subprocess.run([*command, str(script)], capture_output=True, text=True, timeout=TIMEOUT_S)
    output = [line for line in done.stdout.splitlines() if line.startswith(OUTPUT_PREFIX)]
    if done.returncode or not output:
        raise Fault(f"Blender fails: {(done.stderr or done.stdout).strip().splitlines()[-1:]}")
    return dict(json.loads(output[0].removeprefix(OUTPUT_PREFIX)))


def _box(about: dict[str, Any]) -> tuple[list[float], list[float]]:
    """Corners of the world's bounding box from its `metadata.json`, metres from its origin."""
    parts = []
    if "tiles" in about:
        for tile in about["tiles"].values():
            parts.append([[tile[end][k] + tile["offset_m"][k] for k in range(3)] for end in ("low_m", "high_m")])
    else:
        shift = [a - b for a, b in zip(about["origin_m"], about["world_origin_m"], strict=True)]
        for group in about["groups"].values():
            parts.append([[group[end][k] + shift[k] for k in range(3)] for end in ("low_m", "high_m")])
    return [min(p[0][k] for p in parts) for k in range(3)], [max(p[1][k] for p in parts) for k in range(3)]
