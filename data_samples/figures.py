"""Meshes of people and bicycles, x forwards, the origin on the ground below them."""

from __future__ import annotations

import numpy as np

from scan2sim.data_samples import paints
from scan2sim.data_samples.paints import RGB, Material, Paint
from scan2sim.data_samples.shapes import Part, blob, join, tube

SKIN_RGB: tuple[RGB, ...] = ((0.55, 0.33, 0.24), (0.35, 0.19, 0.12), (0.10, 0.055, 0.035))
SADDLE_HEIGHT_M = 0.95  # metres above ground


def person(seed: int, *, rides: bool = False) -> Part:
    """A person who stands, walks or, if `rides`, sits on a bicycle: limbs, trunk and head, in random clothes."""
    rng = np.random.default_rng([seed, 61])
    tall, wide = rng.uniform(1.5, 1.95), rng.uniform(0.8, 1.3)
    cloth = [_any(rng, Material.GRIT if rng.random() < 0.3 else Material.PLAIN) for _ in range(3)]
    skin = Paint(Material.PLAIN, SKIN_RGB[rng.integers(len(SKIN_RGB))], paints.PERSON)
    hip, neck = (SADDLE_HEIGHT_M, SADDLE_HEIGHT_M + 0.32 * tall) if rides else (0.5 * tall, 0.83 * tall)
    lean, stride = (0.25, 0.15) if rides else (rng.uniform(-0.03, 0.08), rng.uniform(0, 0.3))
    parts = []
    for side in (-1, 1):
        foot, knee = stride * side, 0.5 * stride * side + (0.25 if rides else 0.05)
        y = 0.1 * side * wide
        leg = [(foot, y, 0.25 if rides else 0.0), (knee, y, 0.55 * hip), (0, y, hip)]
        parts.append(tube(leg, np.array([0.06, 0.07, 0.10]) * wide, cloth[0], sides=7))
        hand = (lean + (0.5 if rides else -0.7 * stride * side), 0.28 * side * wide, hip + (0.15 if rides else -0.02))
        arm = [(lean, 0.2 * side * wide, neck - 0.05), (lean + 0.1, 0.27 * side * wide, (hip + neck) / 2), hand]
        parts.append(tube(arm, np.array([0.07, 0.055, 0.04]) * wide, cloth[1], sides=6))
    trunk = [(0, 0, hip - 0.08), (0.4 * lean, 0, (hip + neck) / 2), (lean, 0, neck), (lean, 0, neck + 0.03)]
    parts.append(tube(trunk, np.array([0.16, 0.19, 0.17, 0.05]) * wide, cloth[1], sides=10))
    parts.append(blob((1.2 * lean, 0, neck + 0.17), (0.1, 0.085, 0.13), rng, skin, bump=0.03, rounds=1))
    hair = blob((1.2 * lean - 0.02, 0, neck + 0.21), (0.105, 0.09, 0.11), rng, cloth[2], bump=0.05, rounds=1)
    if rng.random() < 0.3:
        parts.append(blob((-0.2 * wide, 0, neck - 0.2), (0.14, 0.17, 0.24), rng, _any(rng), bump=0.05, rounds=1))
    return join([*parts, hair])


def bicycle(seed: int) -> Part:
    """A bicycle: two wheels, a frame, saddle and handlebar."""
    rng = np.random.default_rng([seed, 62])
    tyre, frame = Paint(Material.PLAIN, (0.015, 0.015, 0.015), paints.VEHICLE), _any(rng, classification=paints.VEHICLE)
    angle = np.linspace(0, 2 * np.pi, 21)
    circle = np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)]) * 0.33
    parts = [tube(circle + (x, 0, 0.34), np.full(21, 0.022), tyre, sides=5) for x in (-0.52, 0.52)]
    for path in (
        [(-0.52, 0, 0.34), (0, 0, 0.3), (0.42, 0, 0.75), (-0.15, 0, 0.8), (-0.52, 0, 0.34)],
        [(0, 0, 0.3), (-0.2, 0, SADDLE_HEIGHT_M)],
        [(0.52, 0, 0.34), (0.4, 0, 1.0)],
        [(0.35, -0.28, 1.0), (0.4, 0, 1.0), (0.35, 0.28, 1.0)],
    ):
        parts.append(tube(path, np.full(len(path), 0.022), frame, sides=5))
    saddle = blob((-0.2, 0, SADDLE_HEIGHT_M), (0.13, 0.07, 0.04), rng, tyre, bump=0.02, rounds=1)
    return join([*parts, saddle])


def cyclist(seed: int) -> Part:
    """A person on a bicycle."""
    return join([bicycle(seed), person(seed, rides=True)])


def _any(rng: np.random.Generator, material: Material = Material.PLAIN, classification: int = paints.PERSON) -> Paint:
    """Paint of a random colour, rather dark than light."""
    r, g, b = np.clip(np.exp(rng.uniform(-4, -0.4)) * np.exp(rng.normal(0, 0.5, 3)), 0.01, 0.9).tolist()
    return Paint(material, (r, g, b), classification, int(rng.integers(1 << 20)))
