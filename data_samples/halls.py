"""Meshes of halls (buildings with few windows), and of attachments of facades: awnings, boards, downpipes."""

from __future__ import annotations

import numpy as np

from scan2sim.data_samples import paints, signs
from scan2sim.data_samples.paints import RGB, Material, Paint
from scan2sim.data_samples.shapes import Opening, Part, box, join, quads, tube, wall

WALL_MATERIALS = (Material.PANELS, Material.PANELS, Material.PLASTER, Material.PLAIN, Material.BRICK, Material.GRIT)


def hall(width: float, depth: float, height: float, colours: tuple[RGB, RGB], seed: int) -> Part:
    """A hall: x along its front (0 .. width), y into the plot; sometimes with a gate and a strip of windows."""
    rng = np.random.default_rng([seed, 81])
    skin = Paint(WALL_MATERIALS[rng.integers(len(WALL_MATERIALS))], colours[0], paints.BUILDING, seed)
    trim = Paint(Material.PLAIN, colours[1], paints.BUILDING, seed)
    plinth = (rng.uniform(0.2, 1.5), trim) if rng.random() < 0.5 else None
    parts = []
    for i, (long, turn, at) in enumerate((
        (width, 0.0, (0, 0, 0)), (depth, np.pi / 2, (width, 0, 0)), (width, np.pi, (width, depth, 0)),
        (depth, -np.pi / 2, (0, depth, 0)),
    )):  # fmt: skip
        openings = []
        if i == 0 and rng.random() < 0.5 and long > 5:
            x = rng.uniform(0.5, long - 4)
            gate = Paint(Material.PANELS, colours[1], paints.BUILDING, seed + 7)
            openings.append(Opening(x, 0.05, x + 3, min(3.2, height - 0.5), gate))
        if rng.random() < 0.4 and height > 4.6:
            pane = Paint(Material.WINDOW, colours[1], paints.BUILDING, seed + 3)
            openings += [Opening(x, height - 1.3, x + 1, height - 0.5, pane) for x in np.arange(0.5, long - 1.2, 1.2)]
        parts.append(wall(long, height, openings, skin, foot=1.2, plinth=plinth).moved(turn, at))
    top = height + rng.uniform(0.1, 0.6)
    parts.append(box((-0.1, -0.1, height), (width + 0.1, depth + 0.1, top), trim, bottom=True))
    return join(parts)


def awning(width: float, colour: RGB, seed: int) -> Part:
    """A slanted awning in front of a facade (y < 0), from 2.9 m down to 2.3 m."""
    rng = np.random.default_rng([seed, 82])
    cloth = Paint(Material.PANELS if rng.random() < 0.5 else Material.PLAIN, colour, paints.BUILDING, seed)
    out = rng.uniform(0.7, 1.8)
    a, b, c, d = (0, 0, 2.9), (width, 0, 2.9), (width, -out, 2.35), (0, -out, 2.35)
    e, f = (width, -out, 2.15), (0, -out, 2.15)
    flat = [[(0, 0), (width, 0), (width, out), (0, out)]] * 3
    return quads([[d, c, b, a], [a, b, c, d], [f, e, c, d]], flat, cloth)


def panel(width: float, height: float, low: float, colour: RGB, seed: int) -> Part:
    """A board on a facade, with an image or of one colour; it has the class of the building."""
    rng = np.random.default_rng([seed, 83])
    back = Paint(Material.PLAIN, colour, paints.BUILDING, seed)
    board = box((0, -0.08, low), (width, 0.0, low + height), back, bottom=True)
    if rng.random() < 0.5:
        return board
    face = Paint(Material.SIGN, (1, 1, 1), paints.BUILDING, int(rng.integers(len(signs.NAMES))))
    y = -0.09
    corners = [[(0, y, low), (width, y, low), (width, y, low + height), (0, y, low + height)]]
    return join([board, quads(corners, [[(0, 0), (1, 0), (1, 1), (0, 1)]], face)])


def pipe(height: float, colour: RGB) -> Part:
    """A downpipe."""
    return tube([(0, -0.08, -0.3), (0, -0.08, height)], [0.05, 0.05], Paint(Material.PLAIN, colour, paints.BUILDING), 7)
