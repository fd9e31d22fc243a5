"""Roads of a scene, joined across tile borders."""

from __future__ import annotations

from scan2sim.pipeline.io.worlds.scene import ROADS_FILE, Scene
from scan2sim.pipeline.roads import observed
from scan2sim.pipeline.roads.model import Road, network


def roads_of(scene: Scene) -> list[Road]:
    """Roads of all tiles, in metres from the scene's origin."""
    files = [tile.folder / ROADS_FILE for tile in scene.tiles]
    return network([way for file in files if file.is_file() for way in observed.load(file)], scene.frame.origin)
