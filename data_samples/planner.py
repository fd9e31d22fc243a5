"""Random placement of a town's objects: none on a road, none on the plot of another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scan2sim.data_samples import objects
from scan2sim.data_samples.ground import CELL_M, HALF_ROAD_M, KERB_HEIGHT_M, PAVEMENT_WIDTH_M, Ground
from scan2sim.data_samples.layout import Boundary, House, Style, Tree
from scan2sim.data_samples.paints import RGB
from scan2sim.data_samples.plants import hedge, leafy_tree, shrub
from scan2sim.data_samples.shapes import Part
from scan2sim.pipeline.core.types import F64, U8

PLOT_DISTANCE_M = HALF_ROAD_M + PAVEMENT_WIDTH_M  # distance of the plots from the centre line


@dataclass(frozen=True)
class PlacedObject:
    """An object in the town.

    Attributes:
        at: (2,) world position, metres.
        heading: rotation about z, radians.
        make: creates its mesh, in its own coordinates.
        z: height above the road, metres.
    """

    at: F64
    heading: float
    make: Callable[[], Part]
    z: float = KERB_HEIGHT_M


class Planner:
    """Places the objects one after another; `taken` is the raster of occupied cells."""

    def __init__(self, ground: Ground, rng: np.random.Generator) -> None:
        from scipy.spatial import cKDTree

        self.ground, self.rng, self.style = ground, rng, Style()
        self.taken: U8 = np.zeros(ground.distance.shape, np.uint8)
        self.driven = cKDTree(ground.driven)
        self.placed: list[PlacedObject] = []

    def plan(self) -> list[PlacedObject]:
        """Place all objects: along the kerbs, in the rows of buildings, and behind them."""
        for a, b in self.ground.runs():
            for side in (1, -1):
                self._kerbside(a, b, side)
                self._row(a, b, side)
        self._behind()
        return self.placed

    def _pick(self, colours: tuple[RGB, ...]) -> RGB:
        colour = np.array(colours[self.rng.integers(len(colours))]) * self.rng.uniform(0.8, 1.1)
        r, g, b = np.clip(colour * self.rng.uniform(0.95, 1.05, 3), 0, 0.9).tolist()
        return r, g, b

    def _seed(self) -> int:
        return int(self.rng.integers(1 << 20))

    def _place(self, index: int, offset: float) -> tuple[F64, float]:
        """Position (2,) at `offset` to the left of point `index` of the centre lines, and the line's heading."""
        point = self.ground.line[index]
        return point[:2] + offset * np.array([-point[3], point[2]]), float(np.arctan2(point[3], point[2]))

    def _claim(self, corners: F64, clear: float) -> bool:
        """Whether a convex plot (K, 2) is free and at least `clear` from all centre lines; marks it as taken if so."""
        import cv2

        mix = np.linspace(0, 1, 9)[:, None, None]
        rim = (corners * (1 - mix) + np.roll(corners, 1, axis=0) * mix).reshape(-1, 2)
        if self.ground.at(np.concatenate([rim, corners.mean(axis=0, keepdims=True)])).min() < clear:
            return False
        cells = np.round((corners - self.ground.origin) / CELL_M).astype(np.int32)
        (x0, y0), (x1, y1) = cells.min(axis=0), cells.max(axis=0) + 1
        if x0 < 0 or y0 < 0 or x1 > self.taken.shape[1] or y1 > self.taken.shape[0]:
            return False
        plot = np.zeros((y1 - y0, x1 - x0), np.uint8)
        cv2.fillConvexPoly(plot, cells - [x0, y0], 1)
        here = self.taken[y0:y1, x0:x1]
        if (here & plot).any():
            return False
        here |= plot
        return True

    def _row(self, a: int, b: int, side: int) -> None:
        """Houses along one side of a section of road, with gardens and their borders."""
        i, setback = float(a), self.rng.uniform(0.6, 5.0)
        while True:
            width, depth = self.rng.uniform(8.5, 15.0), self.rng.uniform(8.0, 11.0)
            middle = int(i + width / 2 / 0.25)
            if middle >= b:
                return
            on_kerb, along = self._place(middle, side * PLOT_DISTANCE_M)
            turn = along + (0.0 if side == 1 else np.pi)
            ahead, inwards = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
            left = on_kerb + setback * inwards - width / 2 * ahead
            corners = left + np.stack([0 * ahead, width * ahead, width * ahead + depth * inwards, depth * inwards])
            if not self._claim(corners, PLOT_DISTANCE_M + 0.4):
                i += 3.0 / 0.25
                continue
            plan = self._house(width, depth, int(self.rng.choice([2, 2, 3, 3, 4])))
            self.placed.append(PlacedObject(left, turn, partial(objects.house, plan)))
            self._front_garden(left - (setback - 0.35) * inwards, ahead, turn, width, setback)
            i += width / 0.25
            if self.rng.random() < 0.35:  # a gap with a tree
                gap = self.rng.uniform(2.5, 9.0)
                self._tree(left + (width + gap / 2) * ahead + self.rng.uniform(2, 7) * inwards, 0.9)
                i += gap / 0.25
                setback = self.rng.uniform(0.6, 5.0)

    def _house(self, width: float, depth: float, storeys: int) -> House:
        s, rng = self.style, self.rng
        brick, kind = bool(rng.random() < 0.4), rng.random()
        return House(
            side=1, s=0.0, width=width, front=0.0, depth=depth, storeys=storeys,
            roof="flat" if kind < 0.25 or storeys > 4 else "front_gable" if kind < 0.5 else "gable",
            pitch=float(np.radians(rng.uniform(34, 47))), brick=brick,
            colour=self._pick(s.brick if brick else s.plaster),
            trim=self._pick(s.trim), door=self._pick(s.door), tiles=self._pick(s.roof),
            shop=int(rng.integers(4)) if rng.random() < 0.3 else None, seed=self._seed(),
        )  # fmt: skip

    def _front_garden(self, corner: F64, ahead: F64, turn: float, width: float, setback: float) -> None:
        """A hedge or a wall with a gap in the middle, and bushes, in front of a house with enough setback."""
        if setback < 1.5:
            return
        kind, colour = self.rng.integers(3), self._pick(self.style.foliage)
        for start, length in ((0.1, width / 2 - 0.9), (width / 2 + 0.7, width / 2 - 0.9)):
            at = corner + start * ahead
            if (
                self.ground.at(at) < PLOT_DISTANCE_M - 0.3
                or self.ground.at(at + length * ahead) < PLOT_DISTANCE_M - 0.3
            ):
                continue
            if kind == 0:
                brick = self._pick(self.style.brick)
                wall = Boundary("brick_wall", 0.0, length, 0.0, brick, self._seed())
                self.placed.append(PlacedObject(at, turn, partial(objects.boundary, wall, length)))
            elif kind == 1:
                height = self.rng.uniform(0.8, 1.6)
                self.placed.append(PlacedObject(at, turn, partial(hedge, length, height, colour, self._seed())))
            inwards = np.array([-ahead[1], ahead[0]])
            bush = partial(shrub, self.rng.uniform(0.4, 0.8), self._pick(self.style.foliage), self._seed())
            self.placed.append(PlacedObject(at + length / 2 * ahead + setback / 2 * inwards, 0.0, bush))

    def _kerbside(self, a: int, b: int, side: int) -> None:
        """Trees, lamps and signs on the pavement, and parked cars."""
        rng = self.rng
        green = False
        for i in range(a, b, 28):  # every 7 m
            if rng.random() < 0.15:
                green = not green
            xy, along = self._place(int(i + rng.integers(28)) if i + 28 < b else i, side * (HALF_ROAD_M + 0.8))
            if self.ground.at(xy) > HALF_ROAD_M + 0.5:
                if (i - a) // 28 % 4 == 0:
                    self.placed.append(PlacedObject(xy, along + (np.pi if side == 1 else 0.0), objects.lamp))
                elif green:
                    self._tree(xy, 0.8)
                elif rng.random() < 0.3:
                    face = along + (np.pi / 2 if side == 1 else -np.pi / 2)
                    self.placed.append(PlacedObject(xy, face, partial(objects.sign, int(rng.integers(7)))))
            xy, along = self._place(min(i + 14, b - 1), side * (HALF_ROAD_M - 1.05))
            clear = self.driven.query(xy)[0] > 2.3 and self.ground.at(xy) > HALF_ROAD_M - 1.3
            if rng.random() < 0.45 and clear:
                colour = self._pick(self.style.car)
                heading = along + (np.pi if side == 1 else 0.0)
                self.placed.append(PlacedObject(xy, heading, partial(objects.car, colour), z=0.01))

    def _tree(self, at: F64, scale: float, rounds: int = 2) -> None:
        height = scale * self.rng.uniform(5.5, 10.0)
        plan = Tree(0, 0, height, height * self.rng.uniform(0.24, 0.34), self._pick(self.style.foliage), self._seed())
        around = np.array([(-0.6, -0.6), (0.6, -0.6), (0.6, 0.6), (-0.6, 0.6)]) + at
        if self._claim(around, HALF_ROAD_M + 0.1):
            self.placed.append(PlacedObject(at, 0.0, partial(leafy_tree, plan, rounds)))

    def _behind(self) -> None:
        """Taller houses and trees further from the roads, visible above roofs and through gaps."""
        line, rng = self.ground.line, self.rng
        for i in range(0, len(line), 30):
            offset = rng.uniform(PLOT_DISTANCE_M + 14, PLOT_DISTANCE_M + 50) * rng.choice([-1, 1])
            at, along = self._place(i, offset)
            width, depth, turn = rng.uniform(10, 18), rng.uniform(9, 13), along + rng.choice([0, np.pi / 2])
            ahead, inwards = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
            corners = at + np.stack([0 * ahead, width * ahead, width * ahead + depth * inwards, depth * inwards])
            if rng.random() < 0.6 and self._claim(corners, PLOT_DISTANCE_M + 3):
                storeys = int(rng.choice([2, 3, 4, 5, 6, 8]))
                house = replace(self._house(width, depth, storeys), shop=None)
                self.placed.append(PlacedObject(at, turn, partial(objects.house, house)))
            for _ in range(3):
                at, _ = self._place(i, rng.uniform(PLOT_DISTANCE_M + 1, PLOT_DISTANCE_M + 45) * rng.choice([-1, 1]))
                if self.ground.at(at) > PLOT_DISTANCE_M + 1:
                    self._tree(at, rng.uniform(0.8, 1.5), rounds=1)
