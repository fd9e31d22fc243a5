"""A scene's roads, those that go on over borders of tiles as one."""

from __future__ import annotations

from scan2sim.pipeline.io.worlds.scene import ROADS, Scene
from scan2sim.pipeline.roads import observed
from scan2sim.pipeline.roads.model import Road, network


def drawn(scene: Scene) -> list[Road]:
    """The roads of all tiles; metres from the scene's origin."""
    files = [tile.folder / ROADS for tile in scene.tiles]
    return network([way for file in files if file.is_file() for way in observed.load(file)], scene.frame.origin)
