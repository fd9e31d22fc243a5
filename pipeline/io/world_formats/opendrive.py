"""OpenDRIVE: one network of the driven roads of all tiles, `<name>.xodr`, for CARLA and other driving simulators.

It has no meshes. For several tiles, the combined roads are also listed: `<name>_roads.geojson`.
"""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io.geodata import opendrive, road_geojson
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.io.worlds.scene_roads import roads_of


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the network, which has no triangles.

    Raises:
        DataError: no road has detected lanes.
    """
    if not write_roads(scene, folder):
        raise DataError(
            "opendrive", f"no road of {scene.name} has detected lanes", "docs/roads.md says how lanes are detected"
        )
    return {}


def write_roads(scene: Scene, folder: Path) -> int:
    """Write the network if any road has lanes; returns the number of roads with lanes."""
    roads = roads_of(scene)
    count = opendrive.write(folder / f"{scene.name}.xodr", scene.name, scene.frame, roads)
    if count and len(scene.tiles) > 1:
        road_geojson.write(folder / f"{scene.name}_roads.geojson", scene.frame, roads)
    return count
