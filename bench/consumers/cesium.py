"""Cesium in headless Chromium: which levels it loads from afar and near by, and a picture from a photo's pose."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from bench.consumers import Fault
from bench.gate import renderings
from bench.gate.places import Places
from scan2sim.pipeline.core.types import F64, Frame
from scan2sim.pipeline.io.geodata import crs
from tests import cesium

FORMAT = "tiles3d"
SMALL = 8.0
"""Pixels that the coarsest level's error spans from afar: it is fine enough there."""
ALL = 0.01
"""Pixels that no level's error stays below but the finest's."""
AHEAD = 10.0
"""Metres to places by which directions are taken."""
LEVEL = "/level"
"""Of contents that are coarser ones."""


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return cesium.missing()


def check(export: Path, places: Places) -> dict[str, Any]:
    """Look from a photo's pose, and from above; see the module.

    `levels_differ` are grey levels (mean) between the picture with coarser levels and that with the finest alone.
    """
    tileset = json.loads((export / "tileset.json").read_text(encoding="utf-8"))
    about = tileset["extras"]
    if about["crs"] == crs.LOCAL:
        raise Fault("a world without a CRS is nowhere on Cesium's earth")
    frame = Frame(about["crs"], tuple(about["world_origin_m"]), about["unit_m"])
    seen = renderings.photo(places)
    focal, centre = seen.camera.fx, (seen.camera.cx, seen.camera.cy)
    size = seen.camera.width, seen.camera.height
    with tempfile.TemporaryDirectory() as work, cesium.viewer(export, Path(work), size) as view:
        view.look(*_onto_earth(frame, seen.pose), focal=focal, centre=centre, pixels=ALL)
        finest = view.picture()
        near = view.look(*_onto_earth(frame, seen.pose), focal=focal, centre=centre)
        picture = view.picture()
        far = view.look(*_onto_earth(frame, _above(tileset, places, focal)), focal=focal, centre=centre)
    if not any(LEVEL not in content for content in near):
        raise Fault(f"the finest level isn't shown near by, but {near}")
    if far != [tileset["root"]["content"]["uri"]]:
        raise Fault(f"the coarsest level isn't shown from afar, but {far}")
    likeness = renderings.compare(export, "cesium", seen, picture, (picture != cesium.SKY).any(axis=2))
    differ = round(float(np.abs(picture.astype(float) - finest).mean()), 2)
    return {"shown_near": len(near), "shown_far": len(far), "levels_differ": differ, **likeness}


def _above(tileset: dict[str, Any], places: Places, focal: float) -> F64:
    """A pose that looks down on the world from where its coarsest level is fine enough."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = places.ground.mean(axis=0)
    pose[2, 3] += tileset["root"]["geometricError"] * focal / SMALL
    return pose


def _onto_earth(frame: Frame, pose: F64) -> tuple[list[float], list[float], list[float]]:
    """Where a camera is, where it looks and what is up in its picture; earth-centred."""
    offsets = np.array([(0, 0, 0), (0, 0, AHEAD), (0, -AHEAD, 0)])
    at, ahead, up = crs.to_ecef(frame, offsets @ pose[:3, :3].T + pose[:3, 3])
    return at.tolist(), (ahead - at).tolist(), (up - at).tolist()
