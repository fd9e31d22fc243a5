"""Synthetic buildings with exact ground truth: storeys with a corridor and rooms, staircase, furniture.

`python -m scan2sim.data_samples.robot_map OUT` drives a robot through one and writes its map and the truth.

The structure (walls, slabs, stairs, pillars, panes) consists of axis-parallel blocks. Its surface is the boundary
between solid and empty cells of the grid through all block faces: closed, without internal or coincident faces.
Furniture stands on the floor, at any heading. Coordinates: metres, z up, floor of storey 0 at z = 0, corridor along x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F64, U8, Bools, Frame, Mesh

OUTER_WALL_M = 0.2
DOOR_HEIGHT_M = 2.05
WINDOW_SILL_M, WINDOW_TOP_M = 0.9, 2.15
PANE_M = 0.02  # thickness
SLAB_M = 0.25
GLASS_WALL_HEIGHT_M = 2.4
RISE_M, TREAD_M = 0.17, 0.27  # of a stair, the rise before it is adjusted to the storey's height
FLIGHT_WIDTH_M, LANDING_M, GALLERY_M = 1.2, 1.3, 1.4
RAILING_HEIGHT_M, RAILING_M = 1.0, 0.08
PILLAR_M = 0.4
PILLAR_AREA_M2 = 24.0  # rooms from this size on have a pillar
ROUTE_CLEARANCE_M = 0.55  # distance of furniture from the robot's route
ROUTE_START_M = 0.8  # distance of the route's ends from the corridor's ends


class Surface(IntEnum):
    """Kind of a true face, and of a point of a simulated map."""

    FLOOR = 1
    WALL = 2
    CEILING = 3
    STAIRS = 4
    FURNITURE = 5
    PILLAR = 6
    WINDOW = 7  # opaque pane
    GLASS = 8  # pane without lidar returns
    ROOF = 9  # top of the building, outside
    FOUNDATION = 10  # underside of the building, outside
    PERSON = 11  # only in maps
    OUTLIER = 12  # only in maps
    REFLECTION = 13  # only in maps: something mirrored by a polished floor


LAS_CODE = {
    Surface.FLOOR: CODE["terrain"], Surface.STAIRS: CODE["terrain"], Surface.WALL: CODE["building"],
    Surface.CEILING: CODE["building"], Surface.PILLAR: CODE["building"], Surface.WINDOW: CODE["building"],
    Surface.GLASS: CODE["building"], Surface.ROOF: CODE["building"], Surface.FOUNDATION: CODE["building"],
    Surface.FURNITURE: CODE["unclassified"], Surface.PERSON: CODE["person"], Surface.OUTLIER: CODE["low_noise"],
    Surface.REFLECTION: CODE["low_noise"],
}  # fmt: skip
"""The project's class of each surface; furniture has none."""


@dataclass(frozen=True)
class Style:
    """Options and ranges (low, high) of a building.

    Attributes:
        storeys: number of storeys; 2 with `stairs`.
        rooms: number of rooms on each side of the corridor.
        stairs: a staircase at the corridor's end joins storeys 0 and 1.
        glass: panes of windows let lidar beams through, and one room per storey has a glass wall to the corridor.
        furniture: items per square metre of a room.
        storey_height, corridor_width, room_width, room_depth, inner_wall, door_width: metres.
    """

    storeys: int = 1
    rooms: int = 3
    stairs: bool = False
    glass: bool = False
    furniture: float = 0.22
    storey_height: tuple[float, float] = (2.8, 3.2)
    corridor_width: tuple[float, float] = (1.8, 2.6)
    room_width: tuple[float, float] = (3.2, 6.5)
    room_depth: tuple[float, float] = (3.5, 6.0)
    inner_wall: tuple[float, float] = (0.1, 0.16)
    door_width: tuple[float, float] = (0.85, 1.1)


class Room(NamedTuple):
    """A room: its storey, corners (2,) of its floor, x of its door's centre, and y at which the robot turns round."""

    storey: int
    low: F64
    high: F64
    door_x: float
    turn_y: float


class Item(NamedTuple):
    """A piece of furniture: kind, storey, position (2,), heading in radians, boxes (B, 2, 3) in its own axes."""

    kind: str
    storey: int
    xy: F64
    heading: float
    boxes: F64


class Blocks(NamedTuple):
    """Structure as a grid of blocks: cell (i, j, k) spans `cuts[0][i : i + 2]` etc.; 0 is empty, else a Surface."""

    cuts: tuple[F64, F64, F64]
    cells: U8


class FreeSpace(NamedTuple):
    """Occupancy of one storey.

    Attributes:
        origin: (2,) world position of the corner of cell (0, 0), metres.
        cell: side of a cell, metres.
        free: (Y, X), whether all of a cell is free and has floor below it, rows along y.
        floor: height of the storey's floor, metres.
    """

    origin: F64
    cell: float
    free: Bools
    floor: float

    def at(self, xy: npt.ArrayLike) -> Bools:
        """(N,) whether positions (N, 2) are in a free cell; outside the grid nothing is free."""
        i = np.floor((np.asarray(xy, np.float64) - self.origin) / self.cell).astype(int)
        inside: Bools = np.asarray(((i >= 0) & (i < self.free.shape[::-1])).all(axis=1))
        i = np.where(inside[:, None], i, 0)
        return inside & self.free[i[:, 1], i[:, 0]]

    def swept(self, start: npt.ArrayLike, radius: float) -> FreeSpace:
        """The part that a disc of this radius sweeps from where it fits nearest to `start` (2,)."""
        from scipy.ndimage import distance_transform_edt, label

        fits = distance_transform_edt(np.pad(self.free, 1))[1:-1, 1:-1] * self.cell >= radius
        parts, count = label(fits, np.ones((3, 3)))
        if not count:
            return self._replace(free=fits)
        at = np.argwhere(fits)
        row, column = at[np.linalg.norm(self.origin + (at[:, ::-1] + 0.5) * self.cell - start, axis=1).argmin()]
        away = distance_transform_edt(parts != parts[row, column]) * self.cell
        return self._replace(free=self.free & (away <= radius))


@dataclass(frozen=True)
class Building:
    """A building and its truth; everything in metres, z up.

    Attributes:
        mesh: triangles, facing the air, `classification` by `LAS_CODE`.
        surface: (F,) `Surface` of each face.
        doors, windows: (D, 4, 3) and (W, 4, 3) rectangles in the middle plane of their walls.
        rooms, items: rooms and furniture.
        floors: height of each storey's floor.
        routes: (N, 3) polylines on the floor that a robot drives, in order; between two it takes the lift.
        blocks: the structure.
    """

    mesh: Mesh
    surface: U8
    doors: F64
    windows: F64
    rooms: tuple[Room, ...]
    items: tuple[Item, ...]
    floors: tuple[float, ...]
    routes: tuple[F64, ...]
    blocks: Blocks

    def only(self, *kinds: Surface) -> Mesh:
        """The faces of some kinds."""
        return self.mesh.keep(np.isin(self.surface, kinds))

    def free_space(
        self, storey: int, *, cell: float = 0.05, low: float = 0.05, high: float = 0.5, clearance: float = 0.0
    ) -> FreeSpace:
        """Occupancy for a robot on a storey.

        Args:
            storey: index of the storey.
            cell: side of a cell, metres.
            low, high: heights above the floor between which a free cell is empty, metres.
            clearance: minimum distance of free cells from the nearest cell that isn't free, metres.
        """
        from scipy.ndimage import distance_transform_edt

        floor = self.floors[storey]
        (x, y, z), cells = self.blocks
        first, last = np.array([x[0], y[0]]), np.array([x[-1], y[-1]])
        count = np.ceil((last - first) / cell).astype(int)
        at = [first[k] + (np.arange(count[k]) + 0.5) * cell for k in range(2)]
        layers = (z[1:] > floor + low) & (z[:-1] < floor + high)
        below = int(np.searchsorted(z, floor - 1e-6, "right")) - 1
        blocked = (cells[:, :, layers] > 0).any(axis=2) | (cells[:, :, below] != Surface.FLOOR)
        total = np.pad(blocked.astype(int), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
        i, j = (
            [np.clip(np.searchsorted(c, a + s * (cell / 2 - 1e-6)) - (s < 0), 0, len(c) - 1) for s in (-1, 1)]
            for c, a in zip((x, y), at, strict=True)
        )
        free = (
            total[np.ix_(i[1], j[1])] + total[np.ix_(i[0], j[0])]
            == total[np.ix_(i[0], j[1])] + total[np.ix_(i[1], j[0])]
        ).T
        xy, margin = np.stack(np.meshgrid(*at), axis=-1), cell / 2**0.5  # of a cell's corners from its centre
        for item in self.items:
            if item.storey == storey:
                own = (xy - item.xy) @ _turn(item.heading)
                for lower, upper in item.boxes:
                    if upper[2] > low and lower[2] < high:
                        free &= ~((own >= lower[:2] - margin) & (own <= upper[:2] + margin)).all(axis=-1)
        if clearance > 0:
            free &= distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * cell >= clearance
        return FreeSpace(first, cell, free, floor)


def build(seed: int, style: Style | None = None) -> Building:
    """Building of a seed.

    Raises:
        SettingError: a staircase in a building that hasn't two storeys.
    """
    style = style or Style()
    if style.stairs and style.storeys != 2:
        raise SettingError("stairs", f"there are {style.storeys} storeys", "Set storeys to 2: stairs join two")
    return _Builder(style, np.random.default_rng([seed, 91])).build()


def _turn(heading: float) -> F64:
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s], [s, c]])


@dataclass
class _Builder:
    """Lays out the building, block by block: later blocks replace earlier ones."""

    style: Style
    rng: np.random.Generator
    painted: list[tuple[F64, F64, int]] = field(default_factory=list)
    doors: list[F64] = field(default_factory=list)
    windows: list[F64] = field(default_factory=list)
    rooms: list[Room] = field(default_factory=list)
    items: list[Item] = field(default_factory=list)

    def build(self) -> Building:
        style, draw = self.style, self.draw
        self.height, self.corridor, self.inner = (
            draw(r) for r in (style.storey_height, style.corridor_width, style.inner_wall)
        )
        self.depth = draw(style.room_depth), draw(style.room_depth)  # of the rooms at low and high y
        walls = (style.rooms - 1) * self.inner
        self.length = sum(draw(style.room_width) for _ in range(style.rooms)) + walls
        self.steps = round(self.height / RISE_M)
        self.flight_x = self.length + OUTER_WALL_M + LANDING_M, (self.steps - 1) * TREAD_M  # start, length
        floors = tuple(k * self.height for k in range(style.storeys))
        self._shell()
        for k, floor in enumerate(floors):
            self._storey(k, floor)
        if style.stairs:
            self._staircase()
        blocks = self._grid()
        corners, surface = _boundary(blocks)
        quads = [corners, *(_item_quads(item, floors[item.storey]) for item in self.items)]
        surface = np.concatenate([surface, np.full(sum(map(len, quads[1:])), Surface.FURNITURE, np.uint8)])
        mesh, surface = _mesh(np.concatenate(quads), surface)
        return Building(
            mesh, surface, np.array(self.doors).reshape(-1, 4, 3), np.array(self.windows).reshape(-1, 4, 3),
            tuple(self.rooms), tuple(self.items), floors, self._routes(floors), blocks,
        )  # fmt: skip

    def draw(self, limits: tuple[float, float]) -> float:
        """Uniform random number, rounded to centimetres."""
        return round(float(self.rng.uniform(*limits)), 2)

    def paint(self, low: Sequence[float], high: Sequence[float], material: int) -> None:
        self.painted.append((np.array(low, float), np.array(high, float), material))

    def _shell(self) -> None:
        """Solid blocks with slabs, from which rooms are cut."""
        t, top = OUTER_WALL_M, self.style.storeys * self.height - SLAB_M
        outlines = [
            ((-t, -self.inner - self.depth[0] - t), (self.length + t, self.corridor + self.inner + self.depth[1] + t))
        ]
        if self.style.stairs:
            x = self.flight_x[0] + self.flight_x[1] + LANDING_M
            outlines.append(((self.length, -t), (x + t, FLIGHT_WIDTH_M + GALLERY_M + t)))
        for low, high in outlines:
            self.paint((*low, -SLAB_M), (*high, top), Surface.WALL)
        for k in range(self.style.storeys + 1):
            for low, high in outlines:
                self.paint((*low, k * self.height - SLAB_M), (*high, k * self.height), Surface.FLOOR)

    def _storey(self, k: int, floor: float) -> None:
        style, inner = self.style, self.inner
        self._cut((0, 0, floor), (self.length, self.corridor, floor + self.height - SLAB_M))
        glazed = int(self.rng.integers(2 * style.rooms)) if style.glass else -1
        for side in range(2):
            widths = np.array([self.draw(style.room_width) for _ in range(style.rooms)])
            widths *= (self.length - (style.rooms - 1) * inner) / widths.sum()
            starts = np.round(np.cumsum([0.0, *(widths[:-1] + inner)]), 3)
            ends = np.append(starts[1:] - inner, self.length)
            y0, y1 = (-inner - self.depth[0], -inner) if side == 0 else (self.corridor + inner,) * 2
            y1 = y1 if side == 0 else y0 + self.depth[1]
            for i, (x0, x1) in enumerate(zip(starts, ends, strict=True)):
                self._room(k, floor, (x0, y0), (x1, y1), side, glazed == side * style.rooms + i)

    def _cut(self, low: Sequence[float], high: Sequence[float]) -> None:
        self.paint(low, high, 0)

    def _room(
        self, k: int, floor: float, low: tuple[float, float], high: tuple[float, float], side: int, glazed: bool
    ) -> None:
        style, rng = self.style, self.rng
        (x0, y0), (x1, y1) = low, high
        self._cut((x0, y0, floor), (x1, y1, floor + self.height - SLAB_M))
        wide = self.draw(style.door_width)
        door = round(float(rng.uniform(x0 + wide / 2 + 0.2, x1 - wide / 2 - 0.2)), 2)
        # walls to the corridor and to the outside, as ranges of y
        front, back = ((y1, y1 + self.inner), (y0 - OUTER_WALL_M, y0)) if side == 0 else (
            (y0 - self.inner, y0), (y1, y1 + OUTER_WALL_M))  # fmt: skip
        if glazed:
            self._opening(x0 + 0.1, x1 - 0.1, front, floor, floor + GLASS_WALL_HEIGHT_M, Surface.GLASS)
            for x in (door - wide / 2, door + wide / 2):  # door frame
                self.paint((x - 0.05, front[0], floor), (x + 0.05, front[1], floor + GLASS_WALL_HEIGHT_M), Surface.WALL)
        self.doors.append(self._opening(door - wide / 2, door + wide / 2, front, floor, floor + DOOR_HEIGHT_M))
        pane = Surface.GLASS if style.glass else Surface.WINDOW
        count = max(1, int((x1 - x0) / 3))
        for middle in x0 + (np.arange(count) + 0.5) * (x1 - x0) / count:
            half = round(float(rng.uniform(0.5, 0.9)), 2)
            z = floor + WINDOW_SILL_M, floor + WINDOW_TOP_M
            self.windows.append(self._opening(middle - half, middle + half, back, *z, pane))
        turn = y1 - 0.65 * (y1 - y0) if side == 0 else y0 + 0.65 * (y1 - y0)
        room = Room(k, np.array(low), np.array(high), door, turn)
        self.rooms.append(room)
        strip = np.array([
            [door - ROUTE_CLEARANCE_M, min(turn, *front) - ROUTE_CLEARANCE_M],
            [door + ROUTE_CLEARANCE_M, max(turn, *front) + ROUTE_CLEARANCE_M],
        ])  # fmt: skip
        taken = [strip]
        if (x1 - x0) * (y1 - y0) > PILLAR_AREA_M2:
            for _ in range(20):
                at = rng.uniform([x0 + 1, y0 + 1], [x1 - 1, y1 - 1]).round(2)
                box = np.array([at - PILLAR_M / 2, at + PILLAR_M / 2])
                if not _overlaps(box, taken, 0.0):
                    self.paint((*box[0], floor), (*box[1], floor + self.height - SLAB_M), Surface.PILLAR)
                    taken.append(box)
                    break
        self._furnish(room, taken)

    def _opening(self, x0: float, x1: float, wall: tuple[float, float], z0: float, z1: float, pane: int = 0) -> F64:
        """Cut an opening into a wall along x, with a pane in its middle plane; returns its rectangle (4, 3) there."""
        self._cut((x0, wall[0], z0), (x1, wall[1], z1))
        y = sum(wall) / 2
        if pane:
            self.paint((x0, y - PANE_M / 2, z0), (x1, y + PANE_M / 2, z1), pane)
        return np.array([(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)])

    def _furnish(self, room: Room, taken: list[F64]) -> None:
        """Place furniture where it touches neither walls, `taken` rectangles (2, 2) nor other furniture."""
        rng, size = self.rng, room.high - room.low
        for _ in range(round(self.style.furniture * float(size.prod()))):
            kind = str(rng.choice(list(_FURNITURE)))
            boxes = _FURNITURE[kind](rng)
            low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
            for _ in range(30):
                quarter = int(rng.integers(4))
                heading = quarter * np.pi / 2 if kind in _AT_WALLS else float(rng.uniform(0, 2 * np.pi))
                corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])]) @ _turn(heading).T
                least, most = room.low - corners.min(axis=0) + 0.03, room.high - corners.max(axis=0) - 0.03
                if (least > most).any():
                    continue
                xy = rng.uniform(least, most)
                if kind in _AT_WALLS:  # its back (+y) to the wall
                    k, upper = ((1, True), (0, False), (1, False), (0, True))[quarter]
                    xy[k] = most[k] if upper else least[k]
                box = np.array([corners.min(axis=0) + xy, corners.max(axis=0) + xy])
                if not _overlaps(box, taken, 0.05):
                    taken.append(box)
                    self.items.append(Item(kind, room.storey, xy, heading, boxes))
                    break

    def _staircase(self) -> None:
        """A flight of solid steps from storey 0 to 1, the hole above it, a railing, and a gallery beside it."""
        x0, length = self.flight_x
        x1, rise, floor = x0 + length, self.height / self.steps, self.height
        far, wide = (x1 + LANDING_M, FLIGHT_WIDTH_M + GALLERY_M), FLIGHT_WIDTH_M + RAILING_M
        for z in (0.0, floor):
            self._cut((self.length + OUTER_WALL_M, 0, z), (*far, z + floor - SLAB_M))
            self._cut((self.length, 0, z), (self.length + OUTER_WALL_M, self.corridor, z + floor - SLAB_M))
        self._cut((x0, 0, floor - SLAB_M), (x1, FLIGHT_WIDTH_M, floor))
        for i in range(self.steps - 1):
            self.paint(
                (x0 + i * TREAD_M, 0, 0), (x0 + (i + 1) * TREAD_M, FLIGHT_WIDTH_M, (i + 1) * rise), Surface.STAIRS
            )
        top = floor + RAILING_HEIGHT_M
        self.paint((x0 - RAILING_M, FLIGHT_WIDTH_M, floor), (x1, wide, top), Surface.WALL)
        self.paint((x0 - RAILING_M, 0, floor), (x0, wide, top), Surface.WALL)

    def _grid(self) -> Blocks:
        low, high = (np.round([block[k] for block in self.painted], 4) for k in range(2))
        x, y, z = (np.unique(np.concatenate([low[:, k], high[:, k]])) for k in range(3))
        cells = np.zeros((len(x) - 1, len(y) - 1, len(z) - 1), np.uint8)
        for a, b, (_, _, material) in zip(low, high, self.painted, strict=True):
            at = [slice(*np.searchsorted(cuts, (a[k], b[k]))) for k, cuts in enumerate((x, y, z))]
            cells[at[0], at[1], at[2]] = material
        return Blocks((x, y, z), cells)

    def _routes(self, floors: tuple[float, ...]) -> tuple[F64, ...]:
        middle, (x0, length) = self.corridor / 2, self.flight_x
        ends = (ROUTE_START_M, middle), (self.length - ROUTE_START_M, middle)
        legs = []
        for k, floor in enumerate(floors):
            rooms = sorted((room for room in self.rooms if room.storey == k), key=lambda room: room.door_x)
            visits = [(r.door_x, y) for r in rooms for y in (middle, r.turn_y, middle)]
            legs.append(np.array([(*xy, floor) for xy in (ends[0], *visits, ends[1])]))
        if not self.style.stairs:
            return tuple(legs)
        x1, flight, half = x0 + length, FLIGHT_WIDTH_M / 2, TREAD_M / 2
        gallery = FLIGHT_WIDTH_M + (RAILING_M + GALLERY_M) / 2
        down, up = floors
        climb = [
            (self.length - 0.1, middle, down), (x0 - LANDING_M / 2, flight, down), (x0 - half, flight, down),
            (x1 + half, flight, up), (x1 + LANDING_M / 2, flight, up), (x1 + LANDING_M / 2, gallery, up),
            (x0 - LANDING_M / 2, gallery, up), (x0 - LANDING_M / 2, middle, up), (self.length - 0.4, middle, up),
        ]  # fmt: skip
        return (np.concatenate([legs[0], climb, legs[1][::-1]]),)


def _overlaps(box: F64, others: Sequence[F64], gap: float) -> bool:
    """Whether a rectangle (2, 2) comes nearer than `gap` to one of the others."""
    return any(bool(((box[0] < other[1] + gap) & (box[1] > other[0] - gap)).all()) for other in others)


def _table(rng: np.random.Generator) -> F64:
    x, y, z = rng.uniform(0.5, 0.9), rng.uniform(0.35, 0.5), rng.uniform(0.7, 0.78)
    legs = [
        ((a - 0.03, b - 0.03, 0), (a + 0.03, b + 0.03, z - 0.04))
        for a in (0.05 - x, x - 0.05)
        for b in (0.05 - y, y - 0.05)
    ]
    return np.array([((-x, -y, z - 0.04), (x, y, z)), *legs])


def _shelf(rng: np.random.Generator) -> F64:
    x, y, top = rng.uniform(0.4, 0.8), rng.uniform(0.15, 0.2), rng.uniform(1.2, 2.1)
    boards = [((-x, -y, z), (x, y, z + 0.03)) for z in np.linspace(0.05, top - 0.03, round(top / 0.4) + 1)]
    sides = [((a, -y, 0), (b, y, top)) for a, b in ((-x - 0.03, -x), (x, x + 0.03))]
    return np.array([*boards, *sides, ((-x, y, 0.05), (x, y + 0.02, top))])


def _box(rng: np.random.Generator) -> F64:
    x, y, z = rng.uniform(0.15, 0.4, 3)
    return np.array([((-x, -y, 0), (x, y, 2 * z))])


def _sofa(rng: np.random.Generator) -> F64:
    x, y, seat = rng.uniform(0.6, 1.0), rng.uniform(0.38, 0.45), rng.uniform(0.4, 0.46)
    arms = [((a, -y, 0), (b, y, seat + 0.18)) for a, b in ((-x - 0.18, -x), (x, x + 0.18))]
    return np.array([((-x, -y, 0), (x, y, seat)), ((-x, y, 0), (x, y + 0.2, seat + 0.4)), *arms])


_FURNITURE = {"table": _table, "shelf": _shelf, "box": _box, "sofa": _sofa}
_AT_WALLS = ("shelf", "sofa")


def _item_quads(item: Item, floor: float) -> F64:
    """(Q, 4, 3) faces of a piece of furniture, counter-clockwise from outside, without those on the floor."""
    quads = []
    for low, high in item.boxes:
        for axis in range(3):
            for end in (0, 1):
                if axis == 2 and end == 0 and low[2] <= 0:
                    continue
                u, v = (axis + 1) % 3, (axis + 2) % 3
                quad = np.empty((4, 3))
                quad[:, axis] = (low, high)[end][axis]
                quad[:, u] = [low[u], high[u], high[u], low[u]]
                quad[:, v] = [low[v], low[v], high[v], high[v]]
                quads.append(quad if end else quad[::-1])
    corners = np.array(quads)
    corners[..., :2] = corners[..., :2] @ _turn(item.heading).T + item.xy
    corners[..., 2] += floor
    return corners


def _boundary(blocks: Blocks) -> tuple[F64, U8]:
    """Faces (Q, 4, 3) between solid and empty cells, counter-clockwise seen from the empty side, and their surfaces.

    Glass counts as empty beside other solids, whose faces are seen through it.
    """
    cuts, cells = blocks.cuts, np.pad(blocks.cells, 1)
    corners, kinds = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        across = np.moveaxis(cells, (axis, u, v), (0, 1, 2))
        for facing in (1, -1):  # direction from the solid to the empty cell
            solid, air = (across[:-1], across[1:]) if facing == 1 else (across[1:], across[:-1])
            clear = (air == 0) | (air == Surface.GLASS)
            show = (solid != 0) & (solid != Surface.GLASS) & clear | (solid == Surface.GLASS) & (air == 0)
            i, j, k = (index - shift for index, shift in zip(np.nonzero(show), (0, 1, 1), strict=True))
            quad = np.empty((len(i), 4, 3))
            quad[..., axis] = cuts[axis][i][:, None]
            quad[..., u] = cuts[u][np.stack([j, j + 1, j + 1, j], axis=1)]
            quad[..., v] = cuts[v][np.stack([k, k, k + 1, k + 1], axis=1)]
            kind = solid[show]
            slab = kind == Surface.FLOOR
            height = quad[:, 0, 2]
            if axis < 2:
                kind = np.where(slab, Surface.WALL, kind)
            elif facing == 1:
                kind = np.where(slab & (height == cuts[2][-1]), Surface.ROOF, kind)
            else:
                kind = np.where(slab, np.where(height == cuts[2][0], Surface.FOUNDATION, Surface.CEILING), kind)
            corners.append(quad if facing == 1 else quad[:, ::-1])
            kinds.append(kind.astype(np.uint8))
    return np.concatenate(corners), np.concatenate(kinds)


def _mesh(quads: F64, surface: U8) -> tuple[Mesh, U8]:
    """Two triangles per quad (Q, 4, 3), and their surfaces."""
    faces = (4 * np.arange(len(quads))[:, None] + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3).astype(np.int32)
    code = np.zeros(256, np.uint8)
    code[list(LAS_CODE)] = list(LAS_CODE.values())
    surface = np.repeat(surface, 2)
    mesh = Mesh(Frame(), quads.reshape(-1, 3).astype(np.float32), faces, classification=code[surface])
    return mesh, surface
