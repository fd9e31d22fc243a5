"""three.js in headless Chromium: every triangle and texture is loaded; a picture from a photo's pose beside it."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from bench.consumers import Fault
from bench.gate import renderings
from bench.gate.places import Places
from tests import threejs

FORMAT = "glb"


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return threejs.missing()


def check(export: Path, places: Places) -> dict[str, Any]:
    """Load all GLBs, and look from a photo's pose."""
    wanted = json.loads((export / "metadata.json").read_text(encoding="utf-8"))["triangles_by_file"]
    seen = renderings.photo(places)
    size = seen.camera.width, seen.camera.height
    with tempfile.TemporaryDirectory() as work, threejs.viewer(export, list(wanted), Path(work), size) as view:
        picture = view.picture(seen.camera, seen.pose)
    if view.told["triangles"] != sum(wanted.values()):
        raise Fault(f"{view.told['triangles']} triangles are loaded of {sum(wanted.values())}", view.told)
    likeness = renderings.compare(export, "threejs", seen, picture, (picture != threejs.SKY).any(axis=2))
    return {**view.told, **likeness}
