"""Geometry: accuracy of the meshes, as distances to the cloud, and to the ground-truth surface if there is one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import GROUPS, SURFACES, group_of
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Mesh, PointCloud
from scan2sim.pipeline.geometry.surface_distance import distances, sample_surface

P95_DISTANCE_WARNING_M = 1.0  # the step warns if 5 % of the points are farther from the mesh


class GeometryParams(Params):
    """Sampling.

    Attributes:
        samples: number of points per class, sampled from the cloud and from the mesh.
        context: the tile's cell, if it has neighbours; only points inside it, where the mesh ends, are used.
    """

    samples: int = Field(200_000, ge=1000, le=10_000_000)
    context: TileCell | None = None


def geometry(inputs: Inputs, params: GeometryParams, out: Path, report: Report) -> Done:
    """Measure `mesh.*` against `cloud.*`, and against `truth.mesh` of a generated tile.

    Metrics per class, in metres: `cloud_to_mesh_mean_m` and `cloud_to_mesh_p95_m` (from points to the nearest point of
    the mesh); `truth_mean_m` (from the mesh to the ground-truth surface of its class). `synthesized` is the fraction
    of the mesh's area that is nearer to synthesized points (`synthesized.*`) than to scanned ones.
    """
    by_class: dict[str, dict[str, Any]] = {}
    warnings: list[str] = []
    truth = Mesh.load(inputs["truth.mesh"]) if "truth.mesh" in inputs else None
    for i, group in enumerate(SURFACES):
        if f"mesh.{group}" not in inputs:
            continue
        report(i / len(SURFACES), group)
        mesh, cloud = Mesh.load(inputs[f"mesh.{group}"]), PointCloud.load(inputs[f"cloud.{group}"])
        if params.context:
            own = params.context.cell.outside(cloud.xyz[:, :2] + np.asarray(cloud.frame.origin[:2])) <= 0
            cloud = cloud.take(own)
        if len(mesh) == 0 and len(cloud) > 0:
            warnings.append(
                f"{group}: none of its {len(cloud):,} points are in the mesh (too few, or removed by trim or islands): "
                f"the world has no {group}"
            )
        if len(mesh) == 0 or len(cloud) == 0:
            continue
        points = cloud.xyz[:: max(1, len(cloud) // params.samples)]
        distance = distances(points, mesh)
        metrics = {
            "triangles": len(mesh),
            "area_m2": float(mesh.face_area.sum()),
            "cloud_to_mesh_mean_m": float(distance.mean()),
            "cloud_to_mesh_p95_m": float(np.percentile(distance, 95)),
        }
        if metrics["cloud_to_mesh_p95_m"] > P95_DISTANCE_WARNING_M:
            warnings.append(
                f"{group}: 5 % of the points are further than {metrics['cloud_to_mesh_p95_m']:.1f} m from the mesh; "
                "parts of the scan are missing in the world (too few points for a surface, or points of another class)"
            )
        if f"synthesized.{group}" in inputs:
            synthesized = PointCloud.load(inputs[f"synthesized.{group}"])
            metrics["synthesized"] = synthesized_fraction(
                mesh, PointCloud.load(inputs[f"cloud.{group}"]), synthesized, params.samples
            )
        if truth is not None and truth.classification is not None:
            error = truth_error(mesh, truth, group, params.samples)
            metrics |= {} if error is None else {"truth_mean_m": error}
        by_class[group] = {name: round(value, 4) for name, value in metrics.items()}
    return Done({}, by_class, warnings)


def synthesized_fraction(mesh: Mesh, cloud: PointCloud, synthesized: PointCloud, samples: int) -> float:
    """Fraction of the mesh's area whose nearest point is synthesized."""
    from scipy.spatial import cKDTree

    if not len(synthesized):
        return 0.0
    points = sample_surface(mesh, samples)
    real, _ = cKDTree(cloud.xyz).query(points, workers=-1)
    other, _ = cKDTree(synthesized.xyz).query(points, workers=-1)
    return float((other < real).mean())


def truth_error(mesh: Mesh, truth: Mesh, group: str, samples: int, *, any_class: bool = False) -> float | None:
    """Mean distance in metres from points sampled uniformly on the mesh to the ground-truth surface of its class.

    Samples outside the bounds of that surface are ignored: a cloud extends beyond its street.

    Args:
        mesh: mesh of `group`.
        truth: ground-truth surface with classes.
        group: group of classes.
        samples: number of samples.
        any_class: measure to the ground-truth surface of all classes, not only of the mesh's.
    """
    assert truth.classification is not None
    if group not in GROUPS:
        return None  # there is no ground truth of parked vehicles
    same = truth.keep(group_of()[truth.classification] == GROUPS.index(group)).moved_to(mesh.frame)
    if not len(same):
        return None
    points = sample_surface(mesh, samples)
    low, high = same.vertices.min(axis=0)[:2], same.vertices.max(axis=0)[:2]
    points = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)]
    return float(np.mean(distances(points, truth.moved_to(mesh.frame) if any_class else same)))


GEOMETRY = Step("geometry", 4, geometry, GeometryParams)
