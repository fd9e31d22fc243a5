"""Poisson reconstruction in blocks compared with Open3D's on all cores: `python -m bench.tile.poisson STREET RUN`.

RUN is the output folder of `scan2sim run STREET`, whose thinned clouds both reconstruct, one after the other, in a
process each. Open3D gets the whole cloud at the resolution of D3.2 (cells of half a voxel). Both surfaces are trimmed
alike and compared with the ground truth. Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from bench.measure import measure
from scan2sim.pipeline.core.classes import GROUPS
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Mesh, PointCloud
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.geometry import truth_error
from scan2sim.pipeline.steps.poisson import POISSON, octree
from scan2sim.pipeline.steps.trim import TRIM

SAMPLES = 200_000
VOXEL_M = 0.1

BLOCK_POINTS = 100_000
"""Setting `poisson.block_points` of the blocks."""
CELLS = {"terrain": 1.0}
"""Setting `poisson.cell` of the blocks by class."""


def main() -> None:
    """Compare all classes of a street, or reconstruct one cloud (for the processes that this starts)."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("street", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument(
        "--cell", type=float, help="finest cell of the blocks in voxels; default: 1 for terrain, else .5"
    )
    parser.add_argument("--reconstruct", nargs=2, metavar=("METHOD", "GROUP"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.reconstruct:
        method, group = arguments.reconstruct
        out = arguments.run / "poisson" / f"{method}.{group}"
        out.mkdir(parents=True, exist_ok=True)
        cloud = _cloud(arguments.run, group)
        if method == "ours":
            _ours(group, cloud, out, arguments.cell)
        else:
            _open3d(cloud, out)
    else:
        print("RESULT " + json.dumps(compare(arguments.street, arguments.run, arguments.cell)))


def compare(street: Path, run: Path, cell: float | None = None) -> dict[str, Any]:
    """Reconstruct each class with both, print times and errors, and return the ratios, ours over Open3D's.

    Args:
        street: folder of the generated tile.
        run: output folder of its run.
        cell: finest cell of the blocks in voxels; None: those of `CELLS`, else half a voxel.
    """
    truth_file = read_tile(street).truth_mesh
    assert truth_file is not None
    truth, errors = Mesh.load(truth_file), {}
    total: dict[str, float] = defaultdict(float)
    print(f"\n{'Poisson':<12}{'':<8}{'wall s':>8}{'CPU s':>8}{'peak GB':>9}{'faces':>11}{'area m2':>9}{'truth cm':>10}")
    for group in GROUPS:
        found = {}
        for method in ("open3d", "ours"):
            before = _cpu_seconds()
            command = [sys.executable, "-m", "bench.tile.poisson", str(street), str(run)]
            command += [] if cell is None else ["--cell", str(cell)]
            measured = measure([*command, "--reconstruct", method, group])
            if measured.status != 0:
                sys.exit(f"Poisson of {group} by {method} failed with exit status {measured.status}")
            cpu = _cpu_seconds() - before
            folder = run / "poisson" / f"{method}.{group}"
            inputs = {"mesh": folder / "mesh.npz", "cloud": _cloud(run, group)}
            params = TRIM.params(**TRIM.class_defaults.get(group, {}))
            mesh = Mesh.load(TRIM.run(inputs, params, _made(folder / "trim"), silent).files["mesh"])
            found[method] = truth_error(mesh, truth, group, SAMPLES) or float("nan")
            total[f"{method}_wall"] += measured.seconds
            total[f"{method}_cpu"] += cpu
            print(
                f"{group:<12}{method:<8}{measured.seconds:>8.1f}{cpu:>8.1f}{measured.peak_gb:>9.2f}"
                f"{len(mesh):>11,}{mesh.face_area.sum():>9.0f}{found[method] * 100:>10.2f}",
                flush=True,
            )
        errors[group] = round(found["ours"] / found["open3d"], 3)
    return {
        "poisson_ratio": round(total["ours_wall"] / total["open3d_wall"], 2),
        "poisson_cpu_ratio": round(total["ours_cpu"] / total["open3d_cpu"], 2),
        "poisson_truth_ratio": errors,
    }


def _ours(group: str, cloud: Path, out: Path, cell: float | None) -> None:
    settings = {"block_points": BLOCK_POINTS, "cell": CELLS.get(group, 0.5) if cell is None else cell}
    POISSON.run({"cloud": cloud}, POISSON.params(**settings), out, silent)


def _open3d(path: Path, out: Path) -> None:
    import open3d as o3d

    cloud = PointCloud.load(path)
    depth, scale = octree(float((cloud.xyz.max(axis=0) - cloud.xyz.min(axis=0)).max()), VOXEL_M / 2)
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.xyz.astype(np.float64)))
    points.normals = o3d.utility.Vector3dVector(cloud.normal.astype(np.float64))  # type: ignore[union-attr]
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        points, depth=depth, scale=scale, point_weight=4.0
    )
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.int32)
    Mesh(cloud.frame, vertices, faces, np.asarray(density, np.float32)).save(out / "mesh.npz")


def _cloud(run: Path, group: str) -> Path:
    return next((run / "steps" / f"voxel.{group}").glob("*/cloud.npz"))


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
