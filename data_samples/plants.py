"""Meshes of plants with few triangles; their leaves are drawn by the shader."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples import paints
from scan2sim.data_samples.layout import Tree
from scan2sim.data_samples.paints import RGB, Material, Paint, linear
from scan2sim.data_samples.shapes import Part, blob, box, join, tube

CLUMP_SHAPES = 40  # number of different clumps of leaves


@lru_cache
def _unit_clump(shape: int, rounds: int) -> Part:
    leaf = Paint(Material.FOLIAGE, (1, 1, 1), 0)
    rng = np.random.default_rng([shape, 51])
    return blob((0, 0, 0), 1.0, rng, leaf, bump=0.22, wavelength=0.8, rounds=rounds, shade=(0.2, 0.85))


def clump(
    centre: npt.ArrayLike, radius: float, paint: Paint, rng: np.random.Generator, rounds: int, flat: float = 1.0
) -> Part:
    """A bumpy ball of leaves; `flat`: ratio of height to width."""
    unit = _unit_clump(int(rng.integers(CLUMP_SHAPES)), rounds)
    return replace(
        unit,
        vertices=(unit.vertices * (radius, radius, radius * flat) + np.asarray(centre)).astype(np.float32),
        colour=np.tile(np.array(paint.colour, np.float32), (len(unit.faces), 1)),
        classification=np.full(len(unit.faces), paint.classification, np.uint8),
        seed=np.full(len(unit.faces), paint.seed, np.int32),
    )


def leafy_tree(plan: Tree, rounds: int = 2) -> Part:
    """A tree: a trunk, and a crown of clumps with 20 * 4 ** `rounds` triangles each."""
    rng = np.random.default_rng(plan.seed)
    bark = Paint(Material.BARK, linear("#6f5d4b"), paints.TREE, plan.seed)
    leaf = Paint(Material.FOLIAGE, plan.colour, paints.TREE, plan.seed)
    clear, r = max(2.3, 0.36 * plan.height), 0.022 * plan.height
    lean = rng.normal(0, 0.12, 2)
    trunk = [(0, 0, -0.4), (0, 0, 0), (*lean, clear), (*lean, plan.height * 0.7)]
    parts = [tube(trunk, np.array([1.4, 1.2, 0.9, 0.4]) * r, bark, sides=8)]
    for angle in rng.uniform(0, 2 * np.pi) + np.arange(6) * 2 * np.pi / 6:
        out, size = plan.radius * rng.uniform(0.3, 0.6, 2) * (1.0, 1.1)
        z = rng.uniform(clear + 0.22 * plan.height, plan.height * 0.82)
        centre = (lean[0] + out * np.cos(angle), lean[1] + out * np.sin(angle), z)
        parts.append(clump(centre, max(size, 0.45 * plan.radius), leaf, rng, rounds, rng.uniform(0.8, 1.1)))
    parts.append(clump((*lean, plan.height - 0.6 * plan.radius), 0.7 * plan.radius, leaf, rng, rounds))
    return join(parts)


def shrub(radius: float, colour: RGB, seed: int, rounds: int = 2) -> Part:
    """A bush of two clumps, the larger with 20 * 4 ** `rounds` triangles."""
    rng = np.random.default_rng(seed)
    leaf = Paint(Material.FOLIAGE, colour, paints.BUSH, seed)
    beside = (0.8 * radius, 0.3 * radius, 0.4 * radius)
    return join(
        [
            clump((0, 0, 0.6 * radius), radius, leaf, rng, rounds),
            clump(beside, 0.7 * radius, leaf, rng, max(0, rounds - 1), flat=0.9),
        ]
    )


def hedge(length: float, height: float, colour: RGB, seed: int) -> Part:
    """A clipped hedge along x."""
    return box((0, -0.35, -0.3), (length, 0.35, height), Paint(Material.FOLIAGE, colour, paints.BUSH, seed))
