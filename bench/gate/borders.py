"""Height steps of the drivable ground where tiles meet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import group_of
from scan2sim.pipeline.core.types import F64, Mesh
from scan2sim.pipeline.geometry.boundary_curve import curve
from scan2sim.pipeline.geometry.coordinate_grid import world
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile

SAMPLE_SPACING_M = 0.02
"""Distance along a border between two samples."""
SAMPLE_OFFSET_M = 0.002
"""Distance behind the border at which each tile's ground is sampled."""


def border_steps(scene: Scene, tiles: Sequence[Path]) -> dict[str, Any]:
    """Height differences in metres between neighbouring tiles at their borders, and total length of the borders."""
    grounds = {tile.name: _ground(tile) for tile in scene.tiles}
    cells = {tile.name: read_tile(folder).cell for tile, folder in zip(scene.tiles, tiles, strict=True)}
    found, length = [np.zeros(0)], 0.0
    for name, cell in cells.items():
        for other in cell.neighbours if cell else ():
            if cell is None or name > other or other not in grounds:
                continue
            seeds = np.asarray(cell.seed), np.asarray(cell.neighbours[other])
            across = (seeds[1] - seeds[0]) / np.linalg.norm(seeds[1] - seeds[0])
            points = _along(grounds[name], cell.beyond(other, world(grounds[name])[:, :2]))
            heights = [_height(grounds[n], points, s * SAMPLE_OFFSET_M * across) for n, s in ((name, -1), (other, 1))]
            step = np.abs(heights[0] - heights[1])
            found.append(step[np.isfinite(step)])
            length += SAMPLE_SPACING_M * len(points)
    all_steps = np.concatenate(found)
    return {
        "border_m": round(length, 1),
        "border_both": round(len(all_steps) * SAMPLE_SPACING_M / length, 4) if length else 0.0,
        "border_step_p95_m": round(float(np.percentile(all_steps, 95)), 5),
        "border_step_max_m": round(float(all_steps.max()), 5),
    }


def _ground(tile: SceneTile) -> Mesh:
    solid = tile.solid()
    assert solid.classification is not None
    return solid.keep(group_of()[solid.classification] == 0)


def _along(ground: Mesh, distance: F64) -> F64:
    """(N, 3) points along a ground's boundary edges on a border, from its vertices' distances (V,); world, metres."""
    edges = curve(ground.faces, np.abs(distance) < SAMPLE_OFFSET_M).edges
    a, b = world(ground)[edges[:, 0]], world(ground)[edges[:, 1]]
    count = np.maximum(1, np.rint(np.linalg.norm(b - a, axis=1) / SAMPLE_SPACING_M)).astype(int)
    which = np.repeat(np.arange(len(edges)), count)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[which]
    return np.asarray(a[which] + share[:, None] * (b - a)[which])


def _height(ground: Mesh, points: F64, shift: F64) -> F64:
    """(N,) heights of the ground near points (N, 3), shifted horizontally by `shift` (2,); NaN without ground."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(ground.vertices, ground.faces.astype(np.uint32))
    start = points - np.asarray(ground.frame.origin) + np.array([*shift, 0.5])
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), start.shape)
    far = scene.cast_rays(np.concatenate([start, down], axis=1).astype(np.float32))["t_hit"].numpy()
    return np.where(far < 1.0, start[:, 2] - far + ground.frame.origin[2], np.nan)
