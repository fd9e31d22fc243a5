"""assimp, on CARLA's package: every FBX is complete and textured, and the road's meshes cover the road."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.types import F64, Frame, Mesh
from tests.fakes import scene_readers
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "carla"
ROAD = "_Road_Road_"
MAX_ROAD_DISTANCE_M = 0.1
"""Maximum distance from a point on the road to the road's mesh."""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if importlib.util.find_spec("assimp_py") else "assimp isn't installed (pip install assimp-py)"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Read all files, see the module's docstring."""
    counts = json.loads((export / "metadata.json").read_text(encoding="utf-8"))["triangles_by_file"]
    read = {file: list(scene_readers.fbx(export / file)) for file in counts if file.endswith(".fbx")}
    road = []
    for file, meshes in read.items():
        if sum(len(corners) for _, corners, *_ in meshes) != counts[file]:
            raise Fault(f"{file} has lost triangles: {counts[file]} expected")
        for name, corners, _, texture in meshes:
            if not texture.is_file():
                raise Fault(f"{file}: texture {texture.name} is missing")
            if ROAD in name:
                road.append(Body(_mesh(corners)))
    nearest, _ = Renderer(road).closest_points(reference.road.astype(np.float32))
    away = np.linalg.norm(nearest - reference.road, axis=1)
    metrics = {"files": len(read), "road_meshes": len(road), "off_road": int((~(away < MAX_ROAD_DISTANCE_M)).sum())}
    if metrics["off_road"] and not reference.rooms:  # a floor of rooms is no road
        raise Fault("the road's meshes don't cover the road", metrics)
    return metrics


def _mesh(corners: F64) -> Mesh:
    """Triangles (F, 3, 3) without shared vertices, as a mesh."""
    index = np.arange(3 * len(corners), dtype=np.int32)
    return Mesh(Frame(), corners.reshape(-1, 3).astype(np.float32), index.reshape(-1, 3))
