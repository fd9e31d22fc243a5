"""Voxel sampling: one point per voxel, with colour, class and an oriented normal (D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Voxel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import PointCloud, Trajectory
from scan2sim.pipeline.geometry.voxel_grid import sample, sheet_groups


class VoxelParams(Params):
    """Voxel size and normals.

    Attributes:
        size: voxel edge in metres; the 10 cm of D3.2 keep the geometry and make Poisson affordable.
        neighbours: number of points that a normal is fitted to.
    """

    size: Voxel = 0.10
    neighbours: int = Field(16, ge=3, le=64)


def voxel(inputs: Inputs, params: VoxelParams, out: Path, report: Report) -> Done:
    """Thin `cloud` and orient its normals towards the scanner's path (`path`, optional).

    Without a path (airborne clouds, for example), normals point up, and those of walls away from the building.
    """
    from scan2sim.pipeline.geometry.normals import oriented_normals

    cloud = PointCloud.load(inputs["cloud"])
    n = len(cloud)
    report(0.1, "thinning")
    thin = sample(cloud, params.size, sheet_groups(cloud.xyz, params.size))
    report(0.4, "normals")
    path = Trajectory.load(inputs["path"]) if "path" in inputs else None
    thin = oriented_normals(thin, params.neighbours, path)
    thin.save(out / "cloud.npz")
    low, high = (thin.xyz.min(axis=0), thin.xyz.max(axis=0)) if n else (np.zeros(3), np.zeros(3))
    metrics = {"points_in": n, "points": len(thin), "extent_m": (high - low).round(2).tolist()}
    return Done({"cloud": out / "cloud.npz"}, metrics)


VOXEL = Step("voxel", 4, voxel, VoxelParams, per_class=True)
