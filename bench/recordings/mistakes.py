"""Usual mistakes in poses, cameras and times, injected into recordings: is each named, with the option that fixes it?

Each recording is imported correctly, written again as a user's files with one mistake (a cloud and a CSV of photos for
`scan2sim import clouds`; sweeps, poses, extrinsics and photo times for `import sweeps`), and imported. A mistake counts
if the check names an option and the import with it gives the correct poses; in all recordings.
"""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.data_samples.street import generate
from scan2sim.flows.pipelines.kitti import import_kitti_odometry, import_kitti_raw
from scan2sim.flows.pipelines.settings import parsed
from scan2sim.pipeline.core.types import F64, Camera, Frame, PointCloud, Tile, Trajectory, View
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.importers.sweeps import PhotoInput, PlacementParams, import_sweeps
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.pose_check import conventions
from scan2sim.pipeline.pose_check.check import find_mistake
from scan2sim.pipeline.pose_check.conventions import PhotoConventions, PosedPhotos

REAL_DATA = Path(os.environ.get("SCAN2SIM_REAL_DATA", "absent"))
RECORDINGS = ("synthetic", "kitti_raw0009_f00-24", "kitti_odo04_f00-24", "kitti_raw0013_f62-83")
UTM, NEXT_ZONE = "EPSG:32632", "EPSG:32631"
UTM_ORIGIN = (457_000.0, 5_428_000.0, 110.0)
"""Position of recordings without georeference."""
MAX_SHIFT_M, MAX_TURN_RAD = 0.05, 0.01
"""Deviations from the correct poses up to which a mistake counts as fixed."""
MIN_PHOTOS_SHARE = 0.7
"""Share of the photos that must be left: the first or last ones may have no pose."""
SWEEP_RANGE_M = 20.0
SYNTHETIC_FRAME_S = 0.5
MAX_CSV_POINTS = 300_000


@dataclass(frozen=True)
class Recording:
    """A recording with correct poses: a tile in a UTM zone, and the scanner's poses at the times of the photos."""

    name: str
    tile: Tile
    T_world_scanner: F64


Given = Callable[[PosedPhotos], PosedPhotos]


def _correct(photos: PosedPhotos) -> PosedPhotos:
    return photos


def _next_pose(photos: PosedPhotos) -> PosedPhotos:
    return conventions.shifted(photos, 1)[0]


def _larger_images(photos: PosedPhotos) -> PosedPhotos:
    return replace(
        photos,
        cameras=tuple(
            replace(c, fx=2 * c.fx, fy=2 * c.fy, cx=2 * c.cx + 0.5, cy=2 * c.cy + 0.5) for c in photos.cameras
        ),
    )


CSV_MISTAKES: dict[str, tuple[Given, PhotoConventions]] = {
    "rotations transposed": (conventions.transposed, PhotoConventions()),
    "axes y-up": (lambda photos: photos.rotated(photos.R @ conventions.AXES["opengl"].T), PhotoConventions()),
    "axes of a body": (lambda photos: photos.rotated(photos.R @ conventions.AXES["ros"].T), PhotoConventions()),
    "focal lengths of another resolution": (_larger_images, PhotoConventions()),
    "latitude and longitude swapped": (
        lambda photos: conventions.swapped_axes(conventions.to_crs(photos, "EPSG:4326")),
        PhotoConventions(photos_crs="EPSG:4326"),
    ),
    "UTM zone": (lambda photos: conventions.to_crs(photos, NEXT_ZONE), PhotoConventions()),
    "feet": (lambda photos: photos.at(photos.positions / 0.3048), PhotoConventions()),
    "quaternion order": (lambda photos: conventions.reordered_quaternions(photos, -1), PhotoConventions()),
    "next photo's pose": (_next_pose, PhotoConventions()),
}
"""Mistakes in a CSV of photos: how poses and cameras are written, and the options with which it is imported."""
SWEEP_MISTAKES = ("times off by a frame", "extrinsics inverted")
SAME = {"axes of a body": "axes y-up"}
"""Variants that count as one mistake."""


def measure(out: Path) -> dict[str, Any]:
    """Number of mistakes that are named and fixed in all recordings, and of those named in correct ones.

    Args:
        out: folder for the recordings; cleared.
    """
    shutil.rmtree(out, ignore_errors=True)
    named: dict[str, list[bool]] = {}
    false = 0
    for recording in _recordings(out):
        for name, tile, again in _imports(recording, out / recording.name):
            mistake = find_mistake(tile)
            if not name:
                false += mistake is not None
                print(f"{recording.name}: correct: {mistake or 'nothing is named'}", flush=True)
                continue
            fixed = mistake is not None and _same_poses(again(mistake.option), recording.tile)
            named.setdefault(SAME.get(name, name), []).append(fixed)
            print(f"{recording.name}: {name}: {'fixed' if fixed else 'NOT FIXED'}: {mistake}", flush=True)
    return {"mistakes_named": sum(map(all, named.values())), "mistakes": len(named), "mistakes_false": false}


def _recordings(folder: Path) -> Iterator[Recording]:
    for name in RECORDINGS:
        base = folder / f"{name}_base"
        if name == "synthetic":
            generate(base, length=40.0, points=500_000, photos=40, seed=5, photo_width=480)
        elif not (REAL_DATA / name).is_dir():
            print(f"{name}: not here (SCAN2SIM_REAL_DATA)", flush=True)
            continue
        elif "odo" in name:
            import_kitti_odometry(REAL_DATA / name, base, pose_source="given", link=True)
        else:
            import_kitti_raw(REAL_DATA / name, base, pose_source="given", link=True)
        yield _recording(name, base)


def _recording(name: str, base: Path) -> Recording:
    """The recording with its cloud thinned and in UTM coordinates."""
    tile = read_tile(base)
    cloud = PointCloud.join([clouds.read(path, tile.frame) for path in tile.clouds])
    cloud = cloud.take(np.arange(0, len(cloud), max(1, len(cloud) // MAX_CSV_POINTS)))
    frame = tile.frame if tile.frame.crs != "local" else Frame(UTM, UTM_ORIGIN)
    if tile.frame.crs not in ("local", UTM):
        frame = Frame(UTM, UTM_ORIGIN)
    path = base / "utm.laz"
    las.write(path, replace(cloud, frame=frame, rgb=None))
    views = tuple(view for view in tile.views if view.time is not None)
    assert tile.trajectory is not None
    if name == "synthetic":
        views = _evenly_timed(views)
    if tile.trajectory.rotations is None:  # the scanner turns with the first camera
        T = np.array([view.T_world_cam for view in _first_camera(views)]) @ _scanner_axes()
    else:
        T = tile.trajectory.pose_at(np.array([view.time for view in _first_camera(views)], np.float64))
    return Recording(name, replace(tile, clouds=(path,), frame=frame, views=views), T)


def _evenly_timed(views: Sequence[View]) -> tuple[View, ...]:
    """Synthetic photos at even times: those of the generator are rounded."""
    timed = list(views)
    for rows in conventions.camera_rows([view.camera for view in views]):
        for k, row in enumerate(rows.tolist()):
            timed[row] = replace(views[row], time=SYNTHETIC_FRAME_S * k)
    return tuple(timed)


def _first_camera(views: Sequence[View]) -> list[View]:
    """The photos of the first camera, from which sweeps are made."""
    return [view for view in views if view.camera is views[0].camera]


def _scanner_axes() -> F64:
    """(4, 4) T_camera_scanner of a scanner above the camera: x ahead, y left, z up."""
    T = np.eye(4)
    T[:3, :3] = conventions.AXES["ros"].T  # scanner to camera axes
    T[:3, 3] = 0.1, -0.4, -0.2
    return T


def _imports(recording: Recording, work: Path) -> Iterator[tuple[str, Tile, Callable[[str], Tile]]]:
    """Name of each mistake ("" for correct files), the imported tile, and a function that imports it with an option."""
    given = PosedPhotos(_world(recording), tuple(v.camera for v in recording.tile.views), recording.tile.frame)
    for name, (change, options) in ({"": (_correct, PhotoConventions())} | CSV_MISTAKES).items():
        folder = work / (name or "correct").replace(" ", "_")
        table = _write_csv(folder, change(given), recording, quaternions="quaternion" in name)

        def read(option: str, table: Path = table, options: PhotoConventions = options) -> Tile:
            return _import_csv(table, recording, options, option)

        yield name, read(""), read
    sweeps = _write_sweeps(work / "sweeps", recording)
    for name in ("", *SWEEP_MISTAKES):

        def place(option: str, name: str = name) -> Tile:
            return _import_sweeps(sweeps, recording, name, option)

        yield name, place(""), place


def _world(recording: Recording) -> F64:
    """Poses (V, 4, 4) of the photos in the CRS, metres."""
    T = np.array([view.T_world_cam for view in recording.tile.views])
    T[:, :3, 3] += np.asarray(recording.tile.frame.origin)
    return T


def _write_csv(folder: Path, photos: PosedPhotos, recording: Recording, quaternions: bool) -> Path:
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True)
    known = dict.fromkeys(id(view.camera) for view in recording.tile.views)
    names = {key: f"camera_{k}" for k, key in enumerate(known)}
    with open(folder / "photos.csv", "w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        turn = ["qx", "qy", "qz", "qw"] if quaternions else [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
        rows.writerow(["file", "x", "y", "z", *turn, "time", *_CAMERA])
        for view, T, camera in zip(recording.tile.views, photos.T, photos.cameras, strict=True):
            R = Rotation.from_matrix(T[:3, :3])
            values = (R.as_quat() if quaternions else R.as_matrix().ravel()).tolist()
            rows.writerow(
                [
                    view.photo.resolve(),
                    *T[:3, 3].tolist(),
                    *values,
                    view.time,
                    *_camera_cells(names[id(view.camera)], camera),
                ]
            )
    return folder / "photos.csv"


_CAMERA = ("camera", "model", "width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def _camera_cells(name: str, camera: Camera) -> list[object]:
    values = [*camera.distortion, *[0.0] * (5 - len(camera.distortion))]
    return [name, camera.model, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *values]


def _import_csv(table: Path, recording: Recording, options: PhotoConventions, option: str) -> Tile:
    given = PhotoConventions.of("", options.model_dump(exclude_unset=True) | _value(option))
    out = table.parent / "tile"
    return read_tile(
        import_las(
            recording.tile.clouds, out, photos=table, images=Path("/"), conventions=given, link=True, overwrite=True
        )
    )


def _value(option: str) -> dict[str, object]:
    if not option:
        return {}
    name, _, value = option.removeprefix("--").partition(" ")
    return {name.replace("-", "_"): parsed(value) if value else True}


def _write_sweeps(folder: Path, recording: Recording) -> Path:
    """Sweeps at the positions of the photos, in scanner axes, and the scanner's trajectory."""
    tile = recording.tile
    (folder / "bins").mkdir(parents=True)
    (folder / "photos").mkdir()
    cloud = PointCloud.join([clouds.read(path, tile.frame) for path in tile.clouds])
    assert cloud.intensity is not None
    rng = np.random.default_rng(0)
    for k, (T, view) in enumerate(zip(recording.T_world_scanner, _first_camera(tile.views), strict=True)):
        inverse = np.linalg.inv(T)
        local = cloud.xyz @ inverse[:3, :3].T + inverse[:3, 3]
        near = (np.linalg.norm(local, axis=1) < SWEEP_RANGE_M) & (rng.random(len(local)) < 0.15)
        rows = np.column_stack([local[near], cloud.intensity[near] / 65535.0]).astype(np.float32)
        rows.tofile(folder / "bins" / f"{k:06d}.bin")
        (folder / "photos" / f"{k:06d}{view.photo.suffix}").symlink_to(view.photo.resolve())
    times = np.array([view.time for view in _first_camera(tile.views)], np.float64)
    T = recording.T_world_scanner
    trajectory_io.write(folder / "poses.csv", Trajectory(times, T[:, :3, 3], T[:, :3, :3]), tile.frame)
    return folder


def _import_sweeps(folder: Path, recording: Recording, name: str, option: str) -> Tile:
    views = _first_camera(recording.tile.views)
    times = np.array([view.time for view in views], np.float64)
    np.savetxt(folder / "times.txt", times, fmt="%.6f")
    frame = float(np.median(np.diff(times)))
    np.savetxt(folder / "photo_times.txt", times - (frame if name.startswith("times") else 0.0), fmt="%.6f")
    T_camera_scanner = np.linalg.inv(views[len(views) // 2].T_world_cam) @ recording.T_world_scanner[len(views) // 2]
    if name.startswith("extrinsics"):
        T_camera_scanner = np.linalg.inv(T_camera_scanner)
    photos = PhotoInput(folder / "photos", views[0].camera, folder / "photo_times.txt")
    values: dict[str, object] = {"scanner_poses": True, "crs": UTM, "deskew": "none", "max_range": 60.0}
    placing = PlacementParams.of("", values | _value(option))
    return read_tile(
        import_sweeps(
            folder / "bins", folder / "poses.csv", folder / "tile", placing, extrinsics=T_camera_scanner,
            times=folder / "times.txt", photos=[photos], link=True, overwrite=True,
        )
    )  # fmt: skip


def _same_poses(tile: Tile, correct: Tile) -> bool:
    """Whether the photos of a tile have the correct poses and cameras."""
    expected = {view.photo.resolve(): view for view in correct.views}
    shift = np.asarray(tile.frame.origin) - np.asarray(correct.frame.origin)
    for view in tile.views:
        other = expected[view.photo.resolve()]
        turn = np.trace(view.T_world_cam[:3, :3].T @ other.T_world_cam[:3, :3])
        if np.linalg.norm(view.centre + shift - other.centre) > MAX_SHIFT_M:
            return False
        if np.arccos(np.clip((turn - 1) / 2, -1, 1)) > MAX_TURN_RAD:
            return False
        if abs(view.camera.fx - other.camera.fx) > 1 or abs(view.camera.cx - other.camera.cx) > 1:
            return False
    return len(tile.views) >= MIN_PHOTOS_SHARE * len(_first_camera(correct.views))
