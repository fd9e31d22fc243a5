"""Meshes of road furniture and lorries: poles, bollards, direction signs, traffic lights."""

from __future__ import annotations

import numpy as np

from scan2sim.data_samples import paints, signs
from scan2sim.data_samples.paints import RGB, Material, Paint
from scan2sim.data_samples.shapes import Part, box, join, part, quads, tube


def mast(height: float, radius: float, colour: RGB, seed: int) -> Part:
    """A pole of steel or wood, almost upright, sometimes with an arm."""
    rng = np.random.default_rng([seed, 91])
    skin = Paint(Material.WOOD if rng.random() < 0.4 else Material.PLAIN, colour, paints.POLE, seed)
    lean = rng.normal(0, 0.01, 2) * height
    parts = [tube([(0, 0, -0.4), (0, 0, 0), (*lean, height)], [radius, radius, 0.6 * radius], skin, sides=10)]
    if rng.random() < 0.4:
        arm = rng.uniform(0.6, 2.5)
        x, y = lean
        parts.append(tube([(x, y, height - 0.1), (x, y + arm, height + 0.1)], [0.04, 0.04], skin, sides=7))
        parts.append(box((x - 0.1, arm - 0.5, height), (x + 0.1, arm, height + 0.12), skin, bottom=True))
    return join(parts)


def bollard(height: float, radius: float, colours: tuple[RGB, RGB]) -> Part:
    """A short post with a coloured ring."""
    post, ring = (Paint(Material.PLAIN, colour, paints.POLE) for colour in colours)
    return join([
        tube([(0, 0, -0.2), (0, 0, height)], [radius, radius], post, sides=10),
        tube([(0, 0, 0.75 * height), (0, 0, 0.85 * height)], [1.05 * radius, 1.05 * radius], ring, sides=10),
    ])  # fmt: skip


def board(width: float, height: float, low: float, seed: int) -> Part:
    """A large sign on two posts, facing -y: a coloured plate with an image."""
    rng = np.random.default_rng([seed, 92])
    steel = Paint(Material.PLAIN, (0.3, 0.3, 0.3), paints.POLE, seed)
    ground = ((0.02, 0.09, 0.4), (0.8, 0.8, 0.8), (0.75, 0.55, 0.02), (0.01, 0.2, 0.08), (0.6, 0.02, 0.02))
    plate = Paint(Material.PLAIN, ground[rng.integers(len(ground))], paints.SIGN, seed)
    x = width / 2
    parts = [box((-x, -0.03, low), (x, 0.0, low + height), plate, bottom=True)]
    parts += [tube([(p, 0.04, -0.3), (p, 0.04, low + height)], [0.04, 0.04], steel) for p in (-0.7 * x, 0.7 * x)]
    image = Paint(Material.SIGN, (1, 1, 1), paints.SIGN, int(rng.integers(len(signs.NAMES))))
    a, b = -0.9 * x, rng.uniform(-0.2, 0.9) * x
    c, d = low + 0.1 * height, low + 0.9 * height
    corners = [[(a, -0.04, c), (b, -0.04, c), (b, -0.04, d), (a, -0.04, d)]]
    parts.append(quads(corners, [[(0, 0), (1, 0), (1, 1), (0, 1)]], image))
    return join(parts)


def traffic_light(seed: int) -> Part:
    """A traffic light: three lamps in a dark box on a pole, facing -y; the box has the class of a sign."""
    rng = np.random.default_rng([seed, 93])
    grey = Paint(Material.PLAIN, (0.2, 0.2, 0.2), paints.POLE)
    dark = Paint(Material.PLAIN, (0.015, 0.02, 0.015), paints.SIGN)
    low = rng.uniform(2.1, 3.5)
    parts = [tube([(0, 0, -0.3), (0, 0, low + 1.0)], [0.06, 0.06], grey, sides=9)]
    parts.append(box((-0.15, -0.3, low), (0.15, -0.06, low + 0.9), dark, bottom=True))
    lit = int(rng.integers(3))
    for i, colour in enumerate(((0.0, 0.5, 0.15), (0.9, 0.5, 0.0), (0.9, 0.03, 0.02))):
        r, g, b = (np.array(colour) * (1.0 if i == lit else 0.06)).tolist()
        z = low + 0.15 + 0.3 * i
        lamp = Paint(Material.PLAIN, (r, g, b), paints.SIGN)
        parts.append(box((-0.1, -0.32, z - 0.1), (0.1, -0.29, z + 0.1), lamp, bottom=True))
    return join(parts)


def lorry(length: float, height: float, colours: tuple[RGB, RGB], seed: int) -> Part:
    """A lorry: a cab and a box body on wheels, x forwards."""
    rng = np.random.default_rng([seed, 94])
    cab, load = (Paint(Material.PLAIN, colour, paints.VEHICLE, seed + i) for i, colour in enumerate(colours))
    if rng.random() < 0.5:
        load = load._replace(material=Material.PANELS)
    glass, dark = (Paint(Material.PLAIN, (v, v, 1.2 * v), paints.VEHICLE) for v in (0.03, 0.012))
    x, y = length / 2, rng.uniform(0.95, 1.25)
    front, top = x - rng.uniform(1.5, 2.1), min(height, rng.uniform(2.1, 2.9))
    parts = [
        box((front, -y, 0.4), (x, y, top), cab, bottom=True),
        box((-x, -y, 0.8), (front - 0.1, y, height), load, bottom=True),
        box((-x, -0.8 * y, 0.45), (front, 0.8 * y, 0.8), dark, bottom=True),
        box((x - 0.02, -0.9 * y, 0.6 * top), (x + 0.02, 0.9 * y, 0.93 * top), glass, bottom=True),
        box((front + 0.4, -y - 0.02, 0.6 * top), (x - 0.2, y + 0.02, 0.9 * top), glass, bottom=True),
        box((x - 0.02, -0.9 * y, 0.3), (x + 0.05, 0.9 * y, 0.55), dark, bottom=True),
    ]
    tyre = Paint(Material.WHEEL, (0.02, 0.02, 0.02), paints.VEHICLE)
    angle = np.linspace(0, 2 * np.pi, 21)[:-1]
    disc = 0.45 * np.column_stack([np.cos(angle), np.sin(angle)])
    fan = np.column_stack([np.zeros(18), np.arange(1, 19), np.arange(2, 20)]).astype(int)
    for cx in (-0.55 * x, front + 0.5):
        for side in (-1, 1):
            rim = np.column_stack([cx + disc[:, 0], np.full(20, side * (y + 0.03)), 0.45 + disc[:, 1]])
            parts.append(part(rim, fan[:, ::-side], 0.7 * disc, tyre))
    return join(parts)
