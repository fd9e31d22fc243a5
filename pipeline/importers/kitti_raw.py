"""Importer of KITTI raw drives (Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013).

Sweeps are merged by OXTS (GPS/IMU) poses or by a file of scan-matched ones; photos become posed
views. The tile is in UTM (WGS 84) if there is OXTS, with OXTS altitude as z; otherwise local,
in the first sweep's axes.

Sweeps of raw drives are not motion-compensated: the scanner rotates clockwise, starts and ends
pointing backwards, and points forward at the sweep's time stamp. Each point is transformed by the
pose of its own time (deskewing; at 11 m/s this moves points by up to half a metre). Photos are
triggered when the scanner points forward and get the pose of the sweep's time stamp. OXTS packets are
up to 20 ms later than the sweep of the same number, so poses are interpolated to the sweep's time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.poses import interpolate, nearest_rotation
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F32, F64, Camera, Frame, Trajectory, View
from scan2sim.pipeline.importers.deskew import scan_phase
from scan2sim.pipeline.importers.place_sweeps import PLACED, PlacedPoints, merge, place, write_placed
from scan2sim.pipeline.importers.scanner_path import ScannerPath
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.calibration import read_entry
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images.image import SUFFIXES
from scan2sim.pipeline.io.sweep_files import Sweep, read_bin, read_labels

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
# box that contains the recording car's own returns, scanner axes: (low, high) corner in metres
EGO_VEHICLE_BOX: tuple[tuple[float, float, float], tuple[float, float, float]] = ((-3.2, -1.3, -2.0), (2.8, 1.3, 0.3))
MAX_COORDINATE_M = 1e8
"""Plausibility limit of poses."""
SAME_DAY = "Use the synced and rectified photos with the calibration of the same day"


@dataclass(frozen=True)
class Rig:
    """A rectified camera and its extrinsics: `T_velo_cam` (4, 4), camera to scanner."""

    camera: Camera
    T_velo_cam: F64


@dataclass(frozen=True)
class Drive:
    """Sweeps, photos and poses of a drive.

    Attributes:
        name: name of the drive.
        sweeps: files by frame number.
        rigs: cameras by the name of their folder.
        photos: files by camera and frame number.
        spans: (F, 3) start, middle (scanner points forward) and end of each sweep, seconds.
        T_velo: (F, 4, 4) scanner to CRS at each sweep's middle.
        crs: code, or "local".
        labels: files of labels of the sweeps' points by frame number (`sweep_files.read_labels`).
    """

    name: str
    sweeps: dict[int, Path]
    rigs: dict[str, Rig]
    photos: dict[str, dict[int, Path]]
    spans: F64
    T_velo: F64
    crs: str
    labels: dict[int, Path] = field(default_factory=dict)


def read_drive(
    drive: Path,
    *,
    poses: Path | None = None,
    cameras: Sequence[str] = ("image_02",),
    frames: tuple[int, int] | None = None,
    name: str | None = None,
) -> Drive:
    """Files, calibration and poses of a drive; arguments as of `flows.pipelines.kitti.import_kitti_raw`.

    Raises:
        InputError: a file is missing or damaged. SettingError: no frame is selected.
    """
    drive = find_drive(drive)
    sweeps = select_frames(files_by_frame(drive / "velodyne_points" / "data", ".bin"), frames, drive)
    numbers = list(sweeps)
    spans = _spans(drive, numbers)
    T_velo, crs = _poses(drive, poses, numbers, spans[:, 1])
    return Drive(
        name or drive.name,
        sweeps,
        {folder: _rig(drive, folder) for folder in cameras},
        {folder: files_by_frame(drive / folder / "data", SUFFIXES) for folder in cameras},
        spans,
        T_velo,
        crs,
    )


def write_drive_tile(
    drive: Drive,
    out: Path,
    *,
    max_range: float,
    deskew: bool,
    vertical_angle_offset: float = 0.0,
    link: bool,
    overwrite: bool,
    report: Report,
) -> Path:
    """Create a tile from a drive: merge sweeps, colour points by the photos of their frames.

    Arguments and results are those of `flows.pipelines.kitti.import_kitti_raw`.

    Raises:
        InputError: a file is damaged. SettingError: `out` is not empty. DataError: no points are within range.
    """
    numbers, middles = list(drive.sweeps), drive.spans[:, 1]
    late = np.flatnonzero(np.diff(middles) <= 0)
    if len(late):
        raise InputError(
            drive.sweeps[numbers[late[0] + 1]],
            "its time stamp is not after that of the previous sweep",
            "Unpack the sweeps again",
        )
    x, y, z = (0.0, 0.0, 0.0) if drive.crs == "local" else np.floor(drive.T_velo[0, :3, 3]).tolist()
    frame, T_velo = Frame(drive.crs, (x, y, z)), drive.T_velo.copy()
    T_velo[:, :3, 3] -= frame.origin
    path = ScannerPath(middles, T_velo)
    views = {folder: dict[int, View]() for folder in drive.rigs}
    for folder, rig in drive.rigs.items():
        for T, number, middle in zip(T_velo, numbers, middles.tolist(), strict=True):
            photo = drive.photos[folder].get(number)
            if photo is not None:
                views[folder][number] = View(
                    f"{folder}/{photo.name}", rig.camera, T @ rig.T_velo_cam, photo, time=middle
                )

    def placed() -> Iterator[PlacedPoints]:
        for i, (number, (start, _, end)) in enumerate(zip(numbers, drive.spans, strict=True)):
            report(PLACED * i / len(numbers), f"sweep {number}")
            sweep = read_drive_sweep(drive.sweeps[number], max_range, vertical_angle_offset, drive.labels.get(number))
            beside = [(own[number], None) for own in views.values() if number in own]
            yield place(sweep, point_times(sweep, start, end, deskew), path, beside, remedy=SAME_DAY)

    return write_placed(
        out, merge(placed()), frame, Trajectory(middles, T_velo[:, :3, 3]),
        {folder: list(own.values()) for folder, own in views.items()},
        {folder: rig.camera for folder, rig in drive.rigs.items()}, sweeps=next(iter(drive.sweeps.values())).parent,
        name=drive.name, crs=frame.crs, link=link, overwrite=overwrite, report=report,
    )  # fmt: skip


def find_drive(folder: Path) -> Path:
    """The folder of a drive, `folder` itself or the only one in it.

    Raises:
        InputError: there is none, or more than one.
    """
    if (folder / "velodyne_points").is_dir():
        return folder
    found = sorted(path.parent for path in folder.glob("**/velodyne_points") if path.is_dir())
    if len(found) == 1:
        return found[0]
    cause = f"contains {len(found)} drives" if found else "contains no KITTI raw drive (no folder velodyne_points)"
    raise InputError(folder, cause, "Give one folder ..._sync of the synced and rectified data")


def select_frames(sweeps: dict[int, Path], frames: tuple[int, int] | None, drive: Path) -> dict[int, Path]:
    """Sweeps with frame numbers in `frames` (first and last); None: all.

    Raises:
        SettingError: no sweep is in the range.
    """
    if frames is None:
        return sweeps
    selected = {k: v for k, v in sweeps.items() if frames[0] <= k <= frames[1]}
    if not selected:
        raise SettingError("frames", f"no sweep of {drive} is in {frames[0]}..{frames[1]}", "Widen the range")
    return selected


def files_by_frame(folder: Path, suffixes: str | tuple[str, ...]) -> dict[int, Path]:
    """Files by frame number, ascending."""
    found = sorted(p for p in folder.glob("*") if p.name.lower().endswith(suffixes) and p.stem.isdigit())
    if not found:
        kind = suffixes if isinstance(suffixes, str) else " or ".join(suffixes)
        raise InputError(folder, f"contains no numbered {kind} files", "Unpack the drive's synced data here")
    return {int(path.stem): path for path in found}


def calibration_files(drive: Path) -> dict[str, Path]:
    """The calibration files of a drive that exist, in its folder or the parent folder, by name."""
    names = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
    return {name: path for name in names if (path := _calibration_file(drive, name)).is_file()}


def _calibration_file(drive: Path, name: str) -> Path:
    return next((f / name for f in (drive, drive.parent) if (f / name).is_file()), drive.parent / name)


def calibration_entry(drive: Path, name: str, key: str, size: int) -> F64:
    """The `size` numbers after `key:` in a calibration file of the drive or its parent folder.

    Raises:
        InputError: the file is missing, or has no such entry.
    """
    remedy = "Unpack the calibration of the drive's day beside the drive"
    return read_entry(_calibration_file(drive, name), key, size, remedy)


def _rigid(drive: Path, name: str) -> F64:
    T = np.eye(4)
    T[:3, :3] = calibration_entry(drive, name, "R", 9).reshape(3, 3)
    T[:3, 3] = calibration_entry(drive, name, "T", 3)
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3:
        raise InputError(drive.parent / name, "its `R` is not a rotation matrix", "Unpack the calibration again")
    return T


def _rig(drive: Path, folder: str) -> Rig:
    """The camera of a photo folder: `pixel ~ P_rect . R_rect_00 . T_cam0_velo . X`."""
    n, file = folder.removeprefix("image_"), "calib_cam_to_cam.txt"
    P = calibration_entry(drive, file, f"P_rect_{n}", 12).reshape(3, 4)
    width, height = calibration_entry(drive, file, f"S_rect_{n}", 2).astype(int).tolist()
    rectify = np.eye(4)
    rectify[:3, :3] = calibration_entry(drive, file, "R_rect_00", 9).reshape(3, 3)
    return rectified_rig(P, rectify @ _rigid(drive, "calib_velo_to_cam.txt"), width, height)


def rectified_rig(P: F64, T_cam0_velo: F64, width: int, height: int) -> Rig:
    """A rectified camera, from KITTI's projection (3, 4) from rectified camera 0 and the extrinsics of the scanner."""
    K = P[:, :3]
    shift = np.eye(4)
    shift[:3, 3] = np.linalg.solve(K, P[:, 3])  # from rectified camera 0 to this camera
    T_cam_velo = shift @ T_cam0_velo
    T_cam_velo[:3, :3] = nearest_rotation(T_cam_velo[:3, :3])  # the files have only seven digits
    T_velo_cam = np.linalg.inv(T_cam_velo).astype(np.float64)
    return Rig(Camera("pinhole", width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2]), T_velo_cam)


def _spans(drive: Path, numbers: list[int]) -> F64:
    """Start, middle (scanner points forward) and end (F, 3) of each sweep, seconds."""
    folder = drive / "velodyne_points"
    names = ("timestamps_start.txt", "timestamps.txt", "timestamps_end.txt")
    return np.stack([_times(folder / name, numbers) for name in names], axis=1)


def _times(path: Path, numbers: list[int]) -> F64:
    lines = file_checks.lines(path, "Unpack the drive's time stamps again")
    times = np.empty(len(numbers))
    for i, number in enumerate(numbers):
        line = lines[number].strip() if number < len(lines) else ""
        try:
            whole, _, fraction = line.partition(".")
            moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            times[i] = (moment - GPS_EPOCH).total_seconds() + float(f"0.{fraction or 0}")
        except ValueError:
            raise InputError(
                path, f"line {number + 1} is not a time stamp ({line!r})", "Unpack it again, or exclude that frame"
            ) from None
    return times


def _poses(drive: Path, poses: Path | None, numbers: list[int], times: F64) -> tuple[F64, str]:
    """Poses (F, 4, 4) scanner to CRS at each sweep's time stamp, and the CRS."""
    has_oxts = (drive / "oxts" / "data").is_dir()
    if poses is None and not has_oxts:
        raise InputError(drive / "oxts", "folder not found, and no pose file is given", "Unpack oxts, or give poses")
    crs = "local"
    first = np.eye(4)
    if has_oxts:
        needed = slice(None) if poses is None else slice(2)  # with poses, only the first sweep's, interpolated
        T_imu, crs = _read_oxts(drive, numbers[needed])
        stamps = _times(drive / "oxts" / "timestamps.txt", numbers[needed])
        T_world = interpolate(T_imu, stamps, times[needed]) @ np.linalg.inv(_rigid(drive, "calib_imu_to_velo.txt"))
        if poses is None:
            return T_world, crs
        first = T_world[0]
    assert poses is not None
    relative = read_poses(poses, numbers)
    return first @ np.linalg.inv(relative[0]) @ relative, crs


def read_poses(path: Path, numbers: list[int]) -> F64:
    """Poses (F, 4, 4) from the lines `numbers` of a file of row-major 3x4 matrices.

    Raises:
        InputError: not a pose file, or it has too few lines.
    """
    try:
        rows = np.loadtxt(file_checks.check(path), ndmin=2)
        if rows.shape[1] != 12 or not (np.abs(rows) < MAX_COORDINATE_M).all():
            raise ValueError(f"shape {rows.shape}, values up to {np.abs(rows).max(initial=0):g}")
    except ValueError as error:
        raise InputError(path, f"is not a pose file ({error})", "Write 12 numbers per line, row-major 3x4") from None
    if len(rows) <= numbers[-1]:
        raise InputError(
            path, f"has {len(rows)} poses, but sweep {numbers[-1]} is selected", "Give one line per frame, from 0 on"
        )
    T = np.tile(np.eye(4), (len(numbers), 1, 1))
    T[:, :3] = rows[numbers].reshape(-1, 3, 4)
    R = T[:, :3, :3]
    if np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() > 1e-2:
        raise InputError(
            path, "its left 3x3 parts are not rotation matrices", "Write 12 numbers per line, row-major 3x4"
        )
    return T


def _read_oxts(drive: Path, numbers: list[int]) -> tuple[F64, str]:
    """Poses (F, 4, 4) IMU to UTM, and the code of the zone; OXTS's roll, pitch, yaw refer to true east, north, up."""
    from pyproj import Proj, Transformer
    from scipy.spatial.transform import Rotation

    rows = np.empty((len(numbers), 6))
    for i, number in enumerate(numbers):
        path = drive / "oxts" / "data" / f"{number:010d}.txt"
        record = " ".join(file_checks.lines(path, "Unpack oxts again, or give poses")).split()
        try:
            rows[i] = np.array(record[:6], np.float64)
        except ValueError as error:
            raise InputError(path, f"is not an OXTS record ({error})", "Unpack oxts again, or give poses") from None
        if not np.isfinite(rows[i]).all() or abs(rows[i, 0]) > 84 or abs(rows[i, 1]) > 180:
            raise InputError(path, "has an invalid position", "Unpack oxts again, or give poses")
    lat, lon, alt, roll, pitch, yaw = rows.T
    crs = crs_io.utm(lat[0], lon[0])
    east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    yaw = yaw + np.radians(Proj(crs).get_factors(lon, lat).meridian_convergence)  # true north to grid north
    T = np.tile(np.eye(4), (len(numbers), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix()
    T[:, :3, 3] = np.stack([east, north, alt], axis=1)
    return T, crs


def point_times(sweep: Sweep, start: float, end: float, deskew: bool) -> F64:
    """(N,) seconds at which the points of a sweep were measured; without `deskew` all in its middle."""
    phase = scan_phase(sweep.xyz) if deskew else np.full(len(sweep.xyz), 0.5)
    return start + phase * (end - start)


def read_drive_sweep(
    path: Path, max_range: float, vertical_angle_offset: float = 0.0, labels: Path | None = None
) -> Sweep:
    """A sweep without returns from the car and beyond `max_range`; its beams raised by the offset, degrees.

    With the classes of its `labels`, if there are some.
    """
    xyz, reflectance = read_bin(path)
    low, high = np.array(EGO_VEHICLE_BOX, np.float32)
    # float32, unlike `read_sweep`: a reflectance of 0.3 or 0.9 is rounded to the level next to that of float64
    sweep = Sweep(
        raise_beams(xyz, vertical_angle_offset),
        np.round(reflectance * 65535).astype(np.uint16),
        classification=read_labels(labels, len(xyz)) if labels else None,
    )
    return sweep.take(~((xyz > low) & (xyz < high)).all(axis=1)).between(0.0, max_range)


def raise_beams(xyz: F32, offset_deg: float) -> F32:
    """Returns (N, 3) in the scanner's axes (z up) with their vertical angles raised by `offset_deg`, ranges unchanged.

    Corrects a constant error of the beams' vertical angles, for KITTI .205 degrees in Deschaud, "IMLS-SLAM:
    scan-to-model matching based on 3D data", ICRA 2018.
    """
    if not offset_deg:
        return xyz
    across = np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    cos, sin = np.cos(np.radians(offset_deg)), np.sin(np.radians(offset_deg))
    out = xyz.astype(np.float64)
    out[:, :2] *= np.divide(cos * across - sin * xyz[:, 2], across, out=np.ones_like(across), where=across > 0)[:, None]
    out[:, 2] = cos * xyz[:, 2] + sin * across
    return out.astype(np.float32)
