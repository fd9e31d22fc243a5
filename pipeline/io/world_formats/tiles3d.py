"""3D Tiles 1.1 (OGC), for streaming viewers such as Cesium: `tileset.json`, and one GLB per tile in `tiles3d/`.

Each tile has its own transform to earth-centred coordinates, computed at its centre, and each vertex is transformed
exactly: scale and direction of the CRS's grid and the earth's curvature are correct for surveys of any extent. Without
a CRS tiles stay in metres around the scene's origin.

If a scene has levels of detail (`Scene.coarse`), the coarsest is the root, and each level is replaced by its finer
ones: `tiles3d/level<n>/<tile>.glb`. Their geometric error is the measured distance from the scene's own tiles, or the
error that corresponds to their texel size if that is larger; both are in the tile's `extras`.
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
DIFFERENCE_STEP_M = 50.0
"""Step of the central differences that give the grid's scale and direction."""
MAX_SCREEN_SPACE_ERROR_PX = 16.0
"""Screen-space error at which viewers load finer levels: Cesium's default."""
LEVELS = 3
"""Default number of levels of detail per tile."""


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the tileset and the content of its tiles."""
    writer = _Writer(scene, folder, params, report)
    if scene.coarse is None:
        root = writer.parent([writer.node(Level(tile)) for tile in scene.tiles])
    else:
        root = writer.node(scene.coarse)
    extras = {"crs": scene.frame.crs, "world_origin_m": scene.origin, "unit_m": scene.frame.unit}
    tileset = {
        "asset": {"version": "1.1"},
        "geometricError": float(np.linalg.norm(root.high - root.low)),
        "root": {"transform": root.transform.T.ravel().tolist(), **root.json},
        "extras": extras,
    }
    (folder / "tileset.json").write_text(json.dumps(tileset, indent=1) + "\n", encoding="utf-8")
    return writer.triangles


@dataclass(frozen=True)
class _Node:
    """A tile of the tileset.

    Attributes:
        json: its entry in the tileset, without the transform.
        transform: (4, 4) from its own coordinates to earth-centred ones, or to the scene's.
        low, high: corners of its bounding box, own coordinates, metres.
    """

    json: dict[str, Any]
    transform: F64
    low: F64
    high: F64


class _Writer:
    """Writes the tiles of a scene; `triangles` counts those of each file."""

    def __init__(self, scene: Scene, folder: Path, params: SceneParams, report: Report) -> None:
        self._scene, self._folder, self._params, self._report = scene, folder, params, report
        self.triangles: dict[str, int] = {}

    def node(self, level: Level) -> _Node:
        """Write a level and all finer ones."""
        self._report(len(self.triangles) / (len(self.triangles) + len(self._scene.tiles)), level.tile.name)
        to_earth = transform(self._scene, level.tile)
        file = f"{FOLDER}/{f'level{level.height}/' if level.height else ''}{level.tile.name}.glb"
        low, high = self._write(level.tile, to_earth, file)
        error = max(level.error, MAX_SCREEN_SPACE_ERROR_PX * level.texel) if level.finer else 0.0
        node: dict[str, Any] = {"geometricError": round(error, 4), "content": {"uri": file}}
        if level.finer:
            node |= {"refine": "REPLACE", "extras": {"error_m": level.error, "texel_m": level.texel}}
        return _with_children(_Node(node, to_earth, low, high), [self.node(finer) for finer in level.finer])

    def parent(self, nodes: list[_Node]) -> _Node:
        """A parent of several tiles without content of its own."""
        corners = np.concatenate(
            [_corners(node.low, node.high) @ node.transform[:3, :3].T + node.transform[:3, 3] for node in nodes]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        error = float(np.linalg.norm(high - low))
        return _with_children(_Node({"geometricError": error, "refine": "ADD"}, np.eye(4), low, high), nodes)

    def _write(self, tile: SceneTile, to_earth: F64, file: str) -> tuple[F64, F64]:
        """Write a tile's content; returns the corners of its bounding box."""
        from_earth = np.linalg.inv(to_earth)

        def placed(surface: Surface) -> Surface:
            shape = surface.shape
            earth = on_earth(self._scene, tile, shape.mesh.vertices)
            vertices = (earth @ from_earth[:3, :3].T + from_earth[:3, 3]).astype(np.float32)
            return replace(surface, shape=replace(shape, mesh=replace(shape.mesh, vertices=vertices)))

        surfaces = [placed(surface) for surface in tile.surfaces()]
        make_folder((self._folder / file).parent)
        glb.write(self._folder / file, surfaces, self._params, views=tile.views())
        self.triangles[file] = sum(len(surface.shape) for surface in surfaces)
        vertices = np.concatenate([surface.shape.mesh.vertices for surface in surfaces]).astype(np.float64)
        return vertices.min(axis=0), vertices.max(axis=0)


def _with_children(node: _Node, children: list[_Node]) -> _Node:
    """A node with its children, and a bounding box that contains theirs."""
    inverse = np.linalg.inv(node.transform)
    low, high, entries = node.low, node.high, []
    for child in children:
        relative = inverse @ child.transform
        low, high = _extended(low, high, child, relative)
        entries.append({"transform": relative.T.ravel().tolist(), **child.json})
    body = {"boundingVolume": {"box": _box(low, high)}, **node.json, **({"children": entries} if entries else {})}
    return _Node(body, node.transform, low, high)


def _extended(low: F64, high: F64, node: _Node, relative: F64) -> tuple[F64, F64]:
    """A box extended by the box of a node, which `relative` (4, 4) transforms to its coordinates."""
    corners = _corners(node.low, node.high) @ relative[:3, :3].T + relative[:3, 3]
    return np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))


def on_earth(scene: Scene, tile: SceneTile, local: npt.ArrayLike) -> F64:
    """Earth-centred coordinates (N, 3) of points in a tile, metres; scene coordinates without a CRS."""
    if scene.frame.crs == crs.LOCAL:
        return np.asarray(local, np.float64) + tile.offset
    return crs.to_ecef(tile.frame, local)


def transform(scene: Scene, tile: SceneTile) -> F64:
    """Transform (4, 4) from a tile's local metres, z up, to earth-centred coordinates; to the scene's without a CRS."""
    matrix = np.eye(4)
    middle = (np.asarray(tile.low) + np.asarray(tile.high)) / 2
    steps = DIFFERENCE_STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
    around = on_earth(scene, tile, middle + np.concatenate([np.zeros((1, 3)), steps]))
    matrix[:3, :3] = ((around[1:4] - around[4:]) / (2 * DIFFERENCE_STEP_M)).T
    matrix[:3, 3] = around[0] - matrix[:3, :3] @ middle
    return matrix


def _box(low: F64, high: F64) -> list[float]:
    """A bounding box of 3D Tiles: centre and three half axes."""
    half: Any = np.diag((high - low) / 2)
    return [*((low + high) / 2).tolist(), *half.ravel().tolist()]


def _corners(low: F64, high: F64) -> F64:
    choice = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.where(choice == 0, low, high)
