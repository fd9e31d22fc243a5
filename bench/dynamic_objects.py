"""What carving drops: of the synthetic street, whose every point is known to stand or to move, and of scanned tiles.

    python -m bench.dynamic_objects [--length 100 --points 9e6] [--tiles TILE ...] [--peer]

Of the street: the share of static points lost, by class, the share of the moving car found, and the seconds that the
step takes. Of tiles (folders of a `tile.toml` with a trajectory): shares dropped, and what lies where the vehicle has
driven afterwards. `--peer` asks DUFOMap (PyPI: dufomap 1.1.1) the same, where it is installed.
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
from scan2sim.pipeline.steps.carve import CARVE, WINDOW
from scan2sim.pipeline.steps.ingest import INGEST
from scan2sim.pipeline.steps.path import PATH

Bools = np.ndarray


def street(length: float, points: float, seed: int) -> tuple[PointCloud, Trajectory, Bools]:
    """A scan of the street, the scanner's path, and (N,) which points are of the car that drives."""
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


def carved(cloud: PointCloud, path: Trajectory) -> tuple[Bools, float, dict[str, Any]]:
    """(N,) which points the step drops, its seconds, and its facts."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        cloud.save(out / "in.npz")
        path.save(out / "path.npz")
        begin = time.perf_counter()
        done = CARVE.run({"cloud": out / "in.npz", "path": out / "path.npz"}, CARVE.params(), out, silent)
        seconds = time.perf_counter() - begin
        dropped = np.load(done.files["dropped"])
        return (dropped > 0 if len(dropped) else np.zeros(len(cloud), bool)), seconds, done.facts


def dufomap(cloud: PointCloud, path: Trajectory) -> tuple[Bools, float]:
    """The same of DUFOMap, with its authors' settings, from the scanner's place in the middle of each window."""
    from dufomap import dufomap as peer

    assert cloud.time is not None
    begin = time.perf_counter()
    order = np.argsort(cloud.time, kind="stable")
    window = np.floor((cloud.time[order] - cloud.time.min()) / WINDOW + 0.5)
    sweeps = np.split(order, np.flatnonzero(np.diff(window)) + 1)
    poses = []
    found = peer(0.1, 0.2, 1)
    for index in sweeps:
        pose = np.eye(4)
        pose[:3, 3] = path.at(cloud.time[index].mean(keepdims=True))[0]
        poses.append(pose)
        found.run(cloud.xyz[index], pose, cloud_transform=False)
    found.oncePropagateCluster(if_propagate=True, if_cluster=False)
    gone = np.zeros(len(cloud), bool)
    for index, pose in zip(sweeps, poses, strict=True):
        gone[index] = np.asarray(found.segment(cloud.xyz[index], pose, cloud_transform=False)) > 0
    return gone, time.perf_counter() - begin


def figures(cloud: PointCloud, moves: Bools, gone: Bools, seconds: float) -> dict[str, Any]:
    """Shares lost and found."""
    assert cloud.classification is not None
    lost = {
        name_of(int(code)): round(float(gone[(cloud.classification == code) & ~moves].mean()), 5)
        for code in np.unique(cloud.classification[~moves])
    }
    return {
        "static_lost": round(float(gone[~moves].mean()), 5),
        "moving_found": round(float(gone[moves].mean()), 4) if moves.any() else None,
        "seconds": round(seconds, 1),
        "lost": lost,
    }


def tile_of(folder: Path) -> tuple[PointCloud, Trajectory]:
    """The cloud of a tile, as ingested, and the scanner's path."""
    tile = read_tile(folder)
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        frame = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
        files = {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}
        cloud = INGEST.run(files, INGEST.params(**frame), out, silent).files["cloud"]
        path = PATH.run({}, PATH.params(**scanner_path(tile)), out, silent).files["path"]
        return PointCloud.load(cloud), Trajectory.load(path)


def driven(cloud: PointCloud, path: Trajectory) -> Bools:
    """(N,) which points lie where the vehicle has driven: 1.3 m to each side, above the road, below its roof."""
    from scipy.spatial import cKDTree

    places = path.at(np.linspace(path.times[0], path.times[-1], 1000))
    distance, at = cKDTree(places[:, :2]).query(cloud.xyz[:, :2], distance_upper_bound=1.3, workers=-1)
    above = cloud.xyz[:, 2] - np.append(places[:, 2], np.nan)[at]
    return np.isfinite(distance) & (above > -1.45) & (above < 1.0)


def main() -> None:
    """Time it as the command line asks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--length", type=float, default=40.0)
    parser.add_argument("--points", type=float, default=1.6e6)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 3])
    parser.add_argument("--tiles", type=Path, nargs="*", default=[])
    parser.add_argument("--peer", action="store_true")
    given = parser.parse_args()
    result: dict[str, Any] = {}
    carved(*street(8.0, 20_000, 0)[:2])  # compiles
    for seed in given.seeds:
        cloud, path, moves = street(given.length, given.points, seed)
        gone, seconds, _ = carved(cloud, path)
        result[f"street {seed}"] = figures(cloud, moves, gone, seconds)
        if given.peer:
            result[f"street {seed} by DUFOMap"] = figures(cloud, moves, *dufomap(cloud, path))
    for folder in given.tiles:
        cloud, path = tile_of(folder)
        gone, seconds, facts = carved(cloud, path)
        where = driven(cloud, path)
        result[folder.name] = {
            "dropped": round(float(gone.mean()), 5),
            "driven_through_left": int((where & ~gone).sum()),
            "driven_through": int(where.sum()),
            "seconds": round(seconds, 1),
        } | {key: facts[key] for key in ("moved", "own_volume")}
        if given.peer:
            gone, seconds = dufomap(cloud, path)
            result[f"{folder.name} by DUFOMap"] = {
                "dropped": round(float(gone.mean()), 5),
                "driven_through_left": int((where & ~gone).sum()),
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
