"""three.js in headless Chromium: every triangle and texture is loaded; an image from a photo's pose is compared."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from bench.consumers import Fault
from bench.gate import renderings
from bench.gate.places import WorldReference
from tests import threejs

FORMAT = "glb"


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return threejs.missing()


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Load all GLBs and render from a photo's pose."""
    wanted = json.loads((export / "metadata.json").read_text(encoding="utf-8"))["triangles_by_file"]
    seen = renderings.photo(reference)
    size = seen.camera.width, seen.camera.height
    with tempfile.TemporaryDirectory() as work, threejs.viewer(export, list(wanted), Path(work), size) as view:
        picture = view.picture(seen.camera, seen.pose)
    if view.told["triangles"] != sum(wanted.values()):
        raise Fault(f"{view.told['triangles']} of {sum(wanted.values())} triangles are loaded", view.told)
    likeness = renderings.compare(export, "threejs", seen, picture, (picture != threejs.SKY).any(axis=2))
    return {**view.told, **likeness}
