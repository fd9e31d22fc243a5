"""Random layout of a street: positions and parameters of all objects, from a seed and a `Style`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.paints import RGB, Paint, linear
from scan2sim.data_samples.shapes import Field, Part, waves
from scan2sim.pipeline.core.types import F64, Frame

Span = tuple[float, float]
Side = Literal[1, -1]

FRAME = Frame("EPSG:32633", (391204.0, 5820377.0, 34.0))
HALF_WIDTH = 20.0


@dataclass(frozen=True)
class Style:
    """Ranges and choices of a street's random parameters; change them to vary its appearance.

    Lengths in metres, angles in degrees, colours in linear RGB, shares in [0, 1]. `moving_car`: whether a car drives in
    the other lane; without it everything else is the same.
    """

    curve_radius: Span = (260.0, 900.0)
    slope: Span = (-0.018, 0.018)
    lane_width: Span = (3.1, 3.5)
    pavement: float = 2.3
    kerb: float = 0.12
    house_width: Span = (8.5, 13.5)
    storeys: tuple[int, ...] = (2, 2, 2, 3, 3)
    front_garden: Span = (0.6, 4.2)
    gap_share: float = 0.42
    shop_share: float = 0.22
    brick_share: float = 0.38
    flat_roof_share: float = 0.2
    tree_spacing: Span = (8.5, 13.0)
    tree_height: Span = (5.4, 8.6)
    parked_spacing: Span = (6.2, 15.0)
    moving_car: bool = True
    sun_elevation: Span = (40.0, 56.0)
    sun_strength: Span = (0.80, 0.95)
    sky_strength: Span = (0.40, 0.48)
    cloudiness: Span = (0.25, 0.52)
    asphalt: tuple[RGB, ...] = (linear("#6c6c6d"), linear("#636468"), linear("#747270"))
    plaster: tuple[RGB, ...] = tuple(
        linear(c)
        for c in ("#e6d3a8", "#e9e2d2", "#d9a98b", "#c9d0c0", "#dcc08a", "#b9c4cf", "#efe9dd", "#d8b7a6", "#e3c7b0")
    )
    brick: tuple[RGB, ...] = tuple(linear(c) for c in ("#a5533c", "#8f4a3a", "#b4714f", "#9c6248", "#c0a078"))
    roof: tuple[RGB, ...] = tuple(linear(c) for c in ("#9c4a35", "#86463a", "#5c5653", "#b05a3c", "#4c4f55"))
    door: tuple[RGB, ...] = tuple(linear(c) for c in ("#3d5c46", "#6b2a25", "#2f4663", "#5a3d28", "#2e2e30", "#8c6d3f"))
    trim: tuple[RGB, ...] = tuple(linear(c) for c in ("#efece4", "#e4ddcc", "#d8d5ce", "#bfb6a4"))
    foliage: tuple[RGB, ...] = tuple(linear(c) for c in ("#6f8746", "#5d7a42", "#7d8f4e", "#68854d", "#8a9550"))
    car: tuple[RGB, ...] = tuple(
        linear(c) for c in ("#a41e22", "#1f3f7a", "#c9ccd0", "#f0f0ee", "#2a2c30", "#54606a", "#3b6e5a", "#b98a2e")
    )


@dataclass(frozen=True)
class Axis:
    """Axis of the road: a circular arc of signed `curvature` (1/m), chainage s from 0 to `length`.

    Offsets t are to the left of the axis. The origin of local coordinates is the middle of the arc.
    """

    length: float
    heading: float
    curvature: float

    def place(self, s: npt.ArrayLike, t: npt.ArrayLike) -> tuple[F64, F64]:
        """Local xy (..., 2) and heading (...) at chainage `s` and offset `t`."""
        s = np.asarray(s, np.float64) - self.length / 2
        heading = self.heading + s * self.curvature
        middle = self.heading + s * self.curvature / 2
        chord = s * np.sinc(s * self.curvature / 2 / np.pi)
        t = np.asarray(t, np.float64)
        x = chord * np.cos(middle) - t * np.sin(heading)
        y = chord * np.sin(middle) + t * np.cos(heading)
        return np.stack([x, y], axis=-1), heading

    def locate(self, xy: npt.ArrayLike) -> tuple[F64, F64]:
        """Chainage and offset of local points (..., 2): the inverse of `place`."""
        xy = np.asarray(xy, np.float64)
        radius = 1 / self.curvature
        centre = radius * np.array([-np.sin(self.heading), np.cos(self.heading)])
        d = (xy - centre) * np.sign(radius)
        angle = np.arctan2(d[..., 0], -d[..., 1]) - self.heading
        angle = (angle + np.pi) % (2 * np.pi) - np.pi
        return angle * radius + self.length / 2, radius - np.sign(radius) * np.linalg.norm(d, axis=-1)


@dataclass(frozen=True)
class House:
    """A house that starts at chainage s, its front wall at distance `front` from the axis."""

    side: Side
    s: float
    width: float
    front: float
    depth: float
    storeys: int
    roof: Literal["gable", "front_gable", "flat"]
    pitch: float
    brick: bool
    colour: RGB
    trim: RGB
    door: RGB
    tiles: RGB
    shop: int | None
    seed: int


@dataclass(frozen=True)
class Tree:
    """A tree, or a shrub if `bush`, at chainage s and offset t."""

    s: float
    t: float
    height: float
    radius: float
    colour: RGB
    seed: int
    bush: bool = False


@dataclass(frozen=True)
class Boundary:
    """Border of a garden along chainage s0..s1 at offset t."""

    kind: Literal["hedge", "brick_wall", "picket_fence", "iron_fence"]
    s0: float
    s1: float
    t: float
    colour: RGB
    seed: int


@dataclass(frozen=True)
class Post:
    """A lamp, or a pole with a sign (index into `signs.NAMES`) for traffic that drives towards +s (1) or -s (-1)."""

    s: float
    t: float
    sign: int | None = None
    towards: Side = 1


@dataclass(frozen=True)
class ParkedCar:
    """A parked car; `towards`: direction of its front, +s (1) or -s (-1)."""

    s: float
    t: float
    towards: Side
    colour: RGB


@dataclass(frozen=True)
class Walk:
    """A strip of ground beside the road that replaces the slabs, from `near` to `far` metres off the axis."""

    side: Side
    near: float
    far: float
    paint: Paint


@dataclass(frozen=True)
class PlacedObject:
    """An additional object (`variety`) whose mesh is created when the street is built.

    Attributes:
        s, t: chainage and offset.
        turn: rotation of its x axis from the road's direction, radians.
        make: creates the mesh.
        movable: not part of the static world: a vehicle, a person.
    """

    s: float
    t: float
    turn: float
    make: Callable[[], Part]
    movable: bool = False


@dataclass(frozen=True)
class Layout:
    """Layout of a whole street.

    Attributes:
        lane: half the width of the carriageway, metres.
        parking: side of the parking bays.
        sun: (3,) unit vector towards the sun.
        road: parameters of the asphalt's markings: half width, chainage of the zebra crossing and of a dash.
        moving: colour of the moving car.
        hills, bumps: relief of the terrain beside the road.
        bays: paint of the parking bays; None: setts.
        walks: ground that replaces slabs and grass.
        extras: additional objects (`variety`).
        pavement: width of the pavement, metres.
        kerb_height: metres.
    """

    axis: Axis
    slope: float
    lane: float
    parking: Side
    sun: F64
    sun_strength: float
    sky_strength: float
    cloudiness: float
    asphalt: RGB
    road: F64
    houses: tuple[House, ...]
    trees: tuple[Tree, ...]
    boundaries: tuple[Boundary, ...]
    posts: tuple[Post, ...]
    parked: tuple[ParkedCar, ...]
    moving: RGB
    moving_car: bool
    seed: int
    hills: Field = field(repr=False)
    bumps: Field = field(repr=False)
    bays: Paint | None = None
    walks: tuple[Walk, ...] = ()
    extras: tuple[PlacedObject, ...] = ()
    pavement: float = 2.3
    kerb_height: float = 0.12

    BAY = 2.15

    def kerb(self, side: int) -> float:
        """Distance of the kerb from the axis."""
        return self.lane + (self.BAY if side == self.parking else 0.0)

    def garden(self, side: int) -> float:
        """Distance from the axis where the pavement ends."""
        return self.kerb(side) + self.pavement

    def height(self, s: npt.ArrayLike, t: npt.ArrayLike, *, below_kerb: bool = False) -> F64:
        """Height of the ground at (s, t); exactly at the kerb that of its upper edge, or the lower if `below_kerb`."""
        s, t = np.broadcast_arrays(np.asarray(s, np.float64), np.asarray(t, np.float64))
        z = np.zeros(s.shape)
        for side in (1, -1):
            k, g = self.kerb(side), self.garden(side)
            u = t * side
            step = 1e-5 if below_kerb else -1e-5
            camber = np.interp(
                u, [0, self.lane, k + step, k + step + 1e-6, g, HALF_WIDTH],
                [0, -0.024 * self.lane, -0.024 * self.lane - 0.02 * (k - self.lane),
                 -0.024 * self.lane - 0.02 * (k - self.lane) + self.kerb_height,
                 -0.024 * self.lane + self.kerb_height + 0.02, 0.45],
            )  # fmt: skip
            z = np.where(u >= 0, camber, z)
            wild = u > g
            st, into = np.stack([s[wild], t[wild]], axis=-1), u[wild] - g
            z[wild] += 0.22 * np.clip(into / 3, 0, 1) * self.hills(st) + 0.035 * np.clip(into / 0.4, 0, 1) * self.bumps(
                st
            )
        x = s - self.axis.length / 2
        return z + self.slope * x + 0.12 * np.sin(x / 17.0)


def lay_out(length: float, seed: int, style: Style | None = None) -> Layout:
    """Random layout of a street of `length` metres."""
    style = style or Style()
    rng = np.random.default_rng([seed, 1])
    lane = rng.uniform(*style.lane_width)
    axis = Axis(length, rng.uniform(0.2, 1.2), float(rng.choice([-1, 1]) / rng.uniform(*style.curve_radius)))
    parking: Side = 1 if rng.random() < 0.5 else -1
    sun = _sun(rng, axis, style)
    zebra = length * rng.uniform(0.52, 0.7) if length >= 18 else -100.0
    kerb = {side: lane + (Layout.BAY if side == parking else 0.0) for side in (1, -1)}
    garden = {side: k + style.pavement for side, k in kerb.items()}
    houses = [h for side in (1, -1) for h in _houses(rng, style, length, side, garden[side])]
    trees = _trees(rng, style, length, kerb, garden, houses, zebra)
    return Layout(
        axis=axis,
        slope=rng.uniform(*style.slope),
        lane=lane,
        parking=parking,
        sun=sun,
        sun_strength=rng.uniform(*style.sun_strength),
        sky_strength=rng.uniform(*style.sky_strength),
        cloudiness=rng.uniform(*style.cloudiness),
        asphalt=_pick(rng, style.asphalt),
        road=np.array([lane, zebra, rng.uniform(0, 6)]),
        houses=tuple(houses),
        boundaries=tuple(_boundaries(rng, style, length, garden, houses)),
        trees=tuple(trees),
        posts=tuple(_posts(rng, length, kerb, zebra, trees)),
        parked=tuple(_parked(rng, style, length, lane, parking, zebra)),
        moving=_pick(rng, style.car),  # always drawn, so that the random numbers after it don't depend on the car
        moving_car=style.moving_car,
        seed=seed,
        hills=waves(rng, 7.0, dimensions=2),
        bumps=waves(rng, 1.3, dimensions=2),
        pavement=style.pavement,
        kerb_height=style.kerb,
    )


def _pick(rng: np.random.Generator, colours: tuple[RGB, ...]) -> RGB:
    """One of the colours with a small random change."""
    colour, change = np.array(colours[rng.integers(len(colours))]), rng.uniform(0.92, 1.06, 3)
    r, g, b = colour * (0.7 * change.mean() + 0.3 * change)  # varies brightness more than hue
    return float(r), float(g), float(b)


def _sun(rng: np.random.Generator, axis: Axis, style: Style) -> F64:
    """Unit vector towards the sun: rather across the street than along it, and behind the recording vehicle."""
    azimuth = axis.heading + rng.choice([-1, 1]) * rng.uniform(2.2, 2.75)
    elevation = np.radians(rng.uniform(*style.sun_elevation))
    return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


def _houses(rng: np.random.Generator, style: Style, length: float, side: Side, garden: float) -> list[House]:
    """A row of houses within the street's ends, some adjoining, some with gaps."""
    houses: list[House] = []
    s = rng.uniform(0.3, 1.5)
    setback = rng.uniform(*style.front_garden)
    while True:
        width = float(np.round(rng.uniform(*style.house_width), 2))
        if s + width > length - 0.3:
            width = length - 0.3 - s
            if width < 5.5:
                return houses
        brick = bool(rng.random() < style.brick_share)
        flat = rng.random() < style.flat_roof_share
        roof: Literal["gable", "front_gable", "flat"] = (
            "flat" if flat else ("front_gable" if rng.random() < 0.3 else "gable")
        )
        shop = int(rng.integers(4)) if rng.random() < style.shop_share else None
        front = garden + (0.25 if shop is not None else setback)
        houses.append(
            House(
                side=side, s=s, width=width, front=front,
                depth=float(np.clip(HALF_WIDTH - 0.8 - front, 5.0, rng.uniform(8, 10))),
                storeys=int(rng.choice(style.storeys)), roof=roof, pitch=np.radians(rng.uniform(36, 47)), brick=brick,
                colour=_pick(rng, style.brick if brick else style.plaster), trim=_pick(rng, style.trim),
                door=_pick(rng, style.door), tiles=_pick(rng, style.roof), shop=shop, seed=int(rng.integers(1 << 20)),
            )
        )  # fmt: skip
        s += width
        if rng.random() < style.gap_share:
            s += rng.uniform(2.2, 5.0)
            setback = rng.uniform(*style.front_garden)


def _trees(
    rng: np.random.Generator, style: Style, length: float, kerb: dict[int, float], garden: dict[int, float],
    houses: list[House], zebra: float,
) -> list[Tree]:  # fmt: skip
    """Trees along the kerb and in the gaps, bushes in the front gardens."""
    trees = []
    for side in (1, -1):
        s = rng.uniform(2.0, 5.0)
        while s < length - 2.0:
            if abs(s - zebra) > 3.0:
                trees.append(_tree(rng, style, s, side * (kerb[side] + 0.62), 1.0))
            s += rng.uniform(*style.tree_spacing)
        for h in (h for h in houses if h.side == side):
            deep = h.front - garden[side]
            for s in np.arange(h.s + 0.9, h.s + h.width - 0.7, 1.5):
                if deep > 1.2 and rng.random() < 0.5:
                    r = rng.uniform(0.3, min(0.75, deep / 2.6))
                    t = side * (h.front - r - 0.15 - rng.uniform(0, max(deep - 2 * r - 0.6, 0)))
                    trees.append(
                        Tree(float(s), t, 1.5 * r, r, _pick(rng, style.foliage), int(rng.integers(1 << 20)), True)
                    )
        for s0, s1 in _gaps(houses, side, length):
            if s1 - s0 > 1.8:
                t = side * (garden[side] + rng.uniform(4.5, 8))
                trees.append(_tree(rng, style, (s0 + s1) / 2, t, 0.85))
    return trees


def _tree(rng: np.random.Generator, style: Style, s: float, t: float, scale: float) -> Tree:
    height = scale * rng.uniform(*style.tree_height)
    return Tree(s, t, height, height * rng.uniform(0.24, 0.30), _pick(rng, style.foliage), int(rng.integers(1 << 20)))


def _gaps(houses: list[House], side: int, length: float) -> list[Span]:
    row = [h for h in houses if h.side == side]
    starts, ends = [h.s for h in row] + [length], [0.0] + [h.s + h.width for h in row]
    return [(a, b) for a, b in zip(ends, starts, strict=True) if b - a > 1.0]


def _boundaries(
    rng: np.random.Generator, style: Style, length: float, garden: dict[int, float], houses: list[House]
) -> list[Boundary]:
    """Borders along every front garden (with an opening at the door) and across every gap."""
    borders = []
    kinds = ("hedge", "brick_wall", "picket_fence", "iron_fence")

    def add(kind: str, s0: float, s1: float, t: float) -> None:
        colours = {
            "hedge": style.foliage,
            "brick_wall": style.brick,
            "picket_fence": style.trim,
            "iron_fence": style.door,
        }
        if s1 - s0 > 0.6:
            colour, seed = _pick(rng, colours[kind]), int(rng.integers(1 << 20))
            borders.append(Boundary(kind, float(s0), float(s1), t, colour, seed))  # type: ignore[arg-type]

    for side in (1, -1):
        turn = int(rng.integers(4))
        for h in (h for h in houses if h.side == side):
            t = side * (garden[side] + 0.28)
            if h.shop is None and h.front - garden[side] > 1.0:
                turn += 1
                middle = h.s + h.width / 2 + rng.uniform(-1.5, 1.5)
                add(kinds[turn % 4], h.s + 0.1, middle - 0.7, t)
                add(kinds[turn % 4], middle + 0.7, h.s + h.width - 0.1, t)
        for s0, s1 in _gaps(houses, side, length):
            turn += 1
            add(kinds[turn % 3], s0 + 0.08, s1 - 0.08, side * (garden[side] + rng.uniform(0.3, 1.0)))
    return borders


def _posts(
    rng: np.random.Generator, length: float, kerb: dict[int, float], zebra: float, trees: list[Tree]
) -> list[Post]:
    """Lamps every 19 to 24 m, and signs along the kerbs, clear of trees."""

    def clear(s: float, t: float) -> float:
        near = [tree.s for tree in trees if abs(tree.t - t) < 1.5 and abs(tree.s - s) < 1.7]
        return float(np.clip(s + (2.2 if near and near[0] <= s else -2.2 if near else 0.0), 1.0, length - 1.0))

    posts = []
    lamp_side = 1 if rng.random() < 0.5 else -1
    for s in np.arange(rng.uniform(4, 8), length - 1, rng.uniform(19, 24)):
        t = lamp_side * (kerb[lamp_side] + 0.45)
        posts.append(Post(clear(s, t), t))
    if zebra > 0:
        posts += [Post(zebra - 2.6, -(kerb[-1] + 0.4), 0, 1), Post(zebra + 2.6, kerb[1] + 0.4, 0, -1)]
    signs = rng.permutation(np.arange(1, 7))
    for i, s in enumerate(np.arange(rng.uniform(2.5, 5), length - 1, rng.uniform(10, 14))):
        towards: Side = 1 if i % 2 == 0 else -1
        t = -towards * (kerb[-towards] + 0.4)
        if abs(s - zebra) > 4:
            posts.append(Post(clear(s, t), t, int(signs[i % 6]), towards))
    return posts


def _parked(
    rng: np.random.Generator, style: Style, length: float, lane: float, side: Side, zebra: float
) -> list[ParkedCar]:
    cars = []
    s = rng.uniform(3.2, 6.0)
    while s < length - 2.6:
        if abs(s - zebra) > 5.5:
            towards: Side = 1 if (side == -1) == (rng.random() < 0.85) else -1
            cars.append(ParkedCar(s, side * (lane + 1.08 + rng.uniform(-0.1, 0.1)), towards, _pick(rng, style.car)))
        s += rng.uniform(*style.parked_spacing)
    return cars
