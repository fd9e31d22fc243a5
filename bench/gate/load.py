"""Cost of loading a tile in Gazebo's MeshManager, compared with one mesh of a million triangles (D3.2, section 4.2).

Both are synthetic rolling ground: the tile with the maximum number of triangles of the default settings (terrain and
buildings 100,000 each, vegetation 300,000, collision mesh 50,000) as OBJ; the single mesh as OBJ and as Collada. The
gate's own worlds are measured as well.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.io.mesh_formats import PageNames, collada, obj
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.textured_mesh import Textured, vertex_normals
from tests.fakes.gazebo import checker

SINGLE_MESH_TRIANGLES = 1_000_000
TILE_TRIANGLES = {"terrain": 100_000, "building": 100_000, "vegetation": 300_000}
COLLISION_TRIANGLES = 50_000
ROUNDS = 3


def load(folder: Path, worlds: Mapping[str, Path]) -> dict[str, Any]:
    """Print CPU seconds and megabytes of each.

    Args:
        folder: folder for generated files.
        worlds: further runs to measure, by name.

    Returns:
        `load_ratio`: cost of the tile relative to the single OBJ mesh, in seconds or memory, whichever is larger.
    """
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "page_0.png"
    cv2.imwrite(str(page), np.full((64, 64, 3), 128, np.uint8))
    for form in (obj, collada):
        form.write(folder / f"million{form.SUFFIX}", sheet(SINGLE_MESH_TRIANGLES, page), names("million"))
    tile = []
    for group, count in TILE_TRIANGLES.items():
        for i, part in enumerate(sheet(count, page).parts(SceneParams().max_visual_triangles)):
            tile.append(folder / f"{group}_{i}.obj")
            obj.write(tile[-1], part, names(group))
    obj.write_plain(folder / "collision.obj", replace(sheet(COLLISION_TRIANGLES, page).mesh, uv=None, page=None))
    files = {
        "tile, OBJ": [*tile, folder / "collision.obj"],
        "single mesh, OBJ": [folder / "million.obj"],
        "single mesh, Collada": [folder / "million.dae"],
        **{f"{name}, OBJ": sorted(run.glob("world/models/*/meshes/*.obj")) for name, run in worlds.items()},
    }
    taken = {what: minima([checker.load_meshes(*paths) for _ in range(ROUNDS)]) for what, paths in files.items()}
    for what, metrics in taken.items():
        print(f"load     {what:22} {json.dumps(metrics)}", flush=True)
    ours, single = taken["tile, OBJ"], taken["single mesh, OBJ"]
    return {"load_ratio": round(max(ours[key] / single[key] for key in ours), 3)}


def minima(rounds: list[dict[str, float]]) -> dict[str, float]:
    """Smallest values of several measurements, as other load on the machine only increases them."""
    return {key: round(min(one[key] for one in rounds), 3) for key in rounds[0]}


def names(group: str) -> PageNames:
    """Names for a mesh with a single texture page."""
    return PageNames(group, (f"{group}_0",), ("page_0.png",), (0,))


def sheet(triangles: int, page: Path) -> Textured:
    """A rolling ground with about `triangles` triangles, on one texture page."""
    n = round(np.sqrt(triangles / 2))
    x, y = np.meshgrid(np.linspace(-50, 50, n + 1), np.linspace(-50, 50, n + 1), indexing="ij")
    vertices = np.stack([x, y, np.sin(x / 7) * np.cos(y / 9)], axis=2).reshape(-1, 3).astype(np.float32)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a = (i * (n + 1) + j).ravel()
    quads = np.stack([a, a + n + 1, a + n + 2, a + 1], axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    uv = (vertices[faces][..., :2] / 100 + 0.5).astype(np.float32)
    mesh = Mesh(Frame(), vertices, faces, uv=uv, page=np.zeros(len(faces), np.int16))
    return Textured(mesh, vertex_normals(mesh), (page,))
