"""A town along a driven path: what stands where (`planner`), and its triangles near a place.

Houses, towers, trees, hedges, walls, lamps, signs and parked cars, each drawn from the seed. Meshes are made
when the camera comes near and forgotten behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.ground import Ground, lay_ground
from scan2sim.data_samples.hills import FLAT, heights
from scan2sim.data_samples.paints import Material, Paint
from scan2sim.data_samples.paths import chainage
from scan2sim.data_samples.planner import Planner, Thing
from scan2sim.data_samples.shapes import Part, box, join
from scan2sim.pipeline.core.types import F64

LOW, LOOKS = np.radians(9.0), 60.0
"""Elevation of a low sun; metres ahead of the path's start that it stands over."""
SKY = (0.35, 0.55)  # openness to the sky of what faces down, and how much more of what faces up


@dataclass
class Town:
    """All of a town; deterministic for a path and a seed.

    Attributes:
        ground: of it.
        seed: of everything.
        things: that stand in it.
        sun: (3,) towards it, unit.
        low_sun: whether it dazzles.
    """

    ground: Ground
    seed: int
    things: list[Thing]
    sun: F64
    low_sun: bool = False
    _made: dict[int, Part] = field(default_factory=dict, repr=False)

    def near(self, centre: npt.ArrayLike, radius: float) -> Part:
        """Meshes of what stands within `radius` of `centre` (2,), in coordinates relative to it."""
        at = np.array([t.at for t in self.things]) - np.asarray(centre)
        index = np.flatnonzero((at**2).sum(axis=1) < radius**2)
        self._made = {i: self._made.get(i) or self._placed(i) for i in index.tolist()}
        parts = [self._made[i].moved(0.0, (*at[i], self.things[i].z)) for i in index.tolist()]
        nothing = box((0, 0, -3), (1, 1, -2), Paint(Material.PLAIN, (0, 0, 0), 0))
        return self.lifted(join(parts or [nothing]), centre)

    def lifted(self, part: Part, centre: npt.ArrayLike) -> Part:
        """A part, in coordinates relative to `centre` (2,), on the hills."""
        up = heights(part.vertices[:, :2] + np.asarray(centre), self.ground.hills)
        return replace(part, vertices=part.vertices + np.column_stack([0 * up, 0 * up, up]).astype(np.float32))

    def _placed(self, index: int) -> Part:
        thing = self.things[index]
        return lit(thing.make().moved(thing.heading, (0.0, 0.0, 0.0)))


def lit(part: Part) -> Part:
    """The part with its openness to the sky guessed from its normals where it isn't known."""
    guess = SKY[0] + (SKY[1] - SKY[0]) * (part.normals[:, 2] + 1) + 0.15 * (1 - np.abs(part.normals[:, 2]))
    return replace(part, sky=np.where(np.isnan(part.sky), guess, part.sky).astype(np.float32))


def build(path: F64, seed: int = 0, *, hills: F64 = FLAT, low_sun: bool = False) -> Town:
    """The town around a path (N, 2), on hills (`hills.draw`); a low sun stands where the path leads, and dazzles."""
    rng = np.random.default_rng([seed, 21])
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(38, 55))
    if low_sun:
        ahead = path[np.searchsorted(chainage(path), LOOKS) - 1] - path[0]
        azimuth, elevation = np.arctan2(ahead[1], ahead[0]), LOW
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return Town(ground := lay_ground(path, hills), seed, Planner(ground, rng).plan(), sun, low_sun)
