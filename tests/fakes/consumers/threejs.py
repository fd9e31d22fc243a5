"""three.js in headless Chromium: every triangle and texture is loaded; an image from a photo's pose is compared."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from tests.fakes import threejs
from tests.fakes.world_checks import Fault, renderings
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "glb"


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return threejs.missing()


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Load all GLBs and render from a photo's pose."""
    expected = json.loads((export / "metadata.json").read_text(encoding="utf-8"))["triangles_by_file"]
    photo = renderings.photo(reference)
    size = photo.camera.width, photo.camera.height
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as work,
        threejs.viewer(export, list(expected), Path(work), size) as view,
    ):
        rendering = view.render(photo.camera, photo.pose)
    if view.statistics["triangles"] != sum(expected.values()):
        raise Fault(f"{view.statistics['triangles']} of {sum(expected.values())} triangles are loaded", view.statistics)
    likeness = renderings.compare(export, "threejs", photo, rendering, (rendering != threejs.SKY).any(axis=2))
    return {**view.statistics, **likeness}
