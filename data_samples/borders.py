"""Meshes of garden borders along x, their outside towards -y: walls, fences, rows of bushes, thickets."""

from __future__ import annotations

import numpy as np

from scan2sim.data_samples import paints
from scan2sim.data_samples.paints import RGB, Material, Paint
from scan2sim.data_samples.plants import clump
from scan2sim.data_samples.shapes import Part, box, join, tube

WALL_MATERIALS = (Material.PLAIN, Material.PLASTER, Material.GRIT, Material.PANELS, Material.STONE, Material.BRICK)


def bare_wall(length: float, height: float, material: Material, colour: RGB, seed: int) -> Part:
    """A wall of a given material, sometimes with a cap of another brightness."""
    rng = np.random.default_rng([seed, 71])
    parts = [box((0, -0.12, -0.8), (length, 0.12, height), Paint(material, colour, paints.WALL, seed))]
    if rng.random() < 0.5:
        cap = Paint(Material.PLAIN, _shade(colour, rng), paints.WALL, seed)
        parts.append(box((0, -0.16, height), (length, 0.16, height + 0.06), cap, bottom=True))
    return join(parts)


def slat_fence(length: float, height: float, colour: RGB, seed: int) -> Part:
    """Posts with vertical or horizontal boards between them, with or without gaps."""
    rng = np.random.default_rng([seed, 72])
    wood = Paint(Material.WOOD, colour, paints.WALL, seed)
    wide = rng.uniform(0.08, 0.2)
    pitch = wide + rng.choice([0.004, rng.uniform(0.02, 0.12)])
    if rng.random() < 0.5:
        parts = [
            box((x, -0.02, 0.05), (x + wide, 0.0, height), wood._replace(seed=seed + i))
            for i, x in enumerate(np.arange(0, length, pitch))
        ]
    else:
        parts = [
            box((0, -0.02, z), (length, 0.0, min(z + wide, height)), wood._replace(seed=seed + i), bottom=True)
            for i, z in enumerate(np.arange(0.05, height, pitch))
        ]
    parts += [box((x, 0, -0.5), (x + 0.1, 0.1, height + 0.05), wood) for x in np.arange(0, length, 2.2)]
    return join(parts)


def wire_fence(length: float, height: float, colour: RGB, seed: int) -> Part:
    """A wire mesh between thin posts."""
    wire = Paint(Material.PLAIN, colour, paints.WALL, seed)
    parts = [tube([(x, 0, -0.4), (x, 0, height)], [0.03, 0.03], wire, sides=6) for x in np.arange(0, length + 0.1, 2.5)]
    parts += [box((x, -0.004, 0.05), (x + 0.008, 0.004, height), wire) for x in np.arange(0.05, length, 0.1)]
    parts += [box((0, -0.004, z), (length, 0.004, z + 0.008), wire, bottom=True) for z in np.arange(0.05, height, 0.2)]
    return join(parts)


def bank(length: float, height: float, colour: RGB, seed: int, *, high: bool = False) -> Part:
    """A row of bushes of a given height; if `high`, a thicket with the class of high vegetation."""
    rng = np.random.default_rng([seed, 73])
    leaf = Paint(Material.FOLIAGE, colour, paints.TREE if high else paints.BUSH, seed)
    parts = []
    size = np.clip(0.4 * height, 0.2, 1.1)
    for x in np.arange(0.5 * size, length, 0.9 * size):
        for z in np.arange(0.4 * size, height, 1.1 * size):
            r = size * rng.uniform(0.7, 1.3)
            at = (x + rng.normal(0, 0.2 * size), rng.uniform(0, 1.2 * size), min(z, height - 0.5 * r))
            parts.append(clump(at, r, leaf, rng, 2, rng.uniform(0.7, 1.1)))
    return join(parts)


def _shade(colour: RGB, rng: np.random.Generator) -> RGB:
    r, g, b = np.clip(np.array(colour) * rng.uniform(0.6, 1.6), 0.01, 0.95).tolist()
    return r, g, b
