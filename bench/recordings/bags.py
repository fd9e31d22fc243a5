"""ROS bags: recordings written in every format, and imported by `scan2sim import bag` and by their own importer."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.maps.command import Missing, scan2sim
from scan2sim.data_samples import paths
from scan2sim.data_samples.panorama import Panorama
from scan2sim.data_samples.town import build
from scan2sim.pipeline.camera.models import pixel_rays, project
from scan2sim.pipeline.core.types import F64, Camera, Frame, Trajectory
from scan2sim.pipeline.importers.deskew import scan_phase
from scan2sim.pipeline.importers.kitti_raw import EGO_VEHICLE_BOX, read_drive
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.images.image import read_rgb
from scan2sim.pipeline.io.sweep_files import Sweep, read_bin, write_sweep
from scan2sim.pipeline.io.tile import read_tile
from tests.fakes.bags import FORMATS, BagFile, bag_file, bag_path, records

TOLERANCE_M = 1e-3
STEP_M = 1e-3
"""Clouds store whole millimetres: a coordinate near the middle of two may be rounded to either."""
RANGE_M = 50.0
"""Distance at which a difference of rotations counts as a distance."""
BASE_TO_SCANNER = np.array([[0.0, -1, 0, 0.9], [1, 0, 0, 0.1], [0, 0, 1, 1.7], [0, 0, 0, 1]])
"""T_base_scanner of the bags: the scanner is turned by 90 degrees on the vehicle."""
SYNTHETIC_SWEEPS, SWEEP_ROWS, SPEED_M_S, PERIOD_S = 12, 240, 8.0, 0.1
MIN_ELEVATION_DEG, MAX_ELEVATION_DEG = -25.0, 15.0
CAMERA = Camera("opencv", 320, 200, 190.0, 191.0, 158.0, 101.0, (-0.12, 0.03, 1e-3, -5e-4))
T_CAMERA_SCANNER = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Recording:
    """A recording: writer of its messages, arguments of `import bag`, and the tile of its own importer."""

    name: str
    write: Callable[[BagFile], None]
    options: tuple[object, ...]
    native: Path


def measure(out: Path) -> dict[str, Any]:
    """`bags_differ`, and the largest differences."""
    shutil.rmtree(out, ignore_errors=True)
    differ, count, largest, equal = 0, 0, 0.0, 1.0
    for make in (kitti, synthetic):
        recording = make(out / make.__name__)
        for form in FORMATS:
            bag = bag_path(out / recording.name, form)
            with bag_file(bag, form) as writer:
                recording.write(writer)
            tile = out / recording.name / f"tile_{form}"
            scan2sim(out / f"{recording.name}_{form}.log", "import", "bag", bag, "--out", tile, *recording.options)
            found = differences(recording.native, tile)
            count += 1
            differ += bool(found.causes)
            largest, equal = max(largest, found.metres), min(equal, found.equal)
            text = f"poses {1e3 * found.metres:.4f} mm, {100 * found.equal:.2f} % of the points identical"
            print(f"bags {recording.name:10} {form:8} {'; '.join([text, *found.causes])}", flush=True)
    figures = {"bags_pose_mm": round(1e3 * largest, 4), "bags_points_identical": round(equal, 4)}
    return {"bags_differ": differ, "bags": count} | figures


@dataclass(frozen=True)
class Differences:
    """Differences of two tiles.

    Attributes:
        metres: the largest of the poses.
        equal: share of points with identical stored coordinates.
        causes: what exceeds the tolerance.
    """

    metres: float
    equal: float
    causes: list[str]


def differences(expected: Path, got: Path) -> Differences:
    """Compare clouds, photos, cameras and poses of two tiles."""
    a, b = read_tile(expected), read_tile(got)
    causes: list[str] = []
    largest = 0.0

    def compare(what: str, one: F64, other: F64) -> None:
        nonlocal largest
        if one.shape != other.shape:
            causes.append(f"{len(one)} and {len(other)} {what}")
            return
        metres = float(np.linalg.norm(one - other, axis=-1).max(initial=0))
        largest = max(largest, metres)
        if metres > TOLERANCE_M:
            causes.append(f"{what} differ by {1e3 * metres:.1f} mm")

    frame = Frame(a.frame.crs, a.frame.origin, a.frame.unit)
    points = [np.concatenate([clouds.read(p, frame).xyz for p in tile.clouds]).astype(np.float64) for tile in (a, b)]
    equal = 0.0
    if len(points[0]) == len(points[1]):
        steps = np.abs(np.rint((points[0] - points[1]) / STEP_M)).max(axis=1)
        equal = float((steps == 0).mean())
        if steps.max() * STEP_M > TOLERANCE_M:
            causes.append(f"{int((steps > 1).sum())} points differ, by up to {steps.max():.0f} mm in a coordinate")
    else:
        causes.append(f"{len(points[0])} and {len(points[1])} points")
    shift = np.asarray(b.frame.origin) - np.asarray(a.frame.origin)
    views = [sorted(tile.views, key=lambda view: view.time or 0.0) for tile in (a, b)]
    probes = RANGE_M * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    seen = [np.array([probes @ v.T_world_cam[:3, :3].T + v.centre for v in own]).reshape(-1, 3) for own in views]
    compare("photo poses", seen[0], seen[1] + shift)
    for one, other in zip(*views, strict=False):
        if one.camera.model != other.camera.model or not np.allclose(_numbers(one.camera), _numbers(other.camera)):
            causes.append(f"cameras differ: {one.camera}, {other.camera}")
            break
        if not np.array_equal(read_rgb(one.photo), read_rgb(other.photo)):
            causes.append(f"photos differ: {one.name}, {other.name}")
            break
    assert a.trajectory is not None and b.trajectory is not None
    compare("trajectory positions", a.trajectory.positions, b.trajectory.positions + shift)
    if a.frame.crs != b.frame.crs:
        causes.append(f"CRS {a.frame.crs} and {b.frame.crs}")
    return Differences(largest, equal, causes)


def _numbers(camera: Camera) -> list[float]:
    return [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]


def kitti(out: Path) -> Recording:
    """KITTI raw 0009: Velodyne layout, photos as PNG, poses by /tf.

    Raises:
        Missing: the recording isn't there.
    """
    folder = Path(os.environ.get("SCAN2SIM_REAL_DATA", "")) / "kitti_raw0009_f00-24"
    if not folder.is_dir():
        raise Missing("kitti_raw0009_f00-24 is not in the folder that SCAN2SIM_REAL_DATA gives")
    drive = read_drive(folder)
    rig = drive.rigs["image_02"]

    def write(bag: BagFile) -> None:
        first = float(drive.spans[0, 1])
        bag.transforms(
            "/tf_static", first,
            [("base_link", "velodyne", BASE_TO_SCANNER, first), ("velodyne", "camera_left", rig.T_velo_cam, first)],
        )  # fmt: skip
        for (number, file), (start, middle, end), T in zip(
            drive.sweeps.items(), drive.spans.tolist(), drive.T_velo, strict=True
        ):
            xyz, reflectance = read_bin(file)
            time = start + scan_phase(xyz) * (end - start) - middle
            bag.transforms("/tf", middle, [("map", "base_link", T @ np.linalg.inv(BASE_TO_SCANNER), middle)])
            points = records(xyz, intensity=reflectance, ring=np.zeros(len(xyz), "u2"), time=time.astype(np.float32))
            bag.cloud("/velodyne_points", middle, "velodyne", points)
            photo = drive.photos["image_02"].get(number)
            if photo is not None:
                bag.compressed("/left/image_rect/compressed", middle, "camera_left", photo.read_bytes(), "png")
                bag.camera_info("/left/camera_info", middle, "camera_left", rig.camera)

    box = [value for corner in EGO_VEHICLE_BOX for value in corner]
    options = ("--pose-source", "given", "--crs", drive.crs, "--min-range", 0, "--max-range", 50, "--vehicle-box", *box)
    scan2sim(
        out.parent / "kitti_native.log",
        "import",
        "kitti-raw",
        folder,
        "--pose-source",
        "given",
        "--out",
        out / "native",
    )
    return Recording("kitti", write, options, out / "native")


def synthetic(out: Path) -> Recording:
    """The synthetic town: Ouster layout, a camera with distortion, poses by odometry; compared with `import sweeps`."""
    import cv2

    path = paths.town_path(0, 200.0)
    driven = paths.drive(path, SPEED_M_S, 1 / PERIOD_S, still=0.0, seed=0)
    start = 1_700_000_000.0
    way = Trajectory(driven.times[:SYNTHETIC_SWEEPS], *_first(driven, SYNTHETIC_SWEEPS))
    times = np.round(start + way.times, 6)
    T = way.poses @ T_CAMERA_SCANNER
    town = Panorama(build(path, 0), None, SWEEP_ROWS, 0)
    panorama = Camera("equirectangular", 2 * SWEEP_ROWS, SWEEP_ROWS)
    rays = pixel_rays(panorama).reshape(-1, 3).astype(np.float64)
    elevation = np.degrees(np.arcsin(-rays[:, 1]))
    beam = (elevation > MIN_ELEVATION_DEG) & (elevation < MAX_ELEVATION_DEG)
    uv, _ = project(panorama, pixel_rays(CAMERA).reshape(-1, 3).astype(np.float64))
    maps = uv.reshape(CAMERA.height, CAMERA.width, 2).transpose(2, 0, 1)
    sweeps: list[tuple[Any, Any]] = []
    photos: list[Any] = []
    for name in ("sweeps", "photos"):
        (out / name).mkdir(parents=True)
    for i, pose in enumerate(way.poses):
        image = town.render(pose, float(way.times[i]))
        far = image.depth.ravel()
        hit = beam & (far < 80) & (far > 1)
        xyz = (rays[hit] * far[hit, None] @ T_CAMERA_SCANNER[:3, :3]).astype(np.float32)
        t = np.round(scan_phase(xyz) * PERIOD_S * 1e9).astype(np.uint32)
        sweeps.append((xyz, t))
        photos.append(cv2.remap(image.rgb, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))
        write_sweep(
            out / "sweeps" / f"{times[i]:.6f}.ply",
            Sweep(xyz, np.full(len(xyz), 32767, np.uint16), None, times[i] + t * 1e-9),
        )
        cv2.imwrite(str(out / "photos" / f"{times[i]:.6f}.png"), photos[-1][..., ::-1])
    trajectory_io.write(out / "poses.csv", Trajectory(times, T[:, :3, 3], T[:, :3, :3]))
    np.savetxt(out / "extrinsics.txt", T_CAMERA_SCANNER[:3])
    (out / "camera.toml").write_text(
        f'[[cameras]]\nid = "a"\nmodel = "opencv"\nsize = [{CAMERA.width}, {CAMERA.height}]\nfocal = [{CAMERA.fx}, '
        f"{CAMERA.fy}]\ncentre = [{CAMERA.cx}, {CAMERA.cy}]\ndistortion = {list(CAMERA.distortion)}\n",
        encoding="utf-8",
    )

    def write(bag: BagFile) -> None:
        links = [("base", "os_lidar", BASE_TO_SCANNER), ("os_lidar", "mount", np.eye(4))]
        optical = ("mount", "camera_optical", np.linalg.inv(T_CAMERA_SCANNER))
        bag.transforms("/tf_static", start, [(*link, start) for link in (*links, optical)])
        for time, pose, (xyz, t), photo in zip(times.tolist(), T, sweeps, photos, strict=True):
            bag.odometry("/odometry", time, ("odom", "base"), pose @ np.linalg.inv(BASE_TO_SCANNER))
            columns = {
                "intensity": np.full(len(xyz), 127.4980545, "f4"),
                "t": t,
                "reflectivity": np.zeros(len(xyz), "u2"),
            }
            bag.cloud("/ouster/points", time, "os_lidar", records(xyz, **columns))
            bag.image("/front/image_raw", time, "camera_optical", photo, "rgb8")
            bag.camera_info("/front/camera_info", time, "camera_optical", CAMERA)

    scan2sim(
        out.parent / "synthetic_native.log", "import", "sweeps", out / "sweeps", out / "poses.csv", "--scanner-poses",
        "--deskew", "times", "--photos", out / "photos", "--camera", out / "camera.toml", "--extrinsics",
        out / "extrinsics.txt", "--out", out / "native",
    )  # fmt: skip
    return Recording("synthetic", write, (), out / "native")


def _first(driven: Trajectory, count: int) -> tuple[F64, F64]:
    assert driven.rotations is not None
    return driven.positions[:count], driven.rotations[:count]
