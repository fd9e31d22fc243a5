"""Dynamic object removal: on the synthetic street, where static and moving points are known, and on scanned tiles.

    python -m bench.dynamic_objects [--length 100 --points 9e6] [--tiles TILE ...] [--peer]

Street: share of static points lost, by class, share of the moving car removed, and seconds of the step. Tiles (folders
with a `tile.toml` and a trajectory): shares removed, and points remaining where the vehicle has driven. `--peer` runs
DUFOMap (PyPI: dufomap 1.1.1) for comparison, if installed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.data_samples.layout import lay_out
from scan2sim.data_samples.scanner import plan_drive, scan
from scan2sim.data_samples.scene import Scene
from scan2sim.flows.pipelines.tile import scanner_path
from scan2sim.pipeline.core.classes import CODE, name_of
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import PointCloud, Trajectory
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.lidar.sweeps import SCAN_WINDOW_S
from scan2sim.pipeline.steps.dynamic_objects import DYNAMIC_OBJECTS
from scan2sim.pipeline.steps.ingest import INGEST
from scan2sim.pipeline.steps.path import PATH
from tests.fakes.steps import step_params

Bools = np.ndarray


def street(length: float, points: float, seed: int) -> tuple[PointCloud, Trajectory, Bools]:
    """A scan of the street, the scanner's path, and mask (N,) of points on the moving car."""
    scene = Scene(lay_out(length, seed))
    drive = plan_drive(scene.layout, points)
    cloud = scan(scene, drive, points)
    _, across = scene.layout.axis.locate(cloud.xyz[:, :2].astype(np.float64))
    assert cloud.classification is not None
    return (
        cloud,
        drive.trajectory(),
        (cloud.classification == CODE["vehicle"]) & (np.abs(across) < scene.layout.lane - 0.3),
    )


def remove_dynamic(cloud: PointCloud, path: Trajectory) -> tuple[Bools, float, dict[str, Any]]:
    """Mask (N,) of the points removed by the step, its seconds, and its metrics."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        cloud.save(out / "in.npz")
        path.save(out / "path.npz")
        begin = time.perf_counter()
        done = DYNAMIC_OBJECTS.run(
            {"cloud": out / "in.npz", "path": out / "path.npz"}, DYNAMIC_OBJECTS.params(), out, silent
        )
        seconds = time.perf_counter() - begin
        dropped = np.load(done.files["dropped"])
        return (dropped > 0 if len(dropped) else np.zeros(len(cloud), bool)), seconds, done.metrics


def dufomap(cloud: PointCloud, path: Trajectory) -> tuple[Bools, float]:
    """The same with DUFOMap and its authors' settings, from the scanner's position in the middle of each window."""
    from dufomap import dufomap as peer

    assert cloud.time is not None
    begin = time.perf_counter()
    order = np.argsort(cloud.time, kind="stable")
    window = np.floor((cloud.time[order] - cloud.time.min()) / SCAN_WINDOW_S + 0.5)
    sweeps = np.split(order, np.flatnonzero(np.diff(window)) + 1)
    poses = []
    found = peer(0.1, 0.2, 1)
    for index in sweeps:
        pose = np.eye(4)
        pose[:3, 3] = path.at(cloud.time[index].mean(keepdims=True))[0]
        poses.append(pose)
        found.run(cloud.xyz[index], pose, cloud_transform=False)
    found.oncePropagateCluster(if_propagate=True, if_cluster=False)
    removed = np.zeros(len(cloud), bool)
    for index, pose in zip(sweeps, poses, strict=True):
        removed[index] = np.asarray(found.segment(cloud.xyz[index], pose, cloud_transform=False)) > 0
    return removed, time.perf_counter() - begin


def metrics(cloud: PointCloud, moves: Bools, removed: Bools, seconds: float) -> dict[str, Any]:
    """Shares of static points lost and of moving points found."""
    assert cloud.classification is not None
    lost = {
        name_of(int(code)): round(float(removed[(cloud.classification == code) & ~moves].mean()), 5)
        for code in np.unique(cloud.classification[~moves])
    }
    return {
        "static_lost": round(float(removed[~moves].mean()), 5),
        "moving_found": round(float(removed[moves].mean()), 4) if moves.any() else None,
        "seconds": round(seconds, 1),
        "lost": lost,
    }


def tile_of(folder: Path) -> tuple[PointCloud, Trajectory]:
    """The ingested cloud of a tile, and the scanner's path."""
    tile = read_tile(folder)
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        frame = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
        files = {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}
        cloud = INGEST.run(files, step_params(INGEST.params, **frame), out, silent).files["cloud"]
        path = PATH.run({}, step_params(PATH.params, **scanner_path(tile)), out, silent).files["path"]
        return PointCloud.load(cloud), Trajectory.load(path)


def driven(cloud: PointCloud, path: Trajectory) -> Bools:
    """Mask (N,) of points where the vehicle has driven: 1.3 m to each side, above the road, below its roof."""
    from scipy.spatial import cKDTree

    positions = path.at(np.linspace(path.times[0], path.times[-1], 1000))
    distance, at = cKDTree(positions[:, :2]).query(cloud.xyz[:, :2], distance_upper_bound=1.3, workers=-1)
    above = cloud.xyz[:, 2] - np.append(positions[:, 2], np.nan)[at]
    return np.isfinite(distance) & (above > -1.45) & (above < 1.0)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--length", type=float, default=40.0)
    parser.add_argument("--points", type=float, default=1.6e6)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 3])
    parser.add_argument("--tiles", type=Path, nargs="*", default=[])
    parser.add_argument("--peer", action="store_true")
    given = parser.parse_args()
    result: dict[str, Any] = {}
    remove_dynamic(*street(8.0, 20_000, 0)[:2])  # warm up: compile kernels
    for seed in given.seeds:
        cloud, path, moves = street(given.length, given.points, seed)
        removed, seconds, _ = remove_dynamic(cloud, path)
        result[f"street {seed}"] = metrics(cloud, moves, removed, seconds)
        if given.peer:
            result[f"street {seed} by DUFOMap"] = metrics(cloud, moves, *dufomap(cloud, path))
    for folder in given.tiles:
        cloud, path = tile_of(folder)
        removed, seconds, facts = remove_dynamic(cloud, path)
        where = driven(cloud, path)
        result[folder.name] = {
            "dropped": round(float(removed.mean()), 5),
            "driven_through_left": int((where & ~removed).sum()),
            "driven_through": int(where.sum()),
            "seconds": round(seconds, 1),
        } | {key: facts[key] for key in ("moved", "own_volume")}
        if given.peer:
            removed, seconds = dufomap(cloud, path)
            result[f"{folder.name} by DUFOMap"] = {
                "dropped": round(float(removed.mean()), 5),
                "driven_through_left": int((where & ~removed).sum()),
                "seconds": round(seconds, 1),
            }
    for name, one in result.items():
        print(f"{name:28s}", json.dumps(one))
    streets = [one for name, one in result.items() if name.startswith("street") and "by" not in name]
    if streets:
        worst: dict[str, float] = {}
        for one in streets:
            for kind, share in one["lost"].items():
                worst[kind] = max(worst.get(kind, 0.0), share)
        rounded = {
            "static_lost": max(one["static_lost"] for one in streets),
            "lost": worst,
            "moving_found": min(one["moving_found"] or 1.0 for one in streets),
            "seconds": max(one["seconds"] for one in streets),
        }
        print("RESULT", json.dumps(rounded))


if __name__ == "__main__":
    main()
