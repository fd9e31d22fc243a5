"""A town along a driven path: positions of its objects (`planner`), and their meshes near a position.

Houses, towers, trees, hedges, walls, lamps, signs and parked cars are random by the seed. Meshes are created when the
camera approaches and discarded behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.ground import Ground, lay_ground
from scan2sim.data_samples.hills import FLAT, heights
from scan2sim.data_samples.paints import Material, Paint
from scan2sim.data_samples.paths import chainage
from scan2sim.data_samples.planner import PlacedObject, Planner
from scan2sim.data_samples.shapes import Part, box, join
from scan2sim.pipeline.core.types import F64

LOW_SUN_ELEVATION, SUN_LOOKAHEAD_M = np.radians(9.0), 60.0
"""Elevation of a low sun, radians; distance along the path to the point above which it stands."""
SKY_OPENNESS = (0.35, 0.55)  # guessed sky openness of surfaces that face down, and up


@dataclass
class Town:
    """A town; deterministic for a path and a seed.

    Attributes:
        ground: its ground.
        seed: seed of all random numbers.
        placed: objects in the town.
        sun: (3,) unit vector towards the sun.
        low_sun: whether a low sun dazzles the camera.
    """

    ground: Ground
    seed: int
    placed: list[PlacedObject]
    sun: F64
    low_sun: bool = False
    _meshes: dict[int, Part] = field(default_factory=dict, repr=False)

    def near(self, centre: npt.ArrayLike, radius: float) -> Part:
        """Mesh of all objects within `radius` of `centre` (2,), in coordinates relative to it."""
        at = np.array([t.at for t in self.placed]) - np.asarray(centre)
        index = np.flatnonzero((at**2).sum(axis=1) < radius**2)
        self._meshes = {i: self._meshes.get(i) or self._mesh(i) for i in index.tolist()}
        parts = [self._meshes[i].moved(0.0, (*at[i], self.placed[i].z)) for i in index.tolist()]
        buried = box((0, 0, -3), (1, 1, -2), Paint(Material.PLAIN, (0, 0, 0), 0))  # a mesh must not be empty
        return self.lifted(join(parts or [buried]), centre)

    def lifted(self, part: Part, centre: npt.ArrayLike) -> Part:
        """Mesh in coordinates relative to `centre` (2,), raised by the height of the hills."""
        up = heights(part.vertices[:, :2] + np.asarray(centre), self.ground.hills)
        return replace(part, vertices=part.vertices + np.column_stack([0 * up, 0 * up, up]).astype(np.float32))

    def _mesh(self, index: int) -> Part:
        placed = self.placed[index]
        return with_sky_openness(placed.make().moved(placed.heading, (0.0, 0.0, 0.0)))


def with_sky_openness(part: Part) -> Part:
    """Mesh with its sky openness guessed from its normals where it is unknown."""
    guess = (
        SKY_OPENNESS[0]
        + (SKY_OPENNESS[1] - SKY_OPENNESS[0]) * (part.normals[:, 2] + 1)
        + 0.15 * (1 - np.abs(part.normals[:, 2]))
    )
    return replace(part, sky=np.where(np.isnan(part.sky), guess, part.sky).astype(np.float32))


def build(path: F64, seed: int = 0, *, hills: F64 = FLAT, low_sun: bool = False) -> Town:
    """Random town around a path (N, 2), on hills (`hills.draw`); a low sun stands ahead of the path's start."""
    rng = np.random.default_rng([seed, 21])
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(38, 55))
    if low_sun:
        ahead = path[np.searchsorted(chainage(path), SUN_LOOKAHEAD_M) - 1] - path[0]
        azimuth, elevation = np.arctan2(ahead[1], ahead[0]), LOW_SUN_ELEVATION
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return Town(ground := lay_ground(path, hills), seed, Planner(ground, rng).plan(), sun, low_sun)
