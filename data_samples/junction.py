"""A level crossing and its surroundings: tracks along x, a road through the origin, houses, trees, masts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.data_samples import borders, halls, objects, paints, roadside
from scan2sim.data_samples.layout import House, Style, Tree
from scan2sim.data_samples.paints import Material, Paint, linear
from scan2sim.data_samples.plants import leafy_tree
from scan2sim.data_samples.shapes import Part, box, join, quads, sheet
from scan2sim.data_samples.variety import grey
from scan2sim.pipeline.core.types import F64

Rng = np.random.Generator

HALF_EXTENT_M = 260.0
"""Length of track and road on each side of the crossing."""
LANE_WIDTH_M = 3.3
TRACK_SPACING_M = 4.6
"""Between two tracks."""
TRACK_GAUGE_M = 1.435
RAIL_TOP_M = 0.06
"""Height of the rails' upper side."""


@dataclass(frozen=True)
class Junction:
    """A level crossing.

    Attributes:
        tracks: y coordinates of the tracks' centre lines.
        road: direction of the road, radians from x.
        part: mesh of everything static.
    """

    tracks: tuple[float, ...]
    road: float
    part: Part

    def on_road(self, s: float, t: float) -> F64:
        """(3,) position s metres along the road from the crossing, t metres to its left."""
        c, d = np.cos(self.road), np.sin(self.road)
        return np.array([s * c - t * d, s * d + t * c, 0.0])

    def clearance(self, xy: F64) -> float:
        """Distance from the nearest track's centre line or the road's edge, metres."""
        aside = abs(float(xy[1] * np.cos(self.road) - xy[0] * np.sin(self.road))) - LANE_WIDTH_M
        return min(aside, *(abs(float(xy[1]) - y) for y in self.tracks))


def build(rng: Rng, style: Style) -> Junction:
    """A random crossing with the colours of a style."""
    tracks = (0.0,) if rng.random() < 0.35 else (0.0, TRACK_SPACING_M)
    bare = Junction(tracks, float(rng.uniform(np.radians(50), np.radians(130))), _ground(rng))
    parts = [bare.part, _road(bare, style, rng), *_tracks(bare, rng), *_lights(bare, rng), *_masts(bare, rng)]
    parts += [*_buildings(bare, style, rng), *_trees(bare, style, rng), *_borders(bare, rng)]
    return Junction(bare.tracks, bare.road, join(parts))


def _flat(corners: list[F64], uv: list[tuple[float, float]], z: float, paint: Paint) -> Part:
    at = np.array([(*np.asarray(c)[:2], z) for c in corners])
    return quads([at], [uv], paint)


def _ground(rng: Rng) -> Part:
    lush = np.array([0.10, 0.16, 0.05]) * np.exp(rng.normal(0, 0.3)) * np.exp(rng.normal(0, 0.15, 3))
    tint = tuple(np.clip(lush, 0.02, 0.5).tolist())
    material = Material.GRASS if rng.random() < 0.7 else Material.GRIT
    x = np.linspace(-HALF_EXTENT_M, HALF_EXTENT_M, 53)
    xy = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)
    xyz = np.concatenate([xy, np.full((53, 53, 1), -0.08)], axis=2)
    return sheet(xyz, xy, Paint(material, tint, paints.TERRAIN, int(rng.integers(1 << 20))))


def _road(at: Junction, style: Style, rng: Rng) -> Part:
    asphalt = style.asphalt[rng.integers(len(style.asphalt))]
    paint = Paint(Material.ASPHALT, asphalt, paints.ROAD, int(rng.integers(1000)))
    walk = Paint(Material.SLABS if rng.random() < 0.6 else Material.GRIT, grey(rng), paints.SIDEWALK, 5)
    parts = []
    for s in np.arange(-HALF_EXTENT_M, HALF_EXTENT_M, 20.0):
        for near, far, z, p in (
            (-LANE_WIDTH_M, LANE_WIDTH_M, 0.0, paint),
            (LANE_WIDTH_M, LANE_WIDTH_M + 2, -0.02, walk),
            (-LANE_WIDTH_M - 2, -LANE_WIDTH_M, -0.02, walk),
        ):
            uv = [(s, near), (s + 20, near), (s + 20, far), (s, far)]
            parts.append(_flat([at.on_road(*c) for c in uv], uv, z, p))
    return join(parts)


def _tracks(at: Junction, rng: Rng) -> list[Part]:
    """Ballast, sleepers and rails."""
    seed, brown = int(rng.integers(1 << 20)), rng.random() < 0.5
    stones = Paint(Material.GRIT, (0.17, 0.14, 0.12) if brown else (0.25, 0.25, 0.24), paints.TERRAIN, seed)
    wood = Paint(
        Material.WOOD if brown else Material.PLAIN, (0.09, 0.07, 0.06) if brown else (0.33, 0.32, 0.3), 0, seed
    )
    steel = Paint(Material.PLAIN, linear("#7a6a60"), paints.POLE, seed)
    low, high = at.tracks[0] - 2.4, at.tracks[-1] + 2.4
    parts = []
    for x in np.arange(-HALF_EXTENT_M, HALF_EXTENT_M, 20.0):
        uv = [(x, low), (x + 20, low), (x + 20, high), (x, high)]
        parts.append(_flat([np.array(c) for c in uv], uv, -0.04, stones))
    for y in at.tracks:
        for x in np.arange(-HALF_EXTENT_M, HALF_EXTENT_M, 0.65):
            parts.append(box((x, y - 1.3, -0.06), (x + 0.26, y + 1.3, -0.01), wood))
        for side in (-1, 1):
            middle = y + side * TRACK_GAUGE_M / 2
            parts.append(
                box((-HALF_EXTENT_M, middle - 0.035, -0.05), (HALF_EXTENT_M, middle + 0.035, RAIL_TOP_M), steel)
            )
    return parts


def _lights(at: Junction, rng: Rng) -> list[Part]:
    """A traffic light beside each of the road's lanes, and a sign."""
    parts = []
    for way in (-1, 1):
        s, t = -way * (7.5 + (TRACK_SPACING_M if way == -1 else 0)), -way * (LANE_WIDTH_M + 0.8)
        facing = at.road + (np.pi / 2 if way == -1 else -np.pi / 2)
        seed = int(rng.integers(1 << 20))
        parts.append(roadside.traffic_light(seed).moved(facing, at.on_road(s, t)))
        parts.append(objects.sign(int(rng.integers(7))).moved(facing, at.on_road(4 * s, t)))
    return parts


def _masts(at: Junction, rng: Rng) -> list[Part]:
    """Masts and wires of an overhead line, on a share of the crossings, and lamps along the road."""
    parts: list[Part] = []
    if rng.random() < 0.7:
        steel = Paint(Material.PLAIN, grey(rng, 0.1, 0.5), paints.POLE)
        y, step = at.tracks[-1] + 3.2, float(rng.uniform(38, 55))
        for x in np.arange(-HALF_EXTENT_M + float(rng.uniform(0, step)), HALF_EXTENT_M, step):
            if abs(x) < 9:
                continue
            parts.append(box((x - 0.14, y - 0.14, -0.1), (x + 0.14, y + 0.14, 7.4), steel))
            parts.append(box((x - 0.05, at.tracks[0] - 0.4, 6.2), (x + 0.05, y, 6.3), steel, bottom=True))
        for track in at.tracks:
            for z in (5.4, 6.6):
                parts.append(
                    box(
                        (-HALF_EXTENT_M, track - 0.012, z),
                        (HALF_EXTENT_M, track + 0.012, z + 0.024),
                        steel,
                        bottom=True,
                    )
                )
    for s in np.arange(-80, 81, float(rng.uniform(25, 40))):
        if abs(s) > 11:
            parts.append(objects.lamp().moved(at.road + np.pi, at.on_road(float(s), LANE_WIDTH_M + 1.3)))
    return parts


def _buildings(at: Junction, style: Style, rng: Rng) -> list[Part]:
    """Randomly placed houses and halls, clear of tracks and road."""
    parts: list[Part] = []
    taken: list[F64] = []
    for _ in range(int(rng.integers(12, 60))):
        xy = rng.uniform(-110, 110, 2)
        width, depth = float(rng.uniform(8, 18)), float(rng.uniform(8, 13))
        radius = 0.6 * float(np.hypot(width, depth))
        if at.clearance(xy) < radius + 3.5 or any(np.hypot(*(xy - other)) < 17 for other in taken):
            continue
        taken.append(xy)
        turn = float(rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2]) + (at.road if rng.random() < 0.4 else 0.0))
        if rng.random() < 0.25:
            mesh = halls.hall(
                width, depth, float(rng.uniform(4, 9)), (grey(rng), grey(rng)), int(rng.integers(1 << 20))
            )
        else:
            mesh = objects.house(_house(width, depth, style, rng))
        parts.append(mesh.moved(0.0, (-width / 2, -depth / 2, 0)).moved(turn, (*xy, -0.08)))
    return parts


def _house(width: float, depth: float, style: Style, rng: Rng) -> House:
    def pick(colours: tuple[paints.RGB, ...]) -> paints.RGB:
        return colours[rng.integers(len(colours))]

    brick = bool(rng.random() < style.brick_share)
    return House(
        side=1, s=0.0, width=width, front=0.0, depth=depth, storeys=style.storeys[rng.integers(len(style.storeys))],
        roof=("gable", "front_gable", "flat")[rng.integers(3)], pitch=float(np.radians(rng.uniform(32, 45))),
        brick=brick, colour=pick(style.brick if brick else style.plaster), trim=pick(style.trim), door=pick(style.door),
        tiles=pick(style.roof), shop=None, seed=int(rng.integers(1 << 20)),
    )  # fmt: skip


def _trees(at: Junction, style: Style, rng: Rng) -> list[Part]:
    """Randomly placed trees, of varying density."""
    parts = []
    for _ in range(int(rng.integers(10, 90))):
        xy, height = rng.uniform(-120, 120, 2), float(rng.uniform(5, 12))
        if at.clearance(xy) < 3.5 + 0.25 * height:
            continue
        colour = style.foliage[rng.integers(len(style.foliage))]
        plan = Tree(0, 0, height, height * float(rng.uniform(0.22, 0.36)), colour, int(rng.integers(1 << 20)))
        parts.append(leafy_tree(plan, 1).moved(0.0, (*xy, -0.08)))
    return parts


def _borders(at: Junction, rng: Rng) -> list[Part]:
    """Fences and walls along the tracks."""
    parts = []
    for y in (at.tracks[0] - 5.5, at.tracks[-1] + 5.5):
        if rng.random() < 0.5:
            continue
        height, tint, seed = float(rng.uniform(0.8, 1.5)), grey(rng), int(rng.integers(1 << 20))
        for x in np.arange(-120, 120, 6.0):
            if at.clearance(np.array([x + 3, y])) > 4 and rng.random() < 0.9:
                fence = borders.wire_fence if seed % 2 else borders.slat_fence
                parts.append(fence(6.0, height, tint, seed).moved(0.0, (x, y, -0.08)))
    return parts
