"""What loading a tile costs Gazebo's MeshManager, beside one mesh of a million triangles (D3.2, section 4.2).

Both are made here, of a rolling ground: the tile as full as the defaults allow (terrain and buildings of 100,000
triangles each, vegetation of 300,000, what is touched of 50,000), as OBJ; the single mesh as OBJ and as Collada. Beside
them the gate's own worlds, as they are.
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
from tests.gazebo import checker

MILLION = 1_000_000
TILE = {"terrain": 100_000, "building": 100_000, "vegetation": 300_000}
TOUCHED = 50_000
ROUNDS = 3


def load(folder: Path, worlds: Mapping[str, Path]) -> dict[str, Any]:
    """Print the processor's seconds, and megabytes, side by side.

    Args:
        folder: for what is made.
        worlds: runs that are measured as they are, by their names.

    Returns:
        `load_ratio`: the tile's part of what the single mesh takes as OBJ, of seconds or memory, whichever is more.
    """
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "page_0.png"
    cv2.imwrite(str(page), np.full((64, 64, 3), 128, np.uint8))
    for form in (obj, collada):
        form.write(folder / f"million{form.SUFFIX}", sheet(MILLION, page), names("million"))
    tile = []
    for group, count in TILE.items():
        for i, part in enumerate(sheet(count, page).parts(SceneParams().max_visual_triangles)):
            tile.append(folder / f"{group}_{i}.obj")
            obj.write(tile[-1], part, names(group))
    obj.write_plain(folder / "collision.obj", replace(sheet(TOUCHED, page).mesh, uv=None, page=None))
    files = {
        "tile, OBJ": [*tile, folder / "collision.obj"],
        "single mesh, OBJ": [folder / "million.obj"],
        "single mesh, Collada": [folder / "million.dae"],
        **{f"{name}, OBJ": sorted(run.glob("world/models/*/meshes/*.obj")) for name, run in worlds.items()},
    }
    taken = {what: least([checker.load_meshes(*paths) for _ in range(ROUNDS)]) for what, paths in files.items()}
    for what, figures in taken.items():
        print(f"load     {what:22} {json.dumps(figures)}", flush=True)
    ours, single = taken["tile, OBJ"], taken["single mesh, OBJ"]
    return {"load_ratio": round(max(ours[key] / single[key] for key in ours), 3)}


def least(rounds: list[dict[str, float]]) -> dict[str, float]:
    """The least of several measurements: what others do on the machine only adds to it."""
    return {key: round(min(one[key] for one in rounds), 3) for key in rounds[0]}


def names(group: str) -> PageNames:
    """Of one page."""
    return PageNames(group, (f"{group}_0",), ("page_0.png",), (0,))


def sheet(triangles: int, page: Path) -> Textured:
    """A rolling ground of about so many triangles, on one texture page."""
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
