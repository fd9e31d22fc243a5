"""3D Tiles 1.1 (OGC), for streaming viewers such as Cesium: `tileset.json`, and one GLB per tile in `tiles3d/`.

Each tile has its own transform to earth-centred coordinates, computed at its centre, and each vertex is transformed
exactly: scale and direction of the CRS's grid and the earth's curvature are correct for surveys of any extent. Without
a CRS tiles stay in metres around the scene's origin.

If a scene has levels of detail (`Scene.coarse`), the coarsest is the root, and each level is replaced by its finer
ones: `tiles3d/level<n>/<tile>.glb`. Their geometric error is the measured distance from the scene's own tiles, or the
error that corresponds to their texel size if that is larger; both are in the tile's `extras`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import glb, tileset
from scan2sim.pipeline.io.worlds.scene import Level, Scene, SceneTile, Surface
from scan2sim.pipeline.io.worlds.tileset import MAX_SCREEN_SPACE_ERROR_PX, Node

FOLDER = "tiles3d"
LEVELS = 3
"""Default number of levels of detail per tile."""


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the tileset and the content of its tiles."""
    writer = _Writer(scene, folder, params, report)
    if scene.coarse is None:
        root = tileset.parent([writer.node(Level(tile)) for tile in scene.tiles])
    else:
        root = writer.node(scene.coarse)
    tileset.write(folder / "tileset.json", scene, root)
    return writer.triangles


class _Writer:
    """Writes the tiles of a scene; `triangles` counts those of each file."""

    def __init__(self, scene: Scene, folder: Path, params: SceneParams, report: Report) -> None:
        self._scene, self._folder, self._params, self._report = scene, folder, params, report
        self.triangles: dict[str, int] = {}

    def node(self, level: Level) -> Node:
        """Write a level and all finer ones."""
        self._report(len(self.triangles) / (len(self.triangles) + len(self._scene.tiles)), level.tile.name)
        to_earth = tileset.transform(self._scene, level.tile)
        file = f"{FOLDER}/{f'level{level.height}/' if level.height else ''}{level.tile.name}.glb"
        low, high = self._write(level.tile, to_earth, file)
        error = max(level.error, MAX_SCREEN_SPACE_ERROR_PX * level.texel) if level.finer else 0.0
        node: dict[str, Any] = {"geometricError": round(error, 4), "content": {"uri": file}}
        if level.finer:
            node |= {"refine": "REPLACE", "extras": {"error_m": level.error, "texel_m": level.texel}}
        return tileset.with_children(Node(node, to_earth, low, high), [self.node(finer) for finer in level.finer])

    def _write(self, tile: SceneTile, to_earth: F64, file: str) -> tuple[F64, F64]:
        """Write a tile's content; returns the corners of its bounding box."""

        def placed(surface: Surface) -> Surface:
            shape = surface.shape
            vertices = tileset.placed(self._scene, tile, to_earth, shape.mesh.vertices).astype(np.float32)
            return replace(surface, shape=replace(shape, mesh=replace(shape.mesh, vertices=vertices)))

        surfaces = [placed(surface) for surface in tile.surfaces()]
        make_folder((self._folder / file).parent)
        glb.write(self._folder / file, surfaces, self._params, views=tile.views())
        self.triangles[file] = sum(len(surface.shape) for surface in surfaces)
        vertices = np.concatenate([surface.shape.mesh.vertices for surface in surfaces]).astype(np.float64)
        return vertices.min(axis=0), vertices.max(axis=0)
