"""A scene's roads, those that go on over borders of tiles as one."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.io.scene import ROADS, Scene
from scan2sim.pipeline.roads import model, observed
from scan2sim.pipeline.roads.model import Road


def drawn(scene: Scene) -> list[Road]:
    """The roads of all tiles; metres from the scene's origin."""
    files = [tile.folder / ROADS for tile in scene.tiles]
    seen = [way for file in files if file.is_file() for way in observed.load(file)]
    ways = observed.joined([way.moved(-np.asarray(scene.frame.origin)) for way in seen])
    return [road for road in map(model.drawn, ways) if road]
