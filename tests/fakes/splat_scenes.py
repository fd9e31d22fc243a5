"""Splats before a background, and tiles that have some."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.splats import SplatLayer, Splats
from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.io.worlds.scene import SPLATS_FILE, SceneTile
from scan2sim.texturing.splats.background import HEIGHT_PX


def layer(seed: int = 1, count: int = 3000, height: int = 64) -> SplatLayer:
    """Flat and round splats of 2 to 60 cm, transparent and opaque, in 20 x 20 x 5 m; `height` is the background's."""
    random = np.random.default_rng(seed)
    splats = Splats.of(
        random.uniform((-10, -10, 0), (10, 10, 5), (count, 3)),
        np.exp(random.uniform(np.log(0.02), np.log(0.6), (count, 3))),
        random.normal(size=(count, 4)),
        random.uniform(0.02, 0.98, count),
        random.uniform(0, 1, (count, 3)),
    )
    return SplatLayer(splats, background(seed, height))


def background(seed: int, height: int) -> F32:
    """(H, 2 H, 3) a smooth sky, 0.1 to 1.3 (1 is white), that depends on the azimuth, the elevation and the seed."""
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 2 * height, endpoint=False), np.linspace(1, -1, height))
    waves = [np.sin(azimuth + seed), np.cos(azimuth + 2 * seed), elevation]
    return np.stack([0.7 + 0.6 * wave for wave in waves], axis=-1).astype(np.float32)


def add(tile: SceneTile, seed: int = 1, count: int = 3000) -> None:
    """Give a tile splats."""
    layer(seed, count, HEIGHT_PX).save(tile.folder / SPLATS_FILE)
