"""A town along a driven path: what stands where (`planner`), and its triangles near a place.

Houses, towers, trees, hedges, walls, lamps, signs and parked cars, each drawn from the seed. Meshes are made
when the camera comes near and forgotten behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.ground import Ground, lay_ground
from scan2sim.data_samples.paints import Material, Paint
from scan2sim.data_samples.planner import Planner, Thing
from scan2sim.data_samples.shapes import Part, box, join
from scan2sim.pipeline.types import F64

SKY = (0.35, 0.55)  # openness to the sky of what faces down, and how much more of what faces up


@dataclass
class Town:
    """All of a town; deterministic for a path and a seed."""

    ground: Ground
    seed: int
    things: list[Thing]
    sun: F64
    _made: dict[int, Part] = field(default_factory=dict, repr=False)

    def near(self, centre: npt.ArrayLike, radius: float) -> Part:
        """Meshes of what stands within `radius` of `centre` (2,), in coordinates relative to it."""
        at = np.array([t.at for t in self.things]) - np.asarray(centre)
        index = np.flatnonzero((at**2).sum(axis=1) < radius**2)
        self._made = {i: self._made.get(i) or self._placed(i) for i in index.tolist()}
        parts = [self._made[i].moved(0.0, (*at[i], self.things[i].z)) for i in index.tolist()]
        return join(parts or [box((0, 0, -3), (1, 1, -2), Paint(Material.PLAIN, (0, 0, 0), 0)).moved(0.0, (0, 0, 0))])

    def _placed(self, index: int) -> Part:
        thing = self.things[index]
        return lit(thing.make().moved(thing.heading, (0.0, 0.0, 0.0)))


def lit(part: Part) -> Part:
    """The part with its openness to the sky guessed from its normals where it isn't known."""
    guess = SKY[0] + (SKY[1] - SKY[0]) * (part.normals[:, 2] + 1) + 0.15 * (1 - np.abs(part.normals[:, 2]))
    return replace(part, sky=np.where(np.isnan(part.sky), guess, part.sky).astype(np.float32))


def build(path: F64, seed: int = 0) -> Town:
    """The town around a path (N, 2)."""
    rng = np.random.default_rng([seed, 21])
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(38, 55))
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return Town(ground := lay_ground(path), seed, Planner(ground, rng).plan(), sun)
