"""Surveyed points 5 km from a world's origin: coordinates after a round trip through every format."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from tests.fakes import synthetic
from tests.fakes.scene_readers import READERS, survey_error

TILE_DISTANCE_M = 5000.1234567


def georeference(folder: Path) -> dict[str, Any]:
    """Print the distances in metres between surveyed points and the same points read from each format.

    Returns:
        `georef_max_m`: the largest distance.
    """
    shutil.rmtree(folder, ignore_errors=True)
    scene = synthetic.scene(folder / "scene", tiles=2, apart=TILE_DISTANCE_M)
    off = {}
    for name in READERS:
        if plugins.missing(world_formats.PACKAGE, name):
            continue
        world_formats.write(scene, [name], folder / name, SceneParams(), silent)
        try:
            off[name] = round(survey_error(folder / name, scene, name), 6)
        except pytest.skip.Exception:  # its reader isn't installed
            continue
    print(f"{'all':8} {'surveyed':10} {json.dumps(off)}", flush=True)
    return {"georef_max_m": max(off.values())}
