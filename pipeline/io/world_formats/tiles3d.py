"""3D Tiles 1.1 (OGC), for Cesium and what streams worlds as it does: `tileset.json` and a GLB a tile in `tiles3d/`.

Each tile has a transform of its own onto the earth, taken at its middle, and its vertices are placed there one by one:
scale and direction of the CRS's grid, and the earth's curvature, are right however far the survey reaches. Without a
CRS tiles stay in metres around the scene's origin.

Where a scene has levels of detail (`Scene.coarse`), the coarsest is the root, and each level is replaced by the finer
ones that it stands for: `tiles3d/level<n>/<tile>.glb`. Their geometric error is the measured distance from the scene's
own tiles, or what the width of its texels asks for if that is more; both stand in the tile's `extras`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import glb
from scan2sim.pipeline.io.worlds.scene import Level, Scene, SceneTile, Surface

FOLDER = "tiles3d"
SPAN = 50.0
"""Metres to each side by which the grid's scale and direction are taken."""
PIXELS = 16.0
"""Of the screen, that a geometric error may span before viewers ask for what is finer: Cesium's default."""
LEVELS = 3
"""Of each tile, where nobody asks for another number."""


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the tileset, and the content of its tiles."""
    made = _Made(scene, folder, params, report)
    if scene.coarse is None:
        root = made.above([made.node(Level(tile)) for tile in scene.tiles])
    else:
        root = made.node(scene.coarse)
    about = {"crs": scene.frame.crs, "world_origin_m": scene.origin, "unit_m": scene.frame.unit}
    tileset = {
        "asset": {"version": "1.1"},
        "geometricError": float(np.linalg.norm(root.high - root.low)),
        "root": {"transform": root.place.T.ravel().tolist(), **root.json},
        "extras": about,
    }
    (folder / "tileset.json").write_text(json.dumps(tileset, indent=1) + "\n", encoding="utf-8")
    return made.triangles


@dataclass(frozen=True)
class _Node:
    """A tile of the tileset.

    Attributes:
        json: as the tileset has it, its transform left out.
        place: (4, 4) from its metres to the earth's, or the scene's.
        low, high: its box there, its own metres.
    """

    json: dict[str, Any]
    place: F64
    low: F64
    high: F64


class _Made:
    """What is written of a scene; `triangles` of all files."""

    def __init__(self, scene: Scene, folder: Path, params: SceneParams, report: Report) -> None:
        self._scene, self._folder, self._params, self._report = scene, folder, params, report
        self.triangles: dict[str, int] = {}

    def node(self, level: Level) -> _Node:
        """A level, and all that is finer."""
        self._report(len(self.triangles) / (len(self.triangles) + len(self._scene.tiles)), level.tile.name)
        place = transform(self._scene, level.tile)
        file = f"{FOLDER}/{f'level{level.height}/' if level.height else ''}{level.tile.name}.glb"
        low, high = self._write(level.tile, place, file)
        error = max(level.error, PIXELS * level.texel) if level.finer else 0.0
        node: dict[str, Any] = {"geometricError": round(error, 4), "content": {"uri": file}}
        if level.finer:
            node |= {"refine": "REPLACE", "extras": {"error_m": level.error, "texel_m": level.texel}}
        return _with(_Node(node, place, low, high), [self.node(finer) for finer in level.finer])

    def above(self, nodes: list[_Node]) -> _Node:
        """What holds several tiles and shows nothing itself."""
        corners = np.concatenate(
            [_corners(node.low, node.high) @ node.place[:3, :3].T + node.place[:3, 3] for node in nodes]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        error = float(np.linalg.norm(high - low))
        return _with(_Node({"geometricError": error, "refine": "ADD"}, np.eye(4), low, high), nodes)

    def _write(self, tile: SceneTile, place: F64, file: str) -> tuple[F64, F64]:
        """Write a tile's content; corners of its box."""
        back = np.linalg.inv(place)

        def placed(surface: Surface) -> Surface:
            shape = surface.shape
            there = on_earth(self._scene, tile, shape.mesh.vertices)
            vertices = (there @ back[:3, :3].T + back[:3, 3]).astype(np.float32)
            return replace(surface, shape=replace(shape, mesh=replace(shape.mesh, vertices=vertices)))

        surfaces = [placed(surface) for surface in tile.surfaces()]
        make_folder((self._folder / file).parent)
        glb.write(self._folder / file, surfaces, self._params, views=tile.views())
        self.triangles[file] = sum(len(surface.shape) for surface in surfaces)
        every = np.concatenate([surface.shape.mesh.vertices for surface in surfaces]).astype(np.float64)
        return every.min(axis=0), every.max(axis=0)


def _with(node: _Node, children: list[_Node]) -> _Node:
    """A node with its children, in a box that holds them, too."""
    back = np.linalg.inv(node.place)
    low, high, inside = node.low, node.high, []
    for child in children:
        onto = back @ child.place
        low, high = _around(low, high, child, onto)
        inside.append({"transform": onto.T.ravel().tolist(), **child.json})
    about = {"boundingVolume": {"box": _box(low, high)}, **node.json, **({"children": inside} if inside else {})}
    return _Node(about, node.place, low, high)


def _around(low: F64, high: F64, node: _Node, place: F64) -> tuple[F64, F64]:
    """A box that holds a node's, too, which is placed in its metres."""
    corners = _corners(node.low, node.high) @ place[:3, :3].T + place[:3, 3]
    return np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))


def on_earth(scene: Scene, tile: SceneTile, local: npt.ArrayLike) -> F64:
    """(N, 3) earth-centred metres of places in a tile; the scene's where it has no CRS."""
    if scene.frame.crs == crs.LOCAL:
        return np.asarray(local, np.float64) + tile.offset
    return crs.to_ecef(tile.frame, local)


def transform(scene: Scene, tile: SceneTile) -> F64:
    """(4, 4) of a tile's local metres, z up, to earth-centred ones; to the scene's where it has no CRS."""
    place = np.eye(4)
    middle = (np.asarray(tile.low) + np.asarray(tile.high)) / 2
    steps = SPAN * np.concatenate([np.eye(3), -np.eye(3)])
    around = on_earth(scene, tile, middle + np.concatenate([np.zeros((1, 3)), steps]))
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
