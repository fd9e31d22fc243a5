"""Maps of the benchmark: robots' real ones, maps cut from KITTI's sweeps, and simulated ones with ground truth."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.maps.command import Missing, scan2sim
from scan2sim.data_samples.building import Building, Style, build
from scan2sim.data_samples.robot_map import Lidar, Mapping, RobotMap, random_rotation, record
from scan2sim.pipeline.core.types import F32, F64, I64, Frame
from scan2sim.pipeline.geometry.voxel_grid import voxel_groups
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.navigation import pcd

REAL_DATA = "SCAN2SIM_REAL_DATA"
"""Environment variable with the folder of real recordings."""
REAL_UP = {"hdl501": (0.132, -0.099, 0.986), "dddmr": (0.0, 1.0, 0.02), "lobby": (0.013, 0.007, 1.0)}
"""Up in the axes of the real maps: the direction in which the normals of their walls vary least; those of dddmr
leave 1 to 2 degrees open: its value is the normal of its ground."""
SENSOR_HEIGHT_M = 0.5
"""Assumed height of the sensors of the real maps."""
REAL_UP_TOLERANCE_DEG, DRIVE_UP_TOLERANCE_DEG, TRUE_UP_TOLERANCE_DEG = 2.0, 3.0, 0.5
"""Maximum angle between found and true up: of the real maps; of a car on a road; exactly known."""
DRIVES = {
    "odo04": ("kitti-odometry", "kitti_odo04_f00-24", ()),
    "raw0009": ("kitti-raw", "kitti_raw0009_f00-24", ("--poses", "T_velo0_velo_icp_frames_0-24.txt")),
    "raw0013": ("kitti-raw", "kitti_raw0013_f62-83", ()),
}
"""KITTI's drives: command of the import, folder, and options, of which files are in the folder."""
DRIVE_VOXELS_M = (0.05, 0.2, 0.5)
KITTI_SENSOR_HEIGHT_M = 1.73
BUILDINGS: dict[str, tuple[Style, Lidar, Mapping]] = {
    "plain": (Style(), Lidar(), Mapping()),
    "tilted": (Style(rooms=2), Lidar(pitch=10.0, roll=4.0), Mapping(outliers=0.002)),
    "loam": (Style(rooms=4, glass=True), Lidar(height=0.8), Mapping(axes="loam", people=2, outliers=0.002)),
    "oblique": (Style(rooms=3), Lidar(height=1.0), Mapping(start=random_rotation(7), people=1, reflections=0.15)),
    "stairs": (Style(storeys=2, stairs=True), Lidar(pitch=-6.0), Mapping(outliers=0.002)),
    "coarse": (Style(rooms=5), Lidar(height=0.4), Mapping(voxel=0.1, axes="ned", reflections=0.1)),
}
"""Simulated buildings: style, lidar, mapping."""


@dataclass(frozen=True)
class BenchMap:
    """A map and what is known of it.

    Attributes:
        name: unique in the benchmark.
        path: its PCD file.
        xyz: (N, 3) its points, in its own frame, metres.
        up: (3,) true up in the map's axes, unit.
        tolerance_deg: maximum angle between found and true up.
        sensor: (3,) position of the robot's sensor at the start.
        height: of the sensor above the floor, metres.
        building, truth: of a simulated map.
        lidar: of a simulated map.
    """

    name: str
    path: Path
    xyz: F64
    up: F64
    tolerance_deg: float
    sensor: F64
    height: float
    building: Building | None = None
    truth: RobotMap | None = None
    lidar: Lidar | None = None


def folder() -> Path:
    """Folder of the real recordings.

    Raises:
        Missing: the environment variable isn't set, or the folder doesn't exist.
    """
    path = Path(os.environ.get(REAL_DATA, ""))
    if not os.environ.get(REAL_DATA) or not path.is_dir():
        raise Missing(f"real recordings: set {REAL_DATA} to their folder")
    return path


def real_names() -> list[str]:
    """Names of the robots' maps in the folder of real recordings."""
    return sorted(path.stem for path in (folder() / "slam_maps").glob("*.pcd"))


def real(name: str) -> BenchMap:
    """A robot's map."""
    path = folder() / "slam_maps" / f"{name}.pcd"
    if not path.is_file():
        raise Missing(f"{path} doesn't exist")
    up = np.array(REAL_UP.get(name, (0.0, 0.0, 1.0)))
    cloud = clouds.read(path, Frame())
    return BenchMap(
        name, path, cloud.xyz.astype(np.float64), up / np.linalg.norm(up), REAL_UP_TOLERANCE_DEG, np.zeros(3),
        SENSOR_HEIGHT_M,
    )  # fmt: skip


def drive(name: str, voxel: float, out: Path) -> BenchMap:
    """Map of a KITTI drive: imported, thinned, in the first sensor pose, with intensities only."""
    from scan2sim.pipeline.io.calibration import read_extrinsics
    from scan2sim.pipeline.io.tile import read_tile

    command, data, options = DRIVES[name]
    source, tile = folder() / data, out / name / "tile"
    if not source.is_dir():
        raise Missing(f"{source} doesn't exist")
    if not (tile / "tile.toml").is_file():
        files = [source / option if (source / option).is_file() else option for option in options]
        scan2sim(out / name / "import.log", "import", command, source, *files, "--out", tile)
    read = read_tile(tile / "tile.toml")
    cloud = clouds.read(read.clouds[0], read.frame)
    assert read.trajectory is not None
    turn = np.eye(3)
    if command == "kitti-raw":  # odometry tiles are in the axes of the first sweep already
        calibration = next(source.rglob("calib_velo_to_cam.txt"))
        turn = read.views[0].T_world_cam[:3, :3] @ read_extrinsics(calibration)[:3, :3]
    xyz = (cloud.xyz.astype(np.float64) - read.trajectory.positions[0]) @ turn
    assert cloud.intensity is not None
    intensity = (cloud.intensity / 256).astype(np.float32)
    thin, intensity, _ = thinned(xyz, intensity, voxel)
    path = out / name / f"map_{round(100 * voxel)}cm.pcd"
    pcd.write(path, thin, intensity)
    return BenchMap(
        f"{name}_{round(100 * voxel)}cm", path, thin, turn[2], DRIVE_UP_TOLERANCE_DEG, np.zeros(3),
        KITTI_SENSOR_HEIGHT_M,
    )  # fmt: skip


def thinned(xyz: F64, intensity: F32, voxel: float) -> tuple[F64, F32, tuple[I64, I64]]:
    """Mean positions (V, 3) and intensities (V,) per voxel, and `voxel_groups` of the points."""
    order, begin = voxel_groups(xyz.astype(np.float32), voxel)
    count = np.diff(np.append(begin, len(order)))
    thin = np.stack([np.add.reduceat(xyz[order, k], begin) / count for k in range(3)], axis=1)
    return thin, (np.add.reduceat(intensity[order], begin) / count).astype(np.float32), (order, begin)


def simulated(name: str, out: Path, seed: int = 0, points: int | None = None) -> BenchMap:
    """Map of a simulated building; `points`: random sample of this size."""
    style, lidar, mapping = BUILDINGS[name]
    return simulate(name, style, lidar, mapping, out, seed=100 * list(BUILDINGS).index(name) + seed, points=points)


def simulate(
    name: str, style: Style, lidar: Lidar, mapping: Mapping, out: Path, *, seed: int, points: int | None = None
) -> BenchMap:
    """Map of a building that a robot drives through.

    Raises:
        ValueError: it has fewer than `points` points.
    """
    building = build(seed, style)
    made = record(building, lidar, mapping, seed)
    if points is not None:
        if len(made.xyz) < points:
            raise ValueError(f"the map {name} has {len(made.xyz)} points, not {points}")
        keep = np.sort(np.random.default_rng(seed).permutation(len(made.xyz))[:points])
        made = replace(
            made, xyz=made.xyz[keep], intensity=made.intensity[keep], surface=made.surface[keep], time=made.time[keep]
        )
    path = out / name / "map.pcd"
    path.parent.mkdir(parents=True, exist_ok=True)
    pcd.write(path, made.xyz, made.intensity)
    (path.parent / "truth.json").write_text(json.dumps({"T_map_world": made.T_map_world.tolist()}), encoding="utf-8")
    return BenchMap(
        name, path, made.xyz, made.up, TRUE_UP_TOLERANCE_DEG, made.trajectory.positions[0], lidar.height, building,
        made, lidar,
    )  # fmt: skip


def all_maps(out: Path, names: Sequence[str] = ()) -> Iterator[BenchMap | Missing]:
    """All maps, or those whose names begin with one of `names`; an `Missing` instead of one that is missing."""

    def wanted(name: str) -> bool:
        return not names or any(name.startswith(prefix) for prefix in names)

    try:
        yield from (real(name) for name in real_names() if wanted(name))
    except Missing as why:
        yield why
    for name in DRIVES:
        for voxel in DRIVE_VOXELS_M:
            if wanted(f"{name}_{round(100 * voxel)}cm"):
                try:
                    yield drive(name, voxel, out)
                except Missing as why:
                    yield why
    yield from (simulated(name, out) for name in BUILDINGS if wanted(name))
