"""Tilesets of 3D Tiles 1.1: transforms of a scene's tiles to the earth, bounding boxes, parents of tiles."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile

DIFFERENCE_STEP_M = 50.0
"""Step of the central differences that give the grid's scale and direction."""
MAX_SCREEN_SPACE_ERROR_PX = 16.0
"""Screen-space error at which viewers load finer levels: Cesium's default."""


@dataclass(frozen=True)
class Node:
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


def write(path: Path, scene: Scene, root: Node, **properties: Any) -> None:
    """Write the tileset of a root with its children; `properties` are further ones of the tileset."""
    extras = {"crs": scene.frame.crs, "world_origin_m": scene.origin, "unit_m": scene.frame.unit}
    tileset = {
        "asset": {"version": "1.1"},
        "geometricError": float(np.linalg.norm(root.high - root.low)),
        "root": {"transform": root.transform.T.ravel().tolist(), **root.json},
        "extras": extras,
        **properties,
    }
    path.write_text(json.dumps(tileset, indent=1) + "\n", encoding="utf-8")


def parent(nodes: list[Node]) -> Node:
    """A parent of several tiles without content of its own."""
    corners = np.concatenate(
        [_corners(node.low, node.high) @ node.transform[:3, :3].T + node.transform[:3, 3] for node in nodes]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    error = float(np.linalg.norm(high - low))
    return with_children(Node({"geometricError": error, "refine": "ADD"}, np.eye(4), low, high), nodes)


def with_children(node: Node, children: list[Node]) -> Node:
    """A node with its children, and a bounding box that contains theirs."""
    inverse = np.linalg.inv(node.transform)
    low, high, entries = node.low, node.high, []
    for child in children:
        relative = inverse @ child.transform
        low, high = _extended(low, high, child, relative)
        entries.append({"transform": relative.T.ravel().tolist(), **child.json})
    body = {"boundingVolume": {"box": _box(low, high)}, **node.json, **({"children": entries} if entries else {})}
    return Node(body, node.transform, low, high)


def _extended(low: F64, high: F64, node: Node, relative: F64) -> tuple[F64, F64]:
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


def placed(scene: Scene, tile: SceneTile, to_earth: F64, local: npt.ArrayLike) -> F64:
    """Points (N, 3) of a tile in the coordinates that `to_earth` transforms exactly to their place on the earth."""
    from_earth = np.linalg.inv(to_earth)
    return on_earth(scene, tile, local) @ from_earth[:3, :3].T + from_earth[:3, 3]


def _box(low: F64, high: F64) -> list[float]:
    """A bounding box of 3D Tiles: centre and three half axes."""
    half: Any = np.diag((high - low) / 2)
    return [*((low + high) / 2).tolist(), *half.ravel().tolist()]


def _corners(low: F64, high: F64) -> F64:
    choice = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.where(choice == 0, low, high)
