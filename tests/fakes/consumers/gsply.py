"""gsply reads PLY and SPZ of splats: all of them are there, and from a photo's pose they look like the photo."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from tests.fakes.world_checks import Fault, renderings
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "splats"
STEP_M = 0.004
"""Largest step of SPZ's positions."""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if importlib.util.find_spec("gsply") else "gsply isn't installed (pip install gsply)"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Read all files, compare SPZ with PLY, and render PLY from a photo's pose.

    Raises:
        Fault: files differ from each other, or the image from the photo.
    """
    from scan2sim.pipeline.core.splats import SplatLayer, Splats
    from scan2sim.pipeline.io import splat_files
    from scan2sim.texturing.splats.view import SplatRenderer

    plain, turned = ([splat_files.read(path) for path in sorted(export.glob(f"*.{end}"))] for end in ("ply", "spz"))
    for a, b in zip(plain, turned, strict=True):
        if len(a) != len(b):
            raise Fault(f"{len(b)} of {len(a)} splats are in SPZ")
        if (apart := float(np.abs(a.y_up().xyz - b.xyz).max(initial=0))) > STEP_M:
            raise Fault(f"positions in SPZ are up to {apart:.3f} m away from those in PLY")
    photo = renderings.photo(reference)
    whole = Splats(np.concatenate([one.parameters for one in plain]))
    grey = np.full((2, 4, 3), 0.5, np.float32)
    image = SplatRenderer(SplatLayer(whole, grey)).view(photo.camera, photo.pose)
    likeness = renderings.compare(export, "gsply", photo, image.rgb, np.ones(image.cover.shape, bool))
    return {
        "splats": len(whole),
        "megabytes": round(sum(f.stat().st_size for f in export.glob("*.spz")) / 1e6, 1),
    } | likeness
