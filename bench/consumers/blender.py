"""What Blender makes of exported files: run as a program, or as a module of Python, in a process of its own."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.consumers import Fault

LIMIT = 900.0
"""Seconds for all files."""
APART = 0.01
"""Metres by which corners of the box around all may be off."""
SAID = "SAID "
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
print({said!r} + json.dumps({{
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
    """The command that runs a script with Blender as a module."""
    return (sys.executable,)


def check(command: Sequence[str], export: Path, files: Sequence[Path], suffix: str, double: int = 0) -> dict[str, Any]:
    """Import files into one empty scene, and hold what is there against the export's own figures.

    Args:
        command: runs a script in Blender.
        export: folder of the export, with `metadata.json`.
        files: to be imported.
        suffix: of them, and of the files whose triangles `metadata.json` counts.
        double: triangles that Blender leaves out.

    Raises:
        Fault: triangles, textures or coordinates are missing, or they lie elsewhere.
    """
    about = json.loads((export / "metadata.json").read_text(encoding="utf-8"))
    wanted = sum(count for file, count in about["triangles_by_file"].items() if file.endswith(suffix)) - double
    found = _imported(command, files, suffix)
    figures = {name: found[name] for name in ("objects", "triangles", "textures")}
    if found["triangles"] != wanted:
        raise Fault(f"{found['triangles']} triangles of {wanted}", figures)
    if found["missing"] or found["untextured"]:
        raise Fault(f"without texture: {(found['missing'] + found['untextured'])[0]}", figures)
    if suffix != ".dae":  # models stand where the SDF puts them
        low, high = _box(about)
        far = max(abs(a - b) for a, b in zip([*low, *high], [*found["low"], *found["high"]], strict=True))
        if far > APART:
            raise Fault(f"its box is {far:.3f} m off", figures)
        figures["box_off_m"] = round(far, 4)
    return figures


def _imported(command: Sequence[str], files: Sequence[Path], suffix: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as place:
        script = Path(place) / "look.py"
        names = json.dumps([str(file.resolve()) for file in files])
        script.write_text(SCRIPT.format(files=names, suffix=suffix, said=SAID), encoding="utf-8")
        done = subprocess.run([*command, str(script)], capture_output=True, text=True, timeout=LIMIT)
    said = [line for line in done.stdout.splitlines() if line.startswith(SAID)]
    if done.returncode or not said:
        raise Fault(f"Blender fails: {(done.stderr or done.stdout).strip().splitlines()[-1:]}")
    return dict(json.loads(said[0].removeprefix(SAID)))


def _box(about: dict[str, Any]) -> tuple[list[float], list[float]]:
    """Corners of the world by its `metadata.json`, metres from its origin."""
    parts = []
    if "tiles" in about:
        for tile in about["tiles"].values():
            parts.append([[tile[end][k] + tile["offset_m"][k] for k in range(3)] for end in ("low_m", "high_m")])
    else:
        shift = [a - b for a, b in zip(about["origin_m"], about["world_origin_m"], strict=True)]
        for group in about["groups"].values():
            parts.append([[group[end][k] + shift[k] for k in range(3)] for end in ("low_m", "high_m")])
    return [min(p[0][k] for p in parts) for k in range(3)], [max(p[1][k] for p in parts) for k in range(3)]
