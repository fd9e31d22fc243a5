"""Distances between surfaces and points, and points sampled uniformly from a surface."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, Mesh


def distances(points: F32, mesh: Mesh) -> F32:
    """Distance (N,) in metres from points (N, 3) to the nearest point of the mesh."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces.astype(np.uint32)))
    return scene.compute_distance(np.ascontiguousarray(points, np.float32)).numpy()


def sample_surface(mesh: Mesh, count: int, seed: int = 0) -> F32:
    """Points (count, 3) sampled uniformly from the mesh's surface."""
    random = np.random.default_rng(seed)
    area = np.cumsum(mesh.face_area, dtype=np.float64)
    face = np.searchsorted(area, random.uniform(0, area[-1], count)).clip(max=len(mesh) - 1)
    u, v = np.sqrt(random.uniform(size=(count, 1))), random.uniform(size=(count, 1))
    a, b, c = np.moveaxis(mesh.corners[face], 1, 0)
    return ((1 - u) * a + u * (1 - v) * b + u * v * c).astype(np.float32)


DEVIATION_SAMPLES = 100_000  # points at which the distance to the visual meshes is measured


def statistics(distance: npt.NDArray[np.floating]) -> dict[str, float]:
    """Mean, 95th percentile and maximum of distances, rounded to 0.1 mm."""
    return {
        "mean": round(float(distance.mean()), 4),
        "p95": round(float(np.percentile(distance, 95)), 4),
        "max": round(float(distance.max()), 4),
    }


def deviation(source: Mesh, collision_mesh: Mesh, seed: int) -> dict[str, float]:
    """Statistics of the distances from points sampled uniformly on `source` to `collision_mesh`, metres."""
    import open3d as o3d

    rng = np.random.default_rng(seed)
    area = source.face_area.astype(np.float64)
    face = rng.choice(len(source), DEVIATION_SAMPLES, p=area / area.sum())
    r, s = np.sqrt(rng.random((DEVIATION_SAMPLES, 1))), rng.random((DEVIATION_SAMPLES, 1))
    a, b, c = np.moveaxis(source.corners[face], 1, 0)
    points = (1 - r) * a + r * (1 - s) * b + r * s * c  # uniform in a triangle: Osada et al. 2002
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(collision_mesh.vertices),
        o3d.core.Tensor.from_numpy(collision_mesh.faces.astype(np.uint32)),
    )
    return statistics(scene.compute_distance(o3d.core.Tensor.from_numpy(points.astype(np.float32))).numpy())
