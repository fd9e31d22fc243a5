"""Meshes of trains: locomotives, coaches and wagons, x forwards, the origin on the ground below their centre."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from scan2sim.data_samples import paints, signs
from scan2sim.data_samples.paints import RGB, Material, Paint, linear
from scan2sim.data_samples.shapes import Part, blob, box, join, part, quads, tube
from scan2sim.data_samples.traffic import end_panel, glass, panel
from scan2sim.pipeline.core.types import F64

Rng = np.random.Generator

COUPLING_GAP_M = 1.0
"""Between the bodies of two coupled vehicles."""
WHEEL_RADIUS_M = 0.46
LAMP_RGB: RGB = (0.95, 0.93, 0.85)
DARK_RGB: RGB = (0.016, 0.016, 0.018)


class Livery(NamedTuple):
    """Colours of a train: bodies, band below the windows, doors and fronts, roofs."""

    body: RGB
    band: RGB
    door: RGB
    roof: RGB


LIVERIES = tuple(
    Livery(linear(a), linear(b), linear(c), linear(d))
    for a, b, c, d in (
        ("#c4161c", "#e8e6e0", "#a01014", "#6d7072"), ("#e9e9e6", "#c0141b", "#dcdcd8", "#8a8d8f"),
        ("#1f4e8c", "#f0c419", "#f0c419", "#55595c"), ("#1f6b43", "#e5ddc0", "#17472d", "#4a4d4c"),
        ("#d9dadb", "#3c6fb0", "#f2c230", "#777b7e"), ("#6b2d2a", "#c9a55c", "#4b1f1d", "#3d3b39"),
        ("#f3b61f", "#26282b", "#26282b", "#5b5e60"), ("#2b2e33", "#d4572a", "#d4572a", "#2b2e33"),
    )
)  # fmt: skip
WAGON_COLOURS = ("#7a3b2a", "#5a5f63", "#8a8f92", "#33523f", "#284a72", "#a8622b", "#b8b29f", "#3b3a38")
CONTAINER_COLOURS = ("#b5372a", "#1f5a8f", "#2f7a4a", "#d98a1f", "#8d9499", "#e6e4dd", "#5b2f5f", "#213047")


def random_train(rng: Rng) -> list[tuple[Part, float]]:
    """A random train from head to tail: mesh and length in metres of each vehicle.

    Kinds: multiple units with a cab at both ends, locomotives with coaches, locomotives with wagons.
    """
    livery, kind = LIVERIES[rng.integers(len(LIVERIES))], rng.random()
    if kind < 0.3:
        length, tall = float(rng.uniform(17, 24)), bool(rng.random() < 0.3)
        cars = [coach(length, livery, rng, tall=tall) for _ in range(int(rng.integers(0, 4)))]
        head, tail = (coach(length, livery, rng, tall=tall, cab=way) for way in (1, -1))
        return [(mesh, length) for mesh in (head, *cars, tail)]
    length = float(rng.uniform(15, 20))
    engine = (locomotive(length, livery, rng), length)
    if kind < 0.62:
        other, size = (
            LIVERIES[rng.integers(len(LIVERIES))] if rng.random() < 0.5 else livery,
            float(rng.uniform(20, 26)),
        )
        tall = bool(rng.random() < 0.3)
        return [engine, *((coach(size, other, rng, tall=tall), size) for _ in range(int(rng.integers(2, 8))))]
    makers: tuple[Callable[[float, Rng], Part], ...] = (covered, tank, hopper, flat)
    mixed, only = rng.random() < 0.5, int(rng.integers(len(makers)))
    wagons = []
    for _ in range(int(rng.integers(3, 14))):
        size = float(rng.uniform(11, 17))
        wagons.append((makers[int(rng.integers(len(makers))) if mixed else only](size, rng), size))
    return [engine, *wagons]


def loft(x: F64, sections: F64, paint: Paint) -> Part:
    """Closed body through convex sections (N, K, 2) at x (N,); y, z counter-clockwise seen from the front."""
    n, k = sections.shape[:2]
    at = np.broadcast_to(x[:, None, None], (n, k, 1))
    xyz = np.concatenate([at, sections], axis=2)
    here, there = xyz[:-1], xyz[1:]
    sides = np.stack([here, there, np.roll(there, -1, axis=1), np.roll(here, -1, axis=1)], axis=2).reshape(-1, 4, 3)
    sides = sides[:, ::-1]
    around = np.abs(sides[:, 0, 2] - sides[:, 3, 2]) > np.abs(sides[:, 0, 1] - sides[:, 3, 1])
    uv = np.where(around[:, None, None], sides[..., [0, 2]], sides[..., [0, 1]])
    fan = np.column_stack([np.zeros(k - 2), np.arange(1, k - 1), np.arange(2, k)]).astype(int)
    ends = [part(xyz[i], fan[:, ::way], xyz[i][:, 1:], paint) for i, way in ((0, -1), (-1, 1))]
    return join([quads(sides, uv, paint), *ends])


def _section(half: float, low: float, high: float, roof: float) -> F64:
    """(K, 2) cross section of a vehicle: straight sides from `low` to `high`, a curved roof above."""
    right = [(-0.94 * half, low), (-half, low + 0.3), (-half, high), (-0.88 * half, high + 0.6 * (roof - high))]
    right.append((-0.5 * half, roof))
    mirrored = [(-y, z) for y, z in right]
    return np.array([*mirrored, *right[::-1]])


def _chassis(length: float, rng: Rng) -> list[Part]:
    """Frame, bogies with their wheels, buffers and couplings."""
    dark = Paint(Material.PLAIN, DARK_RGB, paints.VEHICLE, int(rng.integers(1 << 20)))
    x = length / 2
    parts = [box((-x, -1.2, 0.75), (x, 1.2, 1.1), dark, bottom=True)]
    parts.append(box((-x - COUPLING_GAP_M / 2, -0.12, 0.85), (x + COUPLING_GAP_M / 2, 0.12, 1.05), dark, bottom=True))
    for end in (-1, 1):
        near, far = sorted((end * x, end * (x + 0.4)))
        for y in (-0.85, 0.85):
            parts.append(box((near, y - 0.18, 0.8), (far, y + 0.18, 1.1), dark, bottom=True))
    angle = np.linspace(0, 2 * np.pi, 17)[:-1]
    disc = WHEEL_RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
    fan = np.column_stack([np.zeros(14), np.arange(1, 15), np.arange(2, 16)]).astype(int)
    steel = Paint(Material.PLAIN, (0.07, 0.06, 0.055), paints.VEHICLE)
    for middle in (-0.62 * x, 0.62 * x):
        parts.append(box((middle - 1.5, -1.12, 0.35), (middle + 1.5, 1.12, 0.72), dark, bottom=True))
        for cx in (middle - 0.95, middle + 0.95):
            for side in (-1, 1):
                rim = np.column_stack([cx + disc[:, 0], np.full(16, side * 1.14), WHEEL_RADIUS_M + disc[:, 1]])
                parts.append(part(rim, fan[:, ::-side], 0.6 * disc, steel))
    return parts


def locomotive(length: float, livery: Livery, rng: Rng) -> Part:
    """Two cabs with sloping fronts, grilles, a band, lamps, and gear on the roof."""
    x, half, roof = length / 2, 1.48, float(rng.uniform(3.7, 4.0))
    seed, slope = int(rng.integers(1 << 20)), float(rng.uniform(0.25, 1.4))
    body, band = (Paint(Material.PLAIN, colour, paints.VEHICLE, seed) for colour in (livery.body, livery.band))
    whole, end = _section(half, 0.75, 3.0, roof), _section(0.92 * half, 0.75, 2.0, 2.35)
    parts = _chassis(length, rng)
    parts.append(loft(np.array([-x, -x + slope, x - slope, x]), np.stack([end, whole, whole, end]), body))
    low, high = sorted(rng.uniform(1.1, 2.2, 2))
    for side in (-1, 1):
        parts.append(panel(-x + slope, x - slope, side * (half + 0.01), low, high + 0.1, side, band))
        pitch = (length - 2 * slope - 4.4) / (count := int(rng.integers(3, 8)))
        for i in range(count):
            start = -x + slope + 2.2 + i * pitch
            grille = Paint(Material.PANELS, DARK_RGB, paints.VEHICLE, seed + 1)
            parts.append(panel(start, start + 0.6 * pitch, side * (half + 0.02), 2.3, 2.95, side, grille))
        for way in (-1, 1):
            near, far = sorted((way * (x - slope - 0.3), way * (x - slope - 1.2)))
            parts.append(panel(near, far, side * (half + 0.02), 2.2, 2.85, side, glass(rng)))
        logo = Paint(Material.SIGN, (1, 1, 1), paints.VEHICLE, int(rng.integers(len(signs.NAMES))))
        parts.append(panel(-1.0, 1.0, side * (half + 0.025), 1.35, 2.0, side, logo, unit=True))
    parts += [_front(way, x, slope, roof, livery, rng) for way in (-1, 1)]
    dark = Paint(Material.PLAIN, (0.06, 0.06, 0.065), paints.VEHICLE, seed)
    parts.append(box((-0.3 * length, -0.6, roof), (0.3 * length, 0.6, roof + 0.2), dark))
    for a in (-0.3 * length, 0.22 * length):
        parts.append(tube([(a, 0, roof), (a + 0.9, 0, roof + 0.6), (a, 0, roof + 1.1)], [0.04] * 3, dark, 5))
        parts.append(box((a - 0.15, -0.8, roof + 1.1), (a + 0.15, 0.8, roof + 1.15), dark, bottom=True))
    return join(parts)


def _front(way: int, x: float, slope: float, roof: float, livery: Livery, rng: Rng) -> Part:
    """Windscreen, lamps and warning colour of the front that faces `way` (1: +x, -1: -x)."""
    low, high = np.array([x, 2.35]), np.array([x - slope, roof])
    out = np.array([high[1] - low[1], low[0] - high[0]])
    out = 0.02 * out / np.linalg.norm(out)
    (ax, az), (bx, bz) = low + 0.12 * (high - low) + out, low + 0.72 * (high - low) + out
    pane = np.array([(ax, -1.1, az), (ax, 1.1, az), (bx, 1.05, bz), (bx, -1.05, bz)]) * (way, way, 1)
    tall = float(np.hypot(bx - ax, bz - az))
    parts = [quads([pane], [[(0, 0), (2.2, 0), (2.2, tall), (0, tall)]], glass(rng), size=(2.2, tall))]
    colour = Paint(Material.PLAIN, livery.door, paints.VEHICLE, int(rng.integers(1 << 20)))
    parts.append(end_panel(way * (x + 0.01), 1.2, 1.0, 1.7, way, colour))
    lamp = Paint(Material.PLAIN, LAMP_RGB, paints.VEHICLE)
    for y in (-0.9, 0.9):
        parts.append(end_panel(way * (x + 0.03), 0.16, 1.35, 1.65, way, lamp).moved(0.0, (0, y, 0)))
    return join(parts)


def coach(length: float, livery: Livery, rng: Rng, *, tall: bool = False, cab: int = 0) -> Part:
    """A passenger coach: a row of windows (`tall`: two), doors, a band; `cab`: side of a driver's cab, 1, -1 or 0."""
    x, half, roof = length / 2, 1.42, 4.55 if tall else 3.9
    seed, slope = int(rng.integers(1 << 20)), float(rng.uniform(0.6, 2.0))
    body, band, door, top = (Paint(Material.PLAIN, colour, paints.VEHICLE, seed) for colour in livery)
    whole, end = _section(half, 0.6, 3.6 if tall else 3.05, roof), _section(0.92 * half, 0.6, 2.0, 2.35)
    at, outline = [-x, x], [whole, whole]
    if cab:
        at.insert(1, cab * (x - slope))
        outline.insert(1, whole)
        outline[2 if cab == 1 else 0] = end
    parts = [*_chassis(length, rng), loft(np.array(at), np.stack(outline), body)]
    a, b = (-x, x - slope) if cab == 1 else (-x + slope, x) if cab else (-x, x)
    parts.append(box((a + 0.2, -0.5 * half, roof - 0.02), (b - 0.2, 0.5 * half, roof + 0.06), top))
    rows = (1.15, 2.75) if tall else (1.85,)
    pitch, wide = float(rng.uniform(1.4, 2.6)), float(rng.uniform(0.75, 0.92))
    doors = (a + 2.0, b - 3.2) if rng.random() < 0.6 else (a + (b - a) / 3, b - (b - a) / 3)
    stripe = sorted(rng.uniform(0.8, 1.8, 2)) if rng.random() < 0.5 else (1.75, 2.85)
    for side in (-1, 1):
        parts.append(panel(a, b, side * (half + 0.01), stripe[0], stripe[1] + 0.1, side, band))
        for z in rows:
            for i in range(count := int((b - a) / pitch)):
                p, q = a + (i + 0.5 - wide / 2) * (b - a) / count, a + (i + 0.5 + wide / 2) * (b - a) / count
                parts.append(panel(p, q, side * (half + 0.02), z, z + 0.85, side, glass(rng)))
        for p in doors:
            parts.append(panel(p, p + 1.3, side * (half + 0.03), 0.7, 2.8, side, door))
            parts.append(panel(p + 0.15, p + 1.15, side * (half + 0.035), 1.7, 2.6, side, glass(rng)))
        logo = Paint(Material.SIGN, (1, 1, 1), paints.VEHICLE, int(rng.integers(len(signs.NAMES))))
        parts.append(panel(-2.6, -1.2, side * (half + 0.025), 1.0, 1.6, side, logo, unit=True))
    if cab:
        parts.append(_front(cab, x, slope, roof, livery, rng))
    return join(parts)


def _wagon_paint(colours: tuple[str, ...], rng: Rng, material: Material = Material.PANELS) -> Paint:
    colour = np.array(linear(colours[rng.integers(len(colours))])) * rng.uniform(0.7, 1.2)
    r, g, b = np.clip(colour, 0.01, 0.9).tolist()
    return Paint(material, (r, g, b), paints.VEHICLE, int(rng.integers(1 << 20)))


def covered(length: float, rng: Rng) -> Part:
    """A covered wagon with a sliding door."""
    x, skin = length / 2, _wagon_paint(WAGON_COLOURS, rng)
    outline = _section(1.4, 1.1, 3.0, float(rng.uniform(3.5, 4.0)))
    parts = [*_chassis(length, rng), loft(np.array([-x, x]), np.stack([outline, outline]), skin)]
    for side in (-1, 1):
        door = _wagon_paint(WAGON_COLOURS, rng, Material.PLAIN)
        parts.append(panel(-1.3, 1.3, side * 1.42, 1.2, 2.95, side, door))
    return join(parts)


def tank(length: float, rng: Rng) -> Part:
    """A tank wagon: a horizontal drum with a dome and a band."""
    x, radius = length / 2, float(rng.uniform(1.15, 1.4))
    skin = _wagon_paint((*WAGON_COLOURS, "#e2e0d8", "#151618"), rng, Material.PLAIN)
    z = 1.15 + radius
    drum = tube(
        [(-x + 0.3, 0, z), (-x + 0.31, 0, z), (0, 0, z), (x - 0.3, 0, z)], [0.02, radius, radius, radius], skin, 20
    )
    ring = tube(
        [(-0.4, 0, z), (0.4, 0, z)], [1.01 * radius] * 2, _wagon_paint(CONTAINER_COLOURS, rng, Material.PLAIN), 20
    )
    dome = tube([(0, 0, z), (0, 0, z + radius + 0.25)], [0.35, 0.35], skin, 10)
    return join([*_chassis(length, rng), drum, ring, dome])


def hopper(length: float, rng: Rng) -> Part:
    """An open wagon loaded with bulk goods."""
    x, high, skin = length / 2, float(rng.uniform(2.4, 3.2)), _wagon_paint(WAGON_COLOURS, rng)
    heap = Paint(Material.GRIT, (0.05, 0.045, 0.04), paints.VEHICLE, int(rng.integers(1 << 20)))
    load = blob((0, 0, high - 0.1), (x - 0.3, 1.2, 0.45), rng, heap, bump=0.2)
    rib, y = skin._replace(material=Material.PLAIN), 1.4
    ribs = [
        box((a - 0.06, side * y - 0.06, 1.1), (a + 0.06, side * y + 0.06, high), rib)
        for a in np.arange(-x + 0.8, x - 0.5, 1.6) for side in (-1, 1)
    ]  # fmt: skip
    return join([*_chassis(length, rng), box((-x, -1.4, 1.1), (x, 1.4, high), skin, bottom=True), load, *ribs])


def flat(length: float, rng: Rng) -> Part:
    """A flat wagon with up to two containers."""
    parts, a = _chassis(length, rng), -length / 2 + 0.2
    for _ in range(2):
        size = float(rng.choice([6.1, 12.2]))
        if a + size > length / 2 or rng.random() < 0.15:
            continue
        skin = _wagon_paint(CONTAINER_COLOURS, rng)
        parts.append(box((a, -1.22, 1.15), (a + size, 1.22, 3.75), skin, bottom=True))
        for side in (-1, 1):
            logo = Paint(Material.SIGN, (1, 1, 1), paints.VEHICLE, int(rng.integers(len(signs.NAMES))))
            parts.append(panel(a + 0.5, a + 2.6, side * 1.235, 2.4, 3.3, side, logo, unit=True))
        a += size + 0.3
    return join(parts)
