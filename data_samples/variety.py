"""Variations of training streets: other pavements, borders, halls, vehicles, people, street furniture.

Other streets don't have them. Each kind has its own stream of random numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from scan2sim.data_samples import borders, figures, halls, objects, paints, roadside
from scan2sim.data_samples.layout import HALF_WIDTH, Boundary, House, Layout, ParkedCar, PlacedObject, Side, Walk
from scan2sim.data_samples.paints import RGB, Material, Paint
from scan2sim.data_samples.shapes import Part
from scan2sim.data_samples.traffic import coach
from scan2sim.pipeline.core.types import F64

Rng = np.random.Generator
PAVINGS = (
    Material.SLABS, Material.SETTS, Material.SETTS, Material.PLAIN, Material.BRICK, Material.GRIT, Material.STONE,
)  # fmt: skip
SIDES: tuple[Side, Side] = (1, -1)


def varied(layout: Layout, length: float) -> Layout:
    """Street with a share of its objects replaced, and with additional ones."""
    streams = (np.random.default_rng([layout.seed, 200 + i]) for i in range(9))
    ground, build, border, drive, live, stand, hang, plant, shine = streams
    built, kept = _halls(layout, build)
    bordered, open_ = _borders(layout, border)
    driven, parked = _vehicles(layout, drive)
    fixed = replace(layout, houses=kept)
    extras = [*built, *bordered, *driven, *_people(layout, length, live), *_furniture(layout, length, stand)]
    extras += [*_facade_attachments(fixed, hang), *_banks(layout, length, plant)]
    bay = Paint(PAVINGS[ground.integers(len(PAVINGS))], grey(ground), paints.ROAD, _seed(ground))
    return replace(
        fixed,
        boundaries=open_,
        parked=parked,
        walks=tuple(w for side in SIDES for w in _walks(layout, side, ground)),
        bays=bay if ground.random() < 0.6 else None,
        extras=tuple(extras),
        sun=_rotated_sun(layout.sun, shine),
    )


def grey(rng: Rng, low: float = 0.03, high: float = 0.75) -> RGB:
    """Random grey of linear light between `low` and `high`, slightly tinted."""
    return _rgb(np.exp(rng.uniform(np.log(low), np.log(high))) * np.exp(rng.normal(0, 0.09, 3)))


def colour(rng: Rng, strength: float = 0.6) -> RGB:
    """Random colour of any hue, from black to white; `strength`: of the hue."""
    return _rgb(np.exp(rng.uniform(np.log(0.015), np.log(0.8))) * np.exp(rng.normal(0, strength, 3)))


def _green(rng: Rng) -> RGB:
    return _rgb(np.array([0.09, 0.15, 0.05]) * np.exp(rng.uniform(-1.4, 0.7)) * np.exp(rng.normal(0, 0.25, 3)))


def _rgb(values: F64) -> RGB:
    r, g, b = np.clip(values, 0.008, 0.95).tolist()
    return r, g, b


def _seed(rng: Rng) -> int:
    return int(rng.integers(1 << 20))


def _rotated_sun(sun: F64, rng: Rng) -> F64:
    """Direction of the sun, with a random azimuth for half of the streets."""
    a = rng.uniform(0, 2 * np.pi) * (rng.random() < 0.5)
    x, y, z = sun
    return np.array([x * np.cos(a) - y * np.sin(a), x * np.sin(a) + y * np.cos(a), z])


def _walks(layout: Layout, side: Side, rng: Rng) -> list[Walk]:
    """Verge, cycle path, pavement and garden, from the kerb outwards."""
    near, end = layout.kerb(side) + 0.15, layout.garden(side)
    strips: list[Walk] = []

    def add(width: float, paint: Paint) -> None:
        far = min(near + sum(s.far - s.near for s in strips) + width, HALF_WIDTH)
        begin = strips[-1].far if strips else near
        if far > begin + 0.05:
            strips.append(Walk(side, begin, far, paint))

    def sealed(material: Material, tint: RGB) -> Paint:
        return Paint(material, tint, paints.SIDEWALK, _seed(rng))

    if rng.random() < 0.35:
        add(rng.uniform(0.4, 0.45 * (end - near)), _soft(rng))
    if rng.random() < 0.3:
        red = rng.random() < 0.6
        tint = _rgb(np.array([0.25, 0.06, 0.045]) * np.exp(rng.normal(0, 0.4))) if red else colour(rng, 0.3)
        add(rng.uniform(0.8, 1.6), sealed(PAVINGS[rng.integers(len(PAVINGS))], tint))
    add(max(0.8, end - (strips[-1].far if strips else near)), sealed(PAVINGS[rng.integers(len(PAVINGS))], grey(rng)))
    yard = rng.random() < 0.2
    add(HALF_WIDTH, sealed(PAVINGS[rng.integers(len(PAVINGS))], grey(rng)) if yard else _soft(rng))
    return strips


def _soft(rng: Rng) -> Paint:
    """Paint of unsealed ground: grass, dry grass, soil, litter or gravel."""
    if rng.random() < 0.6:
        tint = _rgb(np.array([0.10, 0.16, 0.04]) * np.exp(rng.uniform(-0.8, 0.8)) * np.exp(rng.normal(0, 0.3, 3)))
        return Paint(Material.GRASS, tint, paints.TERRAIN, _seed(rng))
    tint = _rgb(np.array([0.16, 0.12, 0.075]) * np.exp(rng.uniform(-1, 0.9)) * np.exp(rng.normal(0, 0.15, 3)))
    return Paint(Material.GRIT, tint, paints.TERRAIN, _seed(rng))


def _facing(side: int) -> float:
    """Rotation of a mesh whose front faces -y, so that it faces the road from its side."""
    return 0.0 if side == 1 else np.pi


def _along(s: float, width: float, side: int) -> float:
    """Chainage of the origin of a mesh that faces the road and covers s to s + width."""
    return s if side == 1 else s + width


def _halls(layout: Layout, rng: Rng) -> tuple[list[PlacedObject], tuple[House, ...]]:
    """Replace a share of the houses by halls; returns halls and remaining houses."""
    share = rng.choice([0.0, 0.3, 0.9], p=[0.45, 0.35, 0.2])
    out, kept = [], []
    for h in layout.houses:
        if rng.random() >= share:
            kept.append(h)
            continue
        tall, tints = rng.uniform(3.0, 11.0), (colour(rng, 0.25), colour(rng))
        make = partial(halls.hall, h.width, h.depth, tall, tints, _seed(rng))
        out.append(PlacedObject(_along(h.s, h.width, h.side), h.side * h.front, _facing(h.side), make))
    return out, tuple(kept)


def _borders(layout: Layout, rng: Rng) -> tuple[list[PlacedObject], tuple[Boundary, ...]]:
    """Replace a share of the garden borders by other walls, fences and banks; returns these and the remaining ones."""
    share = rng.choice([0.0, 0.5, 1.0], p=[0.25, 0.4, 0.35])
    out, kept = [], []
    for b in layout.boundaries:
        if rng.random() >= share:
            kept.append(b)
            continue
        side = 1 if b.t > 0 else -1
        kind, height, seed = rng.random(), float(rng.uniform(0.5, 2.8)), _seed(rng)
        material, tint = borders.WALL_MATERIALS[rng.integers(len(borders.WALL_MATERIALS))], colour(rng, 0.2)
        green, low = _green(rng), float(rng.uniform(0.3, 1.8))
        pieces = max(1, round((b.s1 - b.s0) / 6))
        width = (b.s1 - b.s0) / pieces
        make: Callable[[], Part]
        if kind < 0.5:
            make = partial(borders.bare_wall, width, height, material, tint, seed)
        elif kind < 0.68:
            make = partial(borders.slat_fence, width, 0.6 * height + 0.4, tint, seed)
        elif kind < 0.8:
            make = partial(borders.wire_fence, width, 0.6 * height + 0.6, tint, seed)
        else:
            make = partial(borders.bank, width, low, green, seed)
        out += [PlacedObject(_along(b.s0 + i * width, width, side), b.t, _facing(side), make) for i in range(pieces)]
    return out, tuple(kept)


def _vehicles(layout: Layout, rng: Rng) -> tuple[list[PlacedObject], tuple[ParkedCar, ...]]:
    """Replace parked cars by vans, lorries and cars of other sizes, some on the other side of the road."""
    out, kept = [], []
    cars = list(layout.parked)
    if rng.random() < 0.5:  # more cars, on the opposite side of the carriageway
        sample = cars[:: int(rng.integers(2, 5))]
        cars += [replace(c, t=-np.sign(c.t) * (layout.lane - 0.9), s=c.s + 2.0) for c in sample]
    for i, c in enumerate(cars):
        kind, turn = rng.random(), 0.0 if c.towards == 1 else np.pi
        tint = colour(rng, 0.35) if rng.random() < 0.5 else grey(rng, 0.01, 0.9)
        make: Callable[[], Part]
        if kind < 0.15 and c in layout.parked:
            kept.append(c)
            continue
        if kind < 0.72:
            scale = rng.uniform([0.82, 0.9, 0.92], [1.1, 1.06, 1.3])
            make = partial(_scaled_car, tint, (float(scale[0]), float(scale[1]), float(scale[2])))
        elif kind < 0.9:
            size = rng.uniform(4.2, 6), rng.uniform(1.8, 2.1), rng.uniform(1.9, 2.7)
            make = partial(_van, size, tint, layout.seed + i)
        else:
            make = partial(roadside.lorry, rng.uniform(5, 7), rng.uniform(2.4, 3.6), (tint, colour(rng)), _seed(rng))
        out.append(PlacedObject(c.s, c.t, turn + rng.normal(0, 0.03), make, movable=True))
    return out, tuple(kept)


def _van(size: tuple[float, float, float], tint: RGB, seed: int) -> Part:
    return coach(*size, tint, np.random.default_rng([seed, 95]))


def _scaled_car(tint: RGB, scale: tuple[float, float, float]) -> Part:
    car = objects.car(tint)
    return replace(car, vertices=(car.vertices * np.array(scale)).astype(np.float32))


def _people(layout: Layout, length: float, rng: Rng) -> list[PlacedObject]:
    """Pedestrians on the pavements and the road, cyclists and parked bicycles."""
    out = []
    for _ in range(int(rng.integers(0, 22))):
        side, s, seed = SIDES[rng.integers(2)], rng.uniform(1, length - 1), _seed(rng)
        k, g = layout.kerb(side), layout.garden(side)
        t = rng.uniform(k + 0.3, g - 0.3) if rng.random() < 0.75 else rng.uniform(-layout.lane + 0.8, k)
        turn = rng.choice([0.0, np.pi]) + rng.normal(0, 0.5)
        kind = rng.random()
        make = partial(figures.person if kind < 0.65 else figures.cyclist if kind < 0.8 else figures.bicycle, seed)
        out.append(PlacedObject(s, side * t, turn, make, movable=True))
        if kind < 0.65 and rng.random() < 0.4:  # a pair
            out.append(PlacedObject(s + 0.1, side * (t + 0.6), turn, partial(figures.person, seed + 1), movable=True))
    return out


def _furniture(layout: Layout, length: float, rng: Rng) -> list[PlacedObject]:
    """Masts, bollards, direction signs and traffic lights along kerbs and gardens."""
    out = []
    for _ in range(int(rng.integers(0, 16))):
        side, s, seed, kind = SIDES[rng.integers(2)], rng.uniform(1, length - 1), _seed(rng), rng.random()
        k, g = layout.kerb(side), layout.garden(side)
        t, turn = rng.choice([k + 0.35, g - 0.2, g + 1.5]), -np.pi / 2 * side + rng.normal(0, 0.15)
        make: Callable[[], Part]
        if kind < 0.45:
            make = partial(roadside.mast, rng.uniform(3, 9), rng.uniform(0.03, 0.17), grey(rng), seed)
            turn = _facing(-side)
        elif kind < 0.6:
            tints = (colour(rng, 0.4), colour(rng))
            make = partial(roadside.bollard, rng.uniform(0.6, 1.2), rng.uniform(0.04, 0.15), tints)
        elif kind < 0.75:
            make = partial(roadside.board, rng.uniform(0.6, 2.6), rng.uniform(0.4, 1.4), rng.uniform(1.2, 2.6), seed)
        elif kind < 0.87:
            make = partial(roadside.traffic_light, seed)
        else:
            make = partial(objects.sign, int(rng.integers(7)))
        out.append(PlacedObject(s, side * t, turn, make))
    return out


def _facade_attachments(layout: Layout, rng: Rng) -> list[PlacedObject]:
    """Boards, awnings and downpipes on houses."""
    out = []
    for h in layout.houses:
        for _ in range(rng.poisson(1.0)):
            width = rng.uniform(0.3, min(4.0, 0.6 * h.width))
            s, kind = h.s + rng.uniform(0.1, h.width - width - 0.1), rng.random()
            make: Callable[[], Part]
            if kind < 0.6:
                low, tall = rng.uniform(0.8, objects.eaves(h) - 1.0), rng.uniform(0.3, 1.6)
                make = partial(halls.panel, width, min(tall, objects.eaves(h) - low), low, colour(rng), _seed(rng))
            elif kind < 0.8:
                make = partial(halls.awning, width, colour(rng), _seed(rng))
            else:
                width, make = 0.1, partial(halls.pipe, objects.eaves(h) - 0.2, grey(rng))
            out.append(PlacedObject(_along(s, width, h.side), h.side * h.front, _facing(h.side), make))
    return out


def _banks(layout: Layout, length: float, rng: Rng) -> list[PlacedObject]:
    """Beds of low bushes and thickets behind the pavement, on some sides."""
    out = []
    for side in SIDES:
        if rng.random() < 0.55:
            continue
        s = rng.uniform(0, 10)
        while s < length - 4:
            width, high = rng.uniform(2, 7), bool(rng.random() < 0.3)
            height = rng.uniform(2.2, 6.0) if high else rng.uniform(0.25, 1.3)
            t = layout.garden(side) + rng.uniform(0.2, 2.0)
            make = partial(borders.bank, width, height, _green(rng), _seed(rng), high=high)
            out.append(PlacedObject(_along(s, width, side), side * t, _facing(side), make))
            s += width + rng.exponential(8)
    return out
