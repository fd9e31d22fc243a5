"""Poisson: screened Poisson surface reconstruction from oriented points (Kazhdan and Hoppe 2013; D3.2, section 4.2)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.parameters import Seconds
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import ThinnedCloud
from scan2sim.pipeline.core.types import F32, I32, Mesh, PointCloud

MIN_POINTS = 50
CUBE_SCALE = 1.02  # the octree's cube must be a little larger than the cloud
MAX_DEPTH = 16
ALIGNMENT_CELLS = 128  # octrees aligned to multiples of this many finest cells agree where tiles overlap


class PoissonParams(Params):
    """Resolution of the surface.

    Attributes:
        depth: depth of the octree; unset: chosen so that the finest cell is half a voxel for any length of the tile
            (11, as in D3.2, at 100 m and 10 cm).
        point_weight: weight of the points' positions (screening); 0 is the unscreened method.
        threads: 1 is reproducible; 0 (all cores) is up to 1.4 times faster, but results differ from run to run.
        timeout: seconds after which the reconstruction is aborted.
        context: the voxel size of the input points, and the tile's cell. With a cell, the octree is aligned to a
            multiple of its cells in the world, so that surfaces of neighbouring tiles agree where they overlap.
    """

    depth: int | None = Field(None, ge=4, le=MAX_DEPTH)
    point_weight: float = Field(4.0, ge=0, le=1000)
    threads: int = Field(1, ge=0, le=256)
    timeout: Seconds = 3600.0
    context: ThinnedCloud = ThinnedCloud()


def poisson(inputs: Inputs, params: PoissonParams, out: Path, report: Report) -> Done:
    """Reconstruct `cloud`, with synthesized points (`synthesized`, optional), in a child process.

    After a crash, it is retried on one thread, then one octree level coarser.

    Raises:
        StepError: all three attempts failed.
    """
    from scan2sim.pipeline.core import sandbox

    cloud = PointCloud.load(inputs["cloud"])
    if "synthesized" in inputs and len(cloud) and len(made := PointCloud.load(inputs["synthesized"])):
        cloud = PointCloud.join([cloud, made])
    if len(cloud) < MIN_POINTS:
        empty = Mesh(cloud.frame, np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty(0, np.float32))
        empty.save(out / "mesh.npz")
        warnings = [f"only {len(cloud)} points: no surface"] if len(cloud) else []
        return Done({"mesh": out / "mesh.npz"}, {"points": len(cloud), "faces": 0}, warnings)

    xyz, normal = cloud.xyz, cloud.normal
    if params.context.cell:  # two points in opposite corners define the cube; surface near them is removed by `trim`
        xyz = np.concatenate([xyz, bounds(xyz, cloud.frame.origin, ALIGNMENT_CELLS * params.context.voxel / 2)])
        normal = np.concatenate([normal, np.tile(np.array([0, 0, 1], np.float32), (2, 1))])
    length = float((xyz.max(axis=0) - xyz.min(axis=0)).max())
    depth, scale = octree(length, params.context.voxel / 2) if params.depth is None else (params.depth, 1.1)
    cell = scale * length / 2**depth
    summary = (
        f"{length:.0f} m at a voxel of {params.context.voxel * 100:.0f} cm: depth {depth}, cell {cell * 100:.1f} cm"
    )
    report(0.0, summary)
    warnings = []
    # attempts: as configured; on one thread (several race on some inputs); one level coarser
    for threads, coarser in ((params.threads, 0), (1, 0), (1, 1)):
        try:
            vertices, faces, density = sandbox.call(
                "scan2sim.pipeline.steps.poisson:reconstruct",
                *(xyz, normal, depth - coarser, scale, params.point_weight, threads),
                timeout=params.timeout,
            )
            break
        except StepError as error:
            warnings.append(f"Poisson at depth {depth - coarser}, threads {threads or 'all'}: {error.cause}")
    else:
        raise StepError(inputs["cloud"], "; ".join(warnings), "Use a smaller tile, or --set poisson.depth=9")
    Mesh(cloud.frame, vertices, faces, density).save(out / "mesh.npz")
    metrics = {
        "points": len(cloud),
        "faces": len(faces),
        "depth": depth - coarser,
        "cell_m": round(cell * 2**coarser, 4),
    }
    return Done({"mesh": out / "mesh.npz"}, metrics | {"summary": summary}, warnings)


def bounds(xyz: F32, origin: tuple[float, float, float], block: float) -> F32:
    """Opposite corners (2, 3) of a cube around the points, centred at a multiple of `block` in the world."""
    low, high = xyz.min(axis=0) + np.asarray(origin), xyz.max(axis=0) + np.asarray(origin)
    middle = np.rint((low + high) / 2 / block) * block
    half = np.maximum(high - middle, middle - low).max()
    return np.array([middle - half - origin, middle + half - origin], np.float32)


def octree(length: float, cell: float) -> tuple[int, float]:
    """Depth of the octree and scale of its cube so that the finest cell is exactly `cell` metres."""
    depth = max(4, math.ceil(math.log2(CUBE_SCALE * length / cell)))
    return min(depth, MAX_DEPTH), max(CUBE_SCALE, cell * 2**depth / length)


def reconstruct(
    xyz: F32, normal: F32, depth: int, scale: float, point_weight: float, threads: int
) -> tuple[F32, I32, F32]:
    """Screened Poisson by Open3D: vertices (V, 3), faces (F, 3), density (V,) as octree depth; 0 threads: all cores."""
    import open3d as o3d

    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz.astype(np.float64)))
    points.normals = o3d.utility.Vector3dVector(normal.astype(np.float64))
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        points, depth=depth, scale=scale, point_weight=point_weight, n_threads=threads or -1
    )
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.int32)
    return vertices, faces, np.asarray(density, np.float32)


POISSON = Step("poisson", 1, poisson, PoissonParams, per_class=True, memory=(0.4, 70))
