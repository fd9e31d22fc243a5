"""Distance of a world's walls to the true ones, in both directions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bench.maps.chain import World
from bench.maps.command import Missing
from bench.maps.inputs import BenchMap
from scan2sim.data_samples.building import Surface
from scan2sim.pipeline.core.types import F32, Mesh
from scan2sim.pipeline.geometry.surface_distance import distances, sample_surface

SAMPLES = 100_000
OBSERVED_RADIUS_M = 0.15
"""Distance from an exact return within which a true wall counts as seen by the robot."""
WALLS = (Surface.WALL, Surface.PILLAR, Surface.WINDOW)


@dataclass(frozen=True)
class WallDistances:
    """Distances in metres: (N,) from the world's walls to true ones, (M,) from observed true walls to the world's."""

    to_truth: F32
    from_truth: F32

    def summary(self) -> dict[str, float]:
        """Median and 95th percentile of both, centimetres."""
        names = {"wall": self.to_truth, "wall_truth": self.from_truth}
        return {
            f"{name}_{what}_cm": round(100 * float(np.percentile(values, q)), 2)
            for name, values in names.items()
            for what, q in (("median", 50), ("p95", 95))
        }


def wall_distances(one: BenchMap, world: World) -> WallDistances:
    """Measure a simulated map's world.

    Raises:
        Missing: the world has no walls.
    """
    from scipy.spatial import cKDTree

    assert one.building is not None and one.truth is not None
    walls = world.walls
    if not len(walls):
        raise Missing("the world has no vertical faces of a class wall or building")
    true = one.building.only(*WALLS)
    true = true.keep(np.abs(true.face_normal[:, 2]) < 0.5)
    true = replace(true, vertices=_placed(one, world, true))
    samples = sample_surface(true, SAMPLES)
    returns = one.truth.returns
    exact = returns.exact[np.isin(returns.surface, WALLS)]
    T = one.truth.T_map_world
    seen = world.place(exact @ T[:3, :3].T + T[:3, 3])
    near = cKDTree(seen).query(samples, distance_upper_bound=OBSERVED_RADIUS_M, workers=2)[0] < OBSERVED_RADIUS_M
    return WallDistances(distances(sample_surface(walls, SAMPLES), true), distances(samples[near], walls))


def _placed(one: BenchMap, world: World, mesh: Mesh) -> F32:
    """Vertices of a mesh of the building in world coordinates."""
    assert one.truth is not None
    T = one.truth.T_map_world
    return world.place(mesh.vertices.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
