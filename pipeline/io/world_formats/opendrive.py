"""OpenDRIVE: the roads that were driven as one network over all tiles, `<name>.xodr`, for CARLA and whatever drives.

It has no meshes. Where there are several tiles, their roads as one are listed too: `<name>_roads.geojson`.
"""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io.geodata import opendrive
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.roads import listed
from scan2sim.pipeline.roads.scene_roads import drawn


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the network; there are no triangles in it.

    Raises:
        DataError: no lanes are told of.
    """
    if not write_roads(scene, folder):
        raise DataError(
            "opendrive", f"of {scene.name} no road's lanes are told", "See in docs/roads.md what they are told by"
        )
    return {}


def write_roads(scene: Scene, folder: Path) -> int:
    """Write the network if any road has lanes; returns the number of roads that have."""
    roads = drawn(scene)
    count = opendrive.write(folder / f"{scene.name}.xodr", scene.name, scene.frame, roads)
    if count and len(scene.tiles) > 1:
        listed.write(folder / f"{scene.name}_roads.geojson", scene.frame, roads)
    return count
