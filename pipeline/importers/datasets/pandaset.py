"""Reader of PandaSet (Xiao et al., "PandaSet: Advanced Sensor Suite Dataset for Autonomous Driving", ITSC 2021).

A sequence is a folder with `lidar/NN.pkl.gz` (pandas tables of x, y, z in world coordinates, intensity 0 to 255, time,
and sensor: 0 Pandar64, 1 PandarGT; compensated for the vehicle's motion), `camera/NAME/NN.jpg` with `intrinsics.json`
(fx, fy, cx, cy), and `poses.json` (sensor to world: position, and heading as quaternion w, x, y, z) and
`timestamps.json` (seconds) of each sensor. `meta/gps.json` has a position for each sweep. Conventions: README and
python/pandaset of the PandaSet devkit.

A camera's mounting isn't published with a sequence: it is the mean of its poses relative to the scanner's path. Each
photo nevertheless keeps its own pose, which becomes one of the path.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.types import F64, Camera, Frame
from scan2sim.pipeline.importers.datasets import recording
from scan2sim.pipeline.importers.datasets.recording import AUTO, DatasetParams, Recording
from scan2sim.pipeline.importers.georeference import MAX_ANGLE_SIGMA_RAD
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images.image import size_of
from scan2sim.pipeline.io.pandas_pickle import read_columns
from scan2sim.pipeline.io.rig import RigCamera
from scan2sim.pipeline.io.sweep_files import Sweep

TABLES = (".pkl.gz", ".pkl")
PHOTOS = (".jpg", ".jpeg", ".png")
MAX_GPS_RMS_M = 3.0
"""Distance between the path and its GPS positions above which they don't fit."""
MAX_MOUNTING_M, MAX_MOUNTING_RAD = 0.1, np.radians(1.0)
"""Typical deviation of a camera from a fixed mounting above which its poses or times are suspicious."""
SHOWN = 20
UNPACK = "Unpack the sequence again"


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class _Vector(_Entry):
    x: float
    y: float
    z: float


class _Heading(_Vector):
    w: float


class _Pose(_Entry):
    position: _Vector
    heading: _Heading


class _Intrinsics(_Entry):
    fx: Annotated[float, Field(gt=0)]
    fy: Annotated[float, Field(gt=0)]
    cx: float
    cy: float


class _Fix(_Entry):
    lat: Annotated[float, Field(ge=-84, le=84)]
    long: Annotated[float, Field(ge=-180, le=180)]
    height: float


_Seconds = Annotated[float, Field(ge=0, le=1e10, allow_inf_nan=False)]
_POSES, _TIMES, _FIXES = TypeAdapter(list[_Pose]), TypeAdapter(list[_Seconds]), TypeAdapter(list[_Fix])
_INTRINSICS = TypeAdapter(_Intrinsics)


@dataclass(frozen=True)
class _Sensor:
    """Files of a sensor by time: times (N,) in ns, ascending, paths, and poses (N, 4, 4) to the world."""

    times: list[int]
    files: list[Path]
    poses: F64

    @property
    def seconds(self) -> F64:
        return np.array(self.times) / 1e9


def find_sequence(folder: Path) -> Path:
    """The folder of a sequence: `folder`, or the only one in it.

    Raises:
        InputError: there is none, or several; lists them.
    """
    if not folder.is_dir():
        raise InputError(folder, "folder not found", file_checks.CHECK_PATH)
    if (folder / "lidar").is_dir():
        return folder
    found = sorted(path.parent for path in folder.glob("*/lidar") if path.is_dir())
    if len(found) == 1:
        return found[0]
    if found:
        listed = ", ".join(one.name for one in found[:SHOWN]) + (", ..." if len(found) > SHOWN else "")
        raise InputError(folder, f"contains {len(found)} sequences", f"Give the folder of one of them: {listed}")
    raise InputError(folder, "contains no PandaSet sequence (no folder lidar)", "Give the folder of a sequence")


def input_files(sequence: Path) -> dict[str, Path]:
    """The folders and files that `read_sequence` reads, by name."""
    cameras = {f"camera.{path.name}": path for path in sorted((sequence / "camera").glob("*")) if path.is_dir()}
    gps = sequence / "meta" / "gps.json"
    return {"lidar": sequence / "lidar", **cameras, **({"gps": gps} if gps.is_file() else {})}


def read_sequence(sequence: Path, params: DatasetParams) -> Recording:
    """The drive of a sequence, with `params.crs` "auto" georeferenced by its GPS if that determines the heading.

    Raises:
        InputError: a file is missing or damaged. SettingError: a camera doesn't exist.
        DataError: a CRS is given, but the GPS doesn't determine the position.
    """
    lidar = _sensor(sequence / "lidar", TABLES)
    folders = {path.name: path for path in sorted((sequence / "camera").glob("*")) if path.is_dir()}
    warnings, rig, photos = list[str](), list[RigCamera](), dict[str, list[tuple[int, Path]]]()
    parts = [(lidar.times, lidar.poses)]
    for name in params.chosen(list(folders), sequence):
        album = _sensor(folders[name], PHOTOS)
        intrinsics = recording.read_json(folders[name] / "intrinsics.json", _INTRINSICS, UNPACK)
        kept = params.thinned(album.times)
        T_camera_scanner, shift, turn = _mounting(album, lidar)
        if shift > MAX_MOUNTING_M or turn > MAX_MOUNTING_RAD:
            warnings.append(
                f"poses of {name} deviate from a fixed mounting by {shift:.2f} m and {np.degrees(turn):.1f} degrees: "
                "its poses or times don't fit those of the lidar"
            )
        camera = Camera("pinhole", *size_of(album.files[0]), intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
        rig.append(RigCamera(name, camera, T_camera_scanner))
        photos[name] = [(album.times[i], album.files[i]) for i in kept]
        parts.append(([album.times[i] for i in kept], album.poses[kept] @ T_camera_scanner))
    times, T = recording.joined_path(parts)
    frame, yaw, anchor, note = Frame(), 0.0, np.zeros(3), ""
    if params.crs != crs_io.LOCAL:
        try:
            frame, yaw, anchor, note = _georeference(sequence, lidar, params.crs)
        except DataError as error:
            if params.crs != AUTO:
                raise
            warnings.append(f"the world stays local, in the sequence's own coordinates: {error.cause}")
    return Recording(
        sequence.resolve().name, list(zip(lidar.times, lidar.files, strict=True)), rig, photos, frame,
        recording.placed(T, times, frame, yaw, anchor), (note,) if note else (), tuple(warnings),
    )  # fmt: skip


def sweep_reader(sequence: Path) -> SweepReader:
    """A function that reads sweeps of a sequence in scanner axes.

    Raises:
        InputError: a file is missing or damaged.
    """
    lidar = _sensor(sequence / "lidar", TABLES)
    return SweepReader(dict(zip(lidar.times, lidar.poses, strict=True)))


@dataclass(frozen=True)
class SweepReader:
    """Reads sweeps in scanner axes, which are stored in world coordinates; `poses` (4, 4) of the scanner by time."""

    poses: dict[int, F64]

    def __call__(self, path: Path, time_ns: int) -> Sweep:
        """The sweep of a time in nanoseconds, without invalid points.

        Raises:
            InputError: the file is damaged, or could run code.
        """
        columns = read_columns(path, ("x", "y", "z", "i"))
        world = np.stack([columns[axis] for axis in "xyz"], axis=1)
        valid = np.isfinite(world).all(axis=1)
        T = self.poses[time_ns]
        xyz = (world[valid] - T[:3, 3]) @ T[:3, :3]
        return Sweep(xyz.astype(np.float32), recording.intensities(columns["i"][valid]))


def _sensor(folder: Path, suffixes: tuple[str, ...]) -> _Sensor:
    """Files, times and poses of a sensor."""
    files = _numbered(folder, suffixes)
    seconds = recording.read_json(folder / "timestamps.json", _TIMES, UNPACK)
    entries = recording.read_json(folder / "poses.json", _POSES, UNPACK)
    for path, count in ((folder / "timestamps.json", len(seconds)), (folder / "poses.json", len(entries))):
        if count <= max(files):
            raise InputError(path, f"has {count} entries, but file {max(files)} exists", UNPACK)
    times = [round(seconds[i] * 1e6) * 1000 for i in files]
    if (np.diff(times) <= 0).any():
        raise InputError(folder / "timestamps.json", "its times are not ascending", UNPACK)
    poses = np.empty((len(files), 4, 4))
    for k, i in enumerate(files):
        p, q = entries[i].position, entries[i].heading
        try:
            poses[k] = recording.pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z))
        except ValueError as error:
            raise InputError(folder / "poses.json", f"entry {i} {error}", UNPACK) from None
    return _Sensor(times, list(files.values()), poses)


def _numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Files by number, ascending."""
    found = {
        int(path.name.split(".")[0]): path
        for path in sorted(folder.glob("*"))
        if path.name.lower().endswith(suffixes) and path.name.split(".")[0].isdigit()
    }
    if not found:
        raise InputError(folder, f"contains no numbered {' or '.join(suffixes)} files", UNPACK)
    return dict(sorted(found.items()))


def _mounting(album: _Sensor, lidar: _Sensor) -> tuple[F64, float, float]:
    """T_camera_scanner (4, 4) of a camera, and the typical deviation of its poses from it, metres and radians."""
    from scipy.spatial.transform import Rotation

    at = album.seconds
    within = np.flatnonzero((at >= lidar.seconds[0]) & (at <= lidar.seconds[-1]))
    some = within if len(within) else np.arange(len(at))
    scanner = interpolate(lidar.poses, lidar.seconds, at[some])
    relative = np.linalg.inv(album.poses[some]) @ scanner
    turns, T = Rotation.from_matrix(relative[:, :3, :3]), np.eye(4)
    mean = turns.mean()
    T[:3, :3], T[:3, 3] = mean.as_matrix(), np.median(relative[:, :3, 3], axis=0)
    shift = np.linalg.norm(relative[:, :3, 3] - T[:3, 3], axis=1)
    return T, float(np.median(shift)), float(np.median((mean.inv() * turns).magnitude()))


def _georeference(sequence: Path, lidar: _Sensor, crs: str) -> tuple[Frame, float, F64, str]:
    """Frame, rotation (radians) and anchor (3,) of the sequence's coordinates in a CRS, and a text about the fit.

    Heights are those of the GPS.

    Raises:
        DataError: the GPS doesn't determine them.
    """
    from pyproj import Transformer

    path = sequence / "meta" / "gps.json"
    if not path.is_file():
        raise DataError(path, "there is no meta/gps.json", "Use --crs local")
    fixes = recording.read_json(path, _FIXES, UNPACK)
    if len(fixes) != len(lidar.times):
        raise DataError(path, f"it has {len(fixes)} GPS positions for {len(lidar.times)} sweeps", "Use --crs local")
    lat, lon, height = np.array([(fix.lat, fix.long, fix.height) for fix in fixes]).T
    frame = recording.frame_at(path, crs, float(np.median(lat)), float(np.median(lon)), 0.0)
    to_crs = Transformer.from_crs("EPSG:4326", frame.crs, always_xy=True)
    target = np.column_stack(to_crs.transform(lon, lat)) * frame.unit
    source = lidar.poses[:, :3, 3]
    use = np.ones(len(source), bool)
    for _ in range(5):
        a, b = source[use, :2] - source[use, :2].mean(axis=0), target[use] - target[use].mean(axis=0)
        yaw = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        offset = target - source[:, :2] @ turn.T
        error = np.linalg.norm(offset - offset[use].mean(axis=0), axis=1)
        use = error <= max(3 * float(np.median(error)), 1e-3)
    rms, extent = float(np.sqrt((error[use] ** 2).mean())), float(np.sqrt((a**2).sum(axis=1).mean()))
    if rms > MAX_GPS_RMS_M or np.arctan2(rms, extent) > MAX_ANGLE_SIGMA_RAD:
        cause = f"GPS with an error of {rms:.1f} m doesn't determine the heading of a path of {2 * extent:.0f} m"
        raise DataError(path, cause, "Use --crs local")
    x, y = offset[use].mean(axis=0)
    origin = (float(x), float(y), float(np.median(height - source[:, 2])))
    return (
        Frame(frame.crs, origin, frame.unit), yaw, np.zeros(3),
        f"georeferenced by GPS, rms {rms:.2f} m, in {crs_io.name(frame.crs)}",
    )  # fmt: skip
