"""Geometry: how far the meshes are from the cloud, and from the true surface where it is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import GROUPS, SURFACES, group_of
from scan2sim.pipeline.core.parameters import Place
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, Mesh, PointCloud
from scan2sim.pipeline.tiling.voronoi_cell import Cell

FAR = 1.0  # metres from the mesh beyond which one point in twenty is worth a warning


class GeometryParams(Params):
    """How densely is measured.

    Attributes:
        samples: points a class, drawn from the cloud and from the mesh.
        seed: the tile's (x, y), world metres, where it meets others: the mesh ends at its cell's borders, so only
            points within them count; set by the recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
    """

    samples: int = Field(200_000, ge=1000, le=10_000_000)
    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def geometry(inputs: Inputs, params: GeometryParams, out: Path, report: Report) -> Done:
    """Measure `mesh.*` against `cloud.*`, and against `truth.mesh` where the tile is a generated one.

    Facts, per class, in metres: `cloud_to_mesh_mean_m` and `cloud_to_mesh_p95_m` (from the points to
    the nearest place on the mesh); `truth_mean_m` (from the mesh to the true surface of its class). `made_up` is the
    share of the mesh's area that lies nearer to points that were made up (`made.*`) than to any of the cloud's.
    """
    facts: dict[str, dict[str, Any]] = {}
    warnings: list[str] = []
    truth = Mesh.load(inputs["truth.mesh"]) if "truth.mesh" in inputs else None
    for i, group in enumerate(SURFACES):
        if f"mesh.{group}" not in inputs:
            continue
        report(i / len(SURFACES), group)
        mesh, cloud = Mesh.load(inputs[f"mesh.{group}"]), PointCloud.load(inputs[f"cloud.{group}"])
        if params.seed is not None:
            own = (
                Cell(params.seed, params.neighbours).outside(cloud.xyz[:, :2] + np.asarray(cloud.frame.origin[:2])) <= 0
            )
            cloud = cloud.take(own)
        if len(mesh) == 0 and len(cloud) > 0:
            warnings.append(
                f"{group}: none of its {len(cloud):,} points became a surface (too few, or taken by trim and islands): "
                f"the world has no {group}"
            )
        if len(mesh) == 0 or len(cloud) == 0:
            continue
        points = cloud.xyz[:: max(1, len(cloud) // params.samples)]
        distance = distances(points, mesh)
        figures = {
            "triangles": len(mesh),
            "area_m2": float(mesh.face_area.sum()),
            "cloud_to_mesh_mean_m": float(distance.mean()),
            "cloud_to_mesh_p95_m": float(np.percentile(distance, 95)),
        }
        if figures["cloud_to_mesh_p95_m"] > FAR:
            warnings.append(
                f"{group}: 5 % of the points are further than {figures['cloud_to_mesh_p95_m']:.1f} m from the mesh; "
                "there the world lacks what was scanned (too few points for a surface, or of another class)"
            )
        if f"made.{group}" in inputs:
            made = PointCloud.load(inputs[f"made.{group}"])
            figures["made_up"] = made_up(mesh, PointCloud.load(inputs[f"cloud.{group}"]), made, params.samples)
        if truth is not None and truth.classification is not None:
            error = truth_error(mesh, truth, group, params.samples)
            figures |= {} if error is None else {"truth_mean_m": error}
        facts[group] = {name: round(value, 4) for name, value in figures.items()}
    return Done({}, facts, warnings)


def made_up(mesh: Mesh, cloud: PointCloud, made: PointCloud, samples: int) -> float:
    """Share of the mesh's area whose nearest point is one that was made up."""
    from scipy.spatial import cKDTree

    if not len(made):
        return 0.0
    places = spread(mesh, samples)
    real, _ = cKDTree(cloud.xyz).query(places, workers=-1)
    other, _ = cKDTree(made.xyz).query(places, workers=-1)
    return float((other < real).mean())


def truth_error(mesh: Mesh, truth: Mesh, group: str, samples: int, *, whatever: bool = False) -> float | None:
    """Mean distance in metres from points spread evenly on the mesh to the true surface of its class.

    Samples outside the bounds of that surface (a cloud reaches further than its street) don't count.

    Args:
        mesh: of `group`.
        truth: the true surface, labelled.
        group: of classes.
        samples: how many.
        whatever: the true surface of any class counts, not just of the mesh's.
    """
    assert truth.classification is not None
    if group not in GROUPS:
        return None  # no truth has what is parked
    same = truth.keep(group_of()[truth.classification] == GROUPS.index(group)).moved_to(mesh.frame)
    if not len(same):
        return None
    points = spread(mesh, samples)
    low, high = same.vertices.min(axis=0)[:2], same.vertices.max(axis=0)[:2]
    points = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)]
    return float(np.mean(distances(points, truth.moved_to(mesh.frame) if whatever else same)))


def distances(points: F32, mesh: Mesh) -> F32:
    """(N,) metres from points (N, 3) to the nearest place on the mesh."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces.astype(np.uint32)))
    return scene.compute_distance(np.ascontiguousarray(points, np.float32)).numpy()


def spread(mesh: Mesh, count: int, seed: int = 0) -> F32:
    """(count, 3) points drawn evenly from the mesh's surface."""
    random = np.random.default_rng(seed)
    area = np.cumsum(mesh.face_area, dtype=np.float64)
    face = np.searchsorted(area, random.uniform(0, area[-1], count)).clip(max=len(mesh) - 1)
    u, v = np.sqrt(random.uniform(size=(count, 1))), random.uniform(size=(count, 1))
    a, b, c = np.moveaxis(mesh.corners[face], 1, 0)
    return ((1 - u) * a + u * (1 - v) * b + u * v * c).astype(np.float32)


GEOMETRY = Step("geometry", 4, geometry, GeometryParams, side_product=True)
