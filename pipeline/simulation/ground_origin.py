"""Origin of the world on the ground: simulators place robots at z = 0 by default."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.classes import group_of
from scan2sim.pipeline.core.step import Inputs
from scan2sim.pipeline.core.types import Mesh

Vector = tuple[float, float, float]
INPUT = "origin"
"""Name of the optional input of steps that place something in the world."""


def ground_height(mesh: Mesh) -> float | None:
    """Height of the ground below the mesh's own origin, or of the nearest ground; metres, to a centimetre.

    Args:
        mesh: what bodies collide with, with classes.

    Returns:
        None if it has no ground.
    """
    import open3d as o3d

    codes = mesh.classification
    ground = mesh if codes is None else mesh.keep(group_of()[codes] == 0)
    if not len(ground):
        return None
    flat = ground.vertices * np.array([1, 1, 0], np.float32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(flat, ground.faces.astype(np.uint32))
    nearest = scene.compute_closest_points(np.zeros((1, 3), np.float32))
    u, v = nearest["primitive_uvs"].numpy()[0].astype(np.float64)
    heights = ground.corners[int(nearest["primitive_ids"][0].item()), :, 2]
    return round(float(heights @ (1 - u - v, u, v)), 2)


def save(path: Path, origin: Vector) -> None:
    """Write an origin in the CRS, metres."""
    path.write_text(json.dumps({"origin_m": list(origin)}) + "\n", encoding="utf-8")


def read(inputs: Inputs) -> Vector | None:
    """The origin among a step's inputs; None if there is none."""
    if INPUT not in inputs:
        return None
    x, y, z = json.loads(inputs[INPUT].read_text(encoding="utf-8"))["origin_m"]
    return x, y, z
