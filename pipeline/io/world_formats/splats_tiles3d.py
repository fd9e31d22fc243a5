"""3D Tiles 1.1 of 3D Gaussian splats, for CesiumJS: `splats_tileset.json`, and GLBs of SPZ in `splats3d/<tile>/`.

Each tile of the scene is placed as in `tiles3d`, and is a quadtree of levels of detail that replace each other
(`pipeline.io.worlds.splat_levels`). Cesium takes all contents of a tileset for splats if the tileset requires their
extensions, so that meshes have one of their own. There is no background: its shell would hide the tile from outside.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.splats import XYZ, Splats
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import splat_files
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.world_formats.splats import without_splats
from scan2sim.pipeline.io.worlds import splat_levels, tileset
from scan2sim.pipeline.io.worlds.gltf import splats as gltf
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile
from scan2sim.pipeline.io.worlds.splat_levels import SplatLevel
from scan2sim.pipeline.io.worlds.tileset import MAX_SCREEN_SPACE_ERROR_PX, Node

NEEDS = splat_files.NEEDS
FILE, FOLDER = "splats_tileset.json", "splats3d"
MERGED_PX = 2.0
"""Size in the image of the cells within which splats were merged, at which viewers load finer levels: smaller splats
than a third of a pixel are left out by Cesium, which widens them less than the camera in Python does."""
EXTENSIONS = [gltf.EXTENSION, gltf.SPZ_EXTENSION]


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the splats of all tiles that have some, one tile at a time; they have no triangles.

    Raises:
        DataError: no tile has splats.
    """
    nodes = []
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        if layer := tile.splats():
            nodes.append(_tile(scene, tile, layer.splats, folder))
    if not nodes:
        raise without_splats(scene)
    content = {"3DTILES_content_gltf": {"extensionsUsed": EXTENSIONS, "extensionsRequired": EXTENSIONS}}
    used = {"extensionsUsed": list(content), "extensions": content}
    tileset.write(folder / FILE, scene, tileset.parent(nodes), **used)
    return {}


def _tile(scene: Scene, tile: SceneTile, splats: Splats, folder: Path) -> Node:
    """Write the splats of a tile, local metres."""
    to_earth = tileset.transform(scene, tile)
    placed = splats.parameters.copy()
    placed[:, XYZ] = tileset.placed(scene, tile, to_earth, splats.xyz)
    make_folder(folder / FOLDER / tile.name)
    return _level(splat_levels.levels(Splats(placed)), to_earth, folder, f"{FOLDER}/{tile.name}/level")


def _level(level: SplatLevel, to_earth: F64, folder: Path, name: str) -> Node:
    """Write a level and all finer ones; `name` is the path of its file in `folder`, without suffix."""
    gltf.write_spz(folder / f"{name}.glb", level.splats)
    error = level.spacing * MAX_SCREEN_SPACE_ERROR_PX / MERGED_PX
    node: dict[str, Any] = {"geometricError": round(error, 4), "content": {"uri": f"{name}.glb"}}
    if level.finer:
        node |= {"refine": "REPLACE", "extras": {"spacing_m": round(level.spacing, 4)}}
    finer = [_level(one, to_earth, folder, f"{name}_{k}") for k, one in enumerate(level.finer)]
    low, high = splat_levels.bounds(level.splats)
    return tileset.with_children(Node(node, to_earth, low, high), finer)
