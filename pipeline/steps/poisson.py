"""Poisson: screened Poisson surface reconstruction from oriented points (Kazhdan and Hoppe 2013; D3.2, section 4.2)."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.cores import available_cores
from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.parameters import Seconds
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import ThinnedCloud
from scan2sim.pipeline.core.types import F32, F64, Mesh, PointCloud
from scan2sim.pipeline.tiling.surface_blocks import Block, Surface, crop, partition, stitch

MIN_POINTS = 50
CUBE_SCALE = 1.02  # the octree's cube must be a little larger than the cloud
MAX_DEPTH = 16
ALIGNMENT_CELLS = 128  # octrees aligned to multiples of this many finest cells agree where tiles and blocks overlap
MARGIN_CELLS = 48  # by which a block's points extend beyond it: 2.4 m at a voxel of 10 cm
POINT_WEIGHT = 4.0  # of the positions (screening); 0 would be the unscreened method


class PoissonParams(Params):
    """Resolution of the surface.

    Attributes:
        cell: finest cell of the octree, in voxels. The ground of synthetic streets is more accurate with cells of a
            voxel than with the half voxels of D3.2, in half the time.
        depth: depth of the octree; unset: chosen so that the finest cell has the size `cell` for any length of the tile
            (11, as in D3.2, at 100 m and 5 cm).
        block_points: number of points up to which the surface is reconstructed as a whole, by default any; larger
            clouds are divided into blocks that don't have more points, if they extend far enough.
        threads: number of blocks that are solved at the same time, each on one thread; 0: one per core. The result is
            the same with any number.
        timeout: seconds after which the reconstruction is aborted.
        context: the voxel size of the input points, and the tile's cell.
    """

    cell: float = Field(0.5, ge=0.1, le=10)
    depth: int | None = Field(None, ge=4, le=MAX_DEPTH)
    block_points: int = Field(1_000_000_000, ge=1000, le=1_000_000_000)
    threads: int = Field(0, ge=0, le=256)
    timeout: Seconds = 3600.0
    context: ThinnedCloud = ThinnedCloud()


def poisson(inputs: Inputs, params: PoissonParams, out: Path, report: Report) -> Done:
    """Reconstruct `cloud`, with synthesized and with uncovered, thinned points (optional), in child processes.

    Large clouds are reconstructed in blocks that overlap. After a crash, each block of the process is retried, then one
    octree level coarser.

    Raises:
        StepError: all three attempts failed.
    """
    cloud = PointCloud.load(inputs["cloud"])
    for name in ("synthesized", "uncovered"):
        if name in inputs and (len(cloud) or name == "uncovered") and len(more := PointCloud.load(inputs[name])):
            cloud = PointCloud.join([cloud, more]) if len(cloud) else more
    if len(cloud) < MIN_POINTS:
        empty = Mesh(cloud.frame, np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty(0, np.float32))
        empty.save(out / "mesh.npz")
        warnings = [f"only {len(cloud)} points: no surface"] if len(cloud) else []
        return Done({"mesh": out / "mesh.npz"}, {"points": len(cloud), "faces": 0}, warnings)

    summary, depth, cell, problems = _blocks(cloud, params)
    report(0.0, summary)
    surfaces, coarser, warnings = _solve(problems, params, inputs["cloud"], report)
    surface = surfaces[0] if len(surfaces) == 1 else stitch(surfaces, [p.block for p in problems], cell)
    Mesh(cloud.frame, *surface).save(out / "mesh.npz")
    metrics = {
        "points": len(cloud),
        "faces": len(surface.faces),
        "depth": depth - coarser,
        "cell_m": round(cell * 2**coarser, 4),
        "blocks": len(problems),
        "summary": summary,
    }
    return Done({"mesh": out / "mesh.npz"}, metrics, warnings)


class Problem(NamedTuple):
    """The points of one block, with those around it, and its octree.

    Attributes:
        block: part of the plane whose surface is wanted.
        xyz, normal: (N, 3) points and their normals.
        depth, scale: depth of the octree, and side of its cube over the largest extent of the points.
        finer: depth of a finest cell in the octree of the whole cloud minus that in this octree.
    """

    block: Block
    xyz: F32
    normal: F32
    depth: int
    scale: float
    finer: int = 0


def _blocks(cloud: PointCloud, params: PoissonParams) -> tuple[str, int, float, list[Problem]]:
    """Description, depth and finest cell in metres of the whole octree, and the blocks.

    The blocks depend on nothing but the points and the settings of the surface. Octrees are aligned to multiples of
    their cells in the world, so that surfaces agree where tiles or blocks overlap; and to the voxels, where cells are
    as large. Other octrees enclose the points.
    """
    assert cloud.normal is not None
    voxel = params.context.voxel
    length = float((cloud.xyz.max(axis=0) - cloud.xyz.min(axis=0)).max())
    cell = voxel * params.cell if params.depth is None else 1.1 * length / 2**params.depth
    depth, scale = octree(length, cell) if params.depth is None else (params.depth, 1.1)
    unit = voxel / 2 if params.depth is None else cell
    # cells as large as voxels agree with them; voxels are centred at multiples of their height
    offset = (0, 0, voxel / 2 if params.depth is None and params.cell >= 1 else 0)
    grid, margin = ALIGNMENT_CELLS * unit, MARGIN_CELLS * unit
    origin = np.asarray(cloud.frame.origin) + offset
    walls = -np.mod(origin[:2], grid)
    blocks = partition(cloud.xyz[:, :2].astype(np.float64), grid, walls, margin, params.block_points)
    summary = f"{length:.0f} m at a voxel of {voxel * 100:.0f} cm: depth {depth}, cell {cell * 100:.1f} cm"
    if len(blocks) == 1 and params.context.cell is None and cell < voxel:
        return summary, depth, cell, [Problem(Block(), cloud.xyz, cloud.normal, depth, scale)]
    problems = []
    for block in blocks:
        own = block.inside(cloud.xyz[:, :2], margin)
        xyz, normal = cloud.xyz[own], cloud.normal[own]
        # two points in opposite corners define the cube; surface near them is cropped, or removed by `trim`
        corners = bounds(xyz, origin, grid)
        xyz, normal = np.concatenate([xyz, corners]), np.concatenate([normal, np.array([[0, 0, 1]] * 2, np.float32)])
        own_depth, scale = octree(float((corners[1] - corners[0]).max()), cell)
        problems.append(Problem(block, xyz, normal, own_depth, scale, depth - own_depth))
    return f"{summary}, {len(blocks)} blocks" if len(blocks) > 1 else summary, depth, cell, problems


def _solve(
    problems: list[Problem], params: PoissonParams, path: Path, report: Report
) -> tuple[list[Surface], int, list[str]]:
    """Surfaces, the levels by which the coarsest is coarser than asked for, and warnings.

    Blocks whose process fails are repeated one by one, then one level coarser.
    """
    from scan2sim.pipeline.core import sandbox

    def solve(numbers: list[int], coarser: int) -> list[Surface] | StepError:
        chosen = [problems[i]._replace(depth=problems[i].depth - coarser) for i in numbers]
        try:
            target = "scan2sim.pipeline.steps.poisson:reconstruct"
            found: list[Surface] = sandbox.call(target, chosen, timeout=params.timeout, threads=1)
        except StepError as error:
            return error
        return found

    processes = min(params.threads or available_cores(), len(problems))
    shares: list[list[int]] = [[] for _ in range(processes)]
    for i in sorted(
        range(len(problems)), key=lambda i: -len(problems[i].xyz)
    ):  # the largest first, to the least loaded
        min(shares, key=lambda share: sum(len(problems[k].xyz) for k in share)).append(i)
    surfaces: dict[int, Surface] = {}
    warnings, levels = [], 0
    with ThreadPoolExecutor(processes) as pool:
        attempts = [
            (share, result) for share, result in zip(shares, pool.map(lambda s: solve(s, 0), shares), strict=True)
        ]
    for share, result in attempts:
        if not isinstance(result, StepError):
            surfaces |= zip(share, result, strict=True)
            report(len(surfaces) / len(problems))
            continue
        warnings.append(f"Poisson at depth {problems[share[0]].depth}: {result.cause}")
        for i in share:
            for coarser in (0, 1):
                result = solve([i], coarser)
                if not isinstance(result, StepError):
                    surfaces[i], levels = result[0], max(levels, coarser)
                    break
                warnings.append(f"Poisson at depth {problems[i].depth - coarser}: {result.cause}")
            else:
                raise StepError(path, "; ".join(warnings), "Use a smaller tile, or --set poisson.depth=9")
    return [surfaces[i] for i in range(len(problems))], levels, warnings


def bounds(xyz: F32, origin: F64, block: float) -> F32:
    """Opposite corners (2, 3) of a cube around the points, centred at a multiple of `block` in the world."""
    low, high = xyz.min(axis=0) + origin, xyz.max(axis=0) + origin
    middle = np.rint((low + high) / 2 / block) * block
    half = np.maximum(high - middle, middle - low).max()
    return np.array([middle - half - origin, middle + half - origin], np.float32)


def octree(length: float, cell: float) -> tuple[int, float]:
    """Depth of the octree and scale of its cube so that the finest cell is exactly `cell` metres."""
    depth = max(4, math.ceil(math.log2(CUBE_SCALE * length / cell)))
    return min(depth, MAX_DEPTH), max(CUBE_SCALE, cell * 2**depth / length)


def reconstruct(problems: list[Problem]) -> list[Surface]:
    """Screened Poisson surface of each block by Open3D, on one thread: several threads give results that vary."""
    import open3d as o3d

    surfaces = []
    for problem in problems:
        points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(problem.xyz.astype(np.float64)))
        points.normals = o3d.utility.Vector3dVector(problem.normal.astype(np.float64))
        mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            points, depth=problem.depth, scale=problem.scale, point_weight=POINT_WEIGHT, n_threads=1
        )
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.int32)
        surface = Surface(vertices, faces, np.asarray(density, np.float32) + problem.finer)
        surfaces.append(surface if problem.block == Block() else crop(surface, problem.block))
    return surfaces


POISSON = Step(
    "poisson",
    3,
    poisson,
    PoissonParams,
    per_class=True,
    memory=(0.4, 35.0 * min(max(available_cores(), 2), 6)),  # GB of a block's process, of which one runs on each core
)
