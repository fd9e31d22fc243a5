"""3D Tiles 1.1 (OGC), for Cesium and what streams worlds as it does: `tileset.json` and a GLB a tile in `tiles3d/`.

Each tile has a transform of its own onto the earth, taken at its middle: scale and direction of the CRS's grid, and the
earth's curvature, are right within a tile of some 100 m to less than a millimetre, however far the survey reaches.
Without a CRS tiles stay in metres around the scene's origin.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.io import crs, glb
from scan2sim.pipeline.io.files import make_folder
from scan2sim.pipeline.io.scene import Scene, SceneTile
from scan2sim.pipeline.io.scenes import SceneParams
from scan2sim.pipeline.step import Report
from scan2sim.pipeline.types import F64

FOLDER = "tiles3d"
SPAN = 50.0
"""Metres to each side by which the grid's scale and direction are taken."""


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the tileset, and the content of its tiles."""
    make_folder(folder / FOLDER)
    triangles, children, corners = {}, [], []
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        surfaces, file = tile.surfaces(), f"{FOLDER}/{tile.name}.glb"
        glb.write(folder / file, surfaces, params.jpeg_quality)
        triangles[file] = sum(len(surface.shape) for surface in surfaces)
        place = transform(scene, tile)
        low, high = np.asarray(tile.low), np.asarray(tile.high)
        children.append(
            {
                "transform": place.T.ravel().tolist(),
                "boundingVolume": {"box": _box(low, high)},
                "geometricError": 0,
                "content": {"uri": file},
            }
        )
        corners.append(_corners(low, high) @ place[:3, :3].T + place[:3, 3])
    every = np.concatenate(corners)
    low, high = every.min(axis=0), every.max(axis=0)
    error = float(np.linalg.norm(high - low))
    root = {"boundingVolume": {"box": _box(low, high)}, "geometricError": error, "refine": "ADD", "children": children}
    about = {"crs": scene.frame.crs, "world_origin_m": scene.origin, "unit_m": scene.frame.unit}
    tileset = {"asset": {"version": "1.1"}, "geometricError": error, "root": root, "extras": about}
    (folder / "tileset.json").write_text(json.dumps(tileset, indent=1) + "\n", encoding="utf-8")
    return triangles


def transform(scene: Scene, tile: SceneTile) -> F64:
    """(4, 4) of a tile's local metres, z up, to earth-centred ones; to the scene's where it has no CRS."""
    place = np.eye(4)
    if scene.frame.crs == crs.LOCAL:
        place[:3, 3] = tile.offset
        return place
    middle = (np.asarray(tile.low) + np.asarray(tile.high)) / 2
    steps = SPAN * np.concatenate([np.eye(3), -np.eye(3)])
    around = crs.to_ecef(tile.frame, middle + np.concatenate([np.zeros((1, 3)), steps]))
    place[:3, :3] = ((around[1:4] - around[4:]) / (2 * SPAN)).T
    place[:3, 3] = around[0] - place[:3, :3] @ middle
    return place


def _box(low: F64, high: F64) -> list[float]:
    """A box as 3D Tiles have it: its middle and three half axes."""
    half: Any = np.diag((high - low) / 2)
    return [*((low + high) / 2).tolist(), *half.ravel().tolist()]


def _corners(low: F64, high: F64) -> F64:
    choice = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.where(choice == 0, low, high)
