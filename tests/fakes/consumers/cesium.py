"""Cesium in headless Chromium: levels of detail loaded from afar and near by, and an image from a photo's pose."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, Frame
from scan2sim.pipeline.io.geodata import crs
from tests.fakes import cesium
from tests.fakes.world_checks import Fault, renderings
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "tiles3d"
COARSEST_ERROR_PX = 8.0
"""Screen space error of the coarsest level from afar, at which it is fine enough."""
FINEST_ERROR_PX = 0.01
"""Screen space error that only the finest level meets."""
DIRECTION_DISTANCE_M = 10.0
"""Distance of points that define viewing directions."""
COARSE_CONTENT = "/level"
"""Part of the URIs of coarser levels."""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return cesium.missing()


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Render from a photo's pose and from above, see the module's docstring.

    `levels_differ` is the mean difference in grey levels between images with coarser and with the finest levels.
    """
    tileset = json.loads((export / "tileset.json").read_text(encoding="utf-8"))
    about = tileset["extras"]
    if about["crs"] == crs.LOCAL:
        raise Fault("a world without a CRS has no position on Cesium's globe")
    frame = Frame(about["crs"], tuple(about["world_origin_m"]), about["unit_m"])
    photo = renderings.photo(reference)
    focal, centre = photo.camera.fx, (photo.camera.cx, photo.camera.cy)
    size = photo.camera.width, photo.camera.height
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as work,
        cesium.viewer(export, Path(work), size) as view,
    ):
        view.look(*onto_earth(frame, photo.pose), focal=focal, centre=centre, pixels=FINEST_ERROR_PX)
        finest = view.screenshot()
        near = view.look(*onto_earth(frame, photo.pose), focal=focal, centre=centre)
        rendering = view.screenshot()
        far = view.look(*onto_earth(frame, _above(tileset, reference, focal)), focal=focal, centre=centre)
    if not any(COARSE_CONTENT not in content for content in near):
        raise Fault(f"near the ground, Cesium doesn't show the finest level, but {near}")
    if far != [tileset["root"]["content"]["uri"]]:
        raise Fault(f"from above, Cesium doesn't show the coarsest level, but {far}")
    likeness = renderings.compare(export, "cesium", photo, rendering, (rendering != cesium.SKY).any(axis=2))
    differ = round(float(np.abs(rendering.astype(float) - finest).mean()), 2)
    return {"shown_near": len(near), "shown_far": len(far), "levels_differ": differ, **likeness}


def _above(tileset: dict[str, Any], reference: WorldReference, focal: float) -> F64:
    """A pose that looks down on the world from where its coarsest level is fine enough."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = reference.ground.mean(axis=0)
    pose[2, 3] += tileset["root"]["geometricError"] * focal / COARSEST_ERROR_PX
    return pose


def onto_earth(frame: Frame, pose: F64) -> tuple[list[float], list[float], list[float]]:
    """Position, viewing direction and up direction of a camera, earth-centred."""
    offsets = np.array([(0, 0, 0), (0, 0, DIRECTION_DISTANCE_M), (0, -DIRECTION_DISTANCE_M, 0)])
    at, ahead, up = crs.to_ecef(frame, offsets @ pose[:3, :3].T + pose[:3, 3])
    return at.tolist(), (ahead - at).tolist(), (up - at).tolist()
