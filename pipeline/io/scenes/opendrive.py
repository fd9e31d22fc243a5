"""OpenDRIVE: the roads that were driven as one network over all tiles, `<name>.xodr`, for CARLA and whatever drives.

It has no meshes. Where there are several tiles, their roads as one are listed too: `<name>_roads.geojson`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.errors import DataError
from scan2sim.pipeline.io import opendrive
from scan2sim.pipeline.io.scene import ROADS, Scene
from scan2sim.pipeline.io.scenes import SceneParams
from scan2sim.pipeline.roads import listed, model, observed
from scan2sim.pipeline.roads.lanes import sections
from scan2sim.pipeline.roads.model import Road
from scan2sim.pipeline.step import Report


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the network; there are no triangles in it.

    Raises:
        DataError: no lanes are told of.
    """
    roads = drawn(scene)
    if not opendrive.write(folder / f"{scene.name}.xodr", scene.name, scene.frame, roads):
        raise DataError(
            "opendrive", f"of {scene.name} no road's lanes are told", "See in docs/roads.md what they are told by"
        )
    if len(scene.tiles) > 1:
        listed.write(folder / f"{scene.name}_roads.geojson", scene.frame, roads)
    return {}


def has_lanes(scene: Scene) -> bool:
    """Whether there is something to write."""
    return any(sections(road) for road in drawn(scene))


def drawn(scene: Scene) -> list[Road]:
    """The roads of all tiles, those that go on over borders as one; metres from the scene's origin."""
    files = [tile.folder / ROADS for tile in scene.tiles]
    seen = [way for file in files if file.is_file() for way in observed.load(file)]
    ways = observed.joined([way.moved(-np.asarray(scene.frame.origin)) for way in seen])
    return [road for road in map(model.drawn, ways) if road]
