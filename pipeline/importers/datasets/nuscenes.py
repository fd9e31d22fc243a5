"""Reader of nuScenes (Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020).

A folder `v1.0-...` of JSON tables names the files of `samples/` (keyframes) and `sweeps/`: lidar sweeps of float32
x, y, z, intensity, ring (compensated for the vehicle's motion), and undistorted photos. Each file has a time
(microseconds) and a pose of the vehicle at that time, so photos keep their own pose. Quaternions are w, x, y, z.
Conventions: page schema_nuscenes of the nuScenes devkit.

Poses are in the map of the log's location. They are planar: z is 0, whatever the slope. The origins of the maps are
those of the devkit (script export_poses), as are x east, y north and the spherical earth.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F64, Camera, Frame
from scan2sim.pipeline.importers.datasets import recording
from scan2sim.pipeline.importers.datasets.recording import AUTO, US, DatasetParams, Recording
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.rig import RigCamera
from scan2sim.pipeline.io.sweep_files import Sweep

TABLES = ("scene", "log", "sensor", "calibrated_sensor", "sample", "sample_data", "ego_pose")
ORIGINS = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}
"""Latitude and longitude of the south-western corner of each location's map, degrees."""
EARTH_RADIUS_M = 6_378_137.0
VEHICLE_BOX = (-1.0, -1.7, -2.0, 1.0, 2.6, 0.3)
"""The recording car (Renault Zoe, 4.1 m x 1.8 m) in the axes of LIDAR_TOP: x right, y ahead, z up; metres."""
CHUNK = 1 << 24
MAX_RECORD = 1 << 22
"""Characters that are read of a table at once, and the longest record."""
SHOWN = 20
"""Number of scenes that a message lists."""
UNPACK = "Unpack the metadata again: all tables must be of one version"
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class NuScenesParams(DatasetParams):
    """What is imported of nuScenes: `scene`, by name or token; default: the only one."""

    scene: str | None = Field(
        None, description="Name (or token) of the scene, such as scene-0061; default: the only one."
    )


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    token: str


class _Scene(_Row):
    name: str
    log_token: str


class _Log(_Row):
    location: str


class _Sensor(_Row):
    channel: str
    modality: str


class _Calibration(_Row):
    sensor_token: str
    translation: Vector
    rotation: Quaternion
    camera_intrinsic: list[Vector]


class _Pose(_Row):
    translation: Vector
    rotation: Quaternion


class _Data(_Row):
    ego_pose_token: str
    calibrated_sensor_token: str
    filename: str
    timestamp: Annotated[int, Field(gt=0, lt=2**52)]
    is_key_frame: bool
    width: int = 0
    height: int = 0


class _File(NamedTuple):
    """A sweep or photo: time (ns), file, and the record of it."""

    time: int
    path: Path
    data: _Data


@dataclass(frozen=True)
class Found:
    """A scene in its tables.

    Attributes:
        tables: folder of the tables.
        name, token: of the scene.
        location: place whose map the poses are in.
    """

    tables: Path
    name: str
    token: str
    location: str

    @property
    def root(self) -> Path:
        """Folder that file names are relative to."""
        return self.tables.parent

    def crs(self, wanted: str) -> str:
        """CRS of the world: `DatasetParams.crs`, resolved.

        Raises:
            InputError: it isn't a projected CRS, or the location has no known origin.
        """
        origin = ORIGINS.get(self.location)
        if wanted == crs_io.LOCAL or (wanted == AUTO and origin is None):
            return crs_io.LOCAL
        if origin is None:
            cause = f"the origin of the map {self.location!r} isn't known"
            raise InputError(self._table("log"), cause, "Use --crs local")
        return recording.frame_at(self._table("log"), wanted, *origin, 0.0).crs

    def files(self) -> dict[str, Path]:
        """The tables by name."""
        return {name: self._table(name) for name in TABLES}

    def _table(self, name: str) -> Path:
        return self.tables / f"{name}.json"


def find_scene(folder: Path, scene: str | None) -> Found:
    """A scene, by name or token; None: the only one.

    Args:
        folder: folder that contains `v1.0-mini`, `v1.0-trainval` or `v1.0-test`, or one of these.
        scene: the scene.

    Raises:
        InputError: there are no tables, or one is damaged.
        SettingError: there is no such scene; lists those that there are.
    """
    if not folder.is_dir():
        raise InputError(folder, "folder not found", file_checks.CHECK_PATH)
    tables = [folder] if (folder / "scene.json").is_file() else sorted(p.parent for p in folder.glob("*/scene.json"))
    if not tables:
        remedy = "Give the folder that contains samples, sweeps and v1.0-mini (or v1.0-trainval, v1.0-test)"
        raise InputError(folder, "contains no nuScenes tables (v1.0-.../scene.json)", remedy)
    found = {(one, row.token): row for one in tables for row in _read(one / "scene.json", _Scene)}
    chosen = [key for key, row in found.items() if scene in (row.name, row.token)] if scene else list(found)
    if len(chosen) != 1:
        names = sorted({row.name for row in found.values()})
        listed = ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")
        if chosen and scene:
            remedy = f"Give one of the folders {', '.join(sorted({one.name for one, _ in chosen}))}"
            raise SettingError("--scene", f"{scene!r} is in {len(chosen)} versions", remedy)
        cause = f"there is no scene {scene!r} in {folder}" if scene else f"{folder} has {len(names)} scenes"
        raise SettingError("--scene", cause, f"Give one of them: {listed}" if names else UNPACK)
    row, folder = found[chosen[0]], chosen[0][0]
    logs = {log.token: log for log in _read(folder / "log.json", _Log)}
    return Found(folder, row.name, row.token, _linked(logs, row, "log_token", folder / "scene.json").location)


def read_scene(found: Found, params: NuScenesParams) -> Recording:
    """The drive of a scene; `params.crs` as `Found.crs` returns it.

    Raises:
        InputError: a table is damaged, a record that another one refers to is missing, or no sweep's file exists.
        SettingError: a camera doesn't exist.
    """
    sensors = {row.token: row for row in _read(found._table("sensor"), _Sensor)}
    calibrations = {row.token: row for row in _read(found._table("calibrated_sensor"), _Calibration)}
    samples = {row["token"] for row in _rows(found._table("sample")) if row.get("scene_token") == found.token}
    channels, modalities = dict[str, list[_Data]](), dict[str, str]()
    for data in _read(found._table("sample_data"), _Data, "sample_token", samples):
        calibration = _linked(calibrations, data, "calibrated_sensor_token", found._table("sample_data"))
        sensor = _linked(sensors, calibration, "sensor_token", found._table("calibrated_sensor"))
        channels.setdefault(sensor.channel, []).append(data)
        modalities[sensor.channel] = sensor.modality
    lidars, cameras = (sorted(n for n in channels if modalities[n] == kind) for kind in ("lidar", "camera"))
    if not lidars:
        raise InputError(found._table("sample_data"), f"has no lidar sweep of {found.name}", UNPACK)
    warnings = list[str]()
    files = dict[str, list[_File]]()
    for name in (lidars[0], *params.chosen(cameras, found.root)):
        files[name] = _present(found, name, channels[name], warnings)
        if name != lidars[0]:
            files[name] = [files[name][i] for i in params.thinned(one.time for one in files[name])]
    sweeps = files.pop(lidars[0])
    if not sweeps:
        raise InputError(
            found.root, f"none of the {len(channels[lidars[0]])} sweeps of {found.name} exist",
            "Unpack the parts (blobs) of the data set that contain this scene",
        )  # fmt: skip
    used = [one.data for part in (sweeps, *files.values()) for one in part]
    needed = {data.ego_pose_token for data in used}
    poses = {row.token: row for row in _read(found._table("ego_pose"), _Pose, "token", needed)}
    T_ego_scanner = _mounting(found, {one.data.calibrated_sensor_token for one in sweeps}, calibrations, lidars[0])

    def scanner(part: list[_File]) -> F64:
        """Poses (N, 4, 4) of the scanner on the map, when files were recorded."""
        ego = [_linked(poses, one.data, "ego_pose_token", found._table("sample_data")) for one in part]
        return np.array([_pose(row, found._table("ego_pose")) for row in ego]) @ T_ego_scanner

    rig, photos = list[RigCamera](), dict[str, list[tuple[int, Path]]]()
    for name, part in files.items():
        if part:
            tokens = {one.data.calibrated_sensor_token for one in part}
            T_ego_camera = _mounting(found, tokens, calibrations, name)
            camera = _camera(found, calibrations[part[0].data.calibrated_sensor_token], part[0].data)
            rig.append(RigCamera(name, camera, np.linalg.inv(T_ego_camera) @ T_ego_scanner))
            photos[name] = [(one.time, one.path) for one in part]
    times, T = recording.joined_path(
        ([one.time for one in part], scanner(part)) for part in (sweeps, *files.values()) if part
    )
    heights = np.array([poses[data.ego_pose_token].translation[2] for data in used])
    notes = (found.location, *(["poses are planar (all heights are 0)"] if not heights.any() else []))
    first = T[0, :3, 3] * [1, 1, 0]
    frame, yaw = Frame(), 0.0
    if params.crs == crs_io.LOCAL:
        first = np.zeros(3)
    else:
        frame = recording.frame_at(found._table("log"), params.crs, *geographic(found.location, first), 0.0)
        yaw = crs_io.convergence(frame)
    return Recording(
        found.name, [(one.time, one.path) for one in sweeps], rig, photos, frame,
        recording.placed(T, times, frame, yaw, first), notes, tuple(warnings),
    )  # fmt: skip


def read_sweep(path: Path, _: int = 0) -> Sweep:
    """A sweep in scanner axes, without invalid points; the time, which the file doesn't need, is ignored.

    Raises:
        InputError: not a nuScenes sweep.
    """
    data = np.fromfile(file_checks.check(path), "<f4")
    if path.stat().st_size % 20 or not data.size:
        cause = f"is not a nuScenes sweep: {path.stat().st_size} bytes, not a multiple of 20 (x, y, z, intensity, ring)"
        raise InputError(path, cause, "Copy or unpack it again")
    rows = data.reshape(-1, 5)
    rows = rows[np.isfinite(rows[:, :4]).all(axis=1)]
    return Sweep(rows[:, :3].astype(np.float32), recording.intensities(rows[:, 3].astype(np.float64)))


def geographic(location: str, xyz: F64) -> tuple[float, float]:
    """Latitude and longitude (degrees) of a position (3,) on a location's map, on the sphere that the devkit uses."""
    lat, lon = np.radians(ORIGINS[location])
    angle, bearing = float(np.hypot(xyz[0], xyz[1])) / EARTH_RADIUS_M, float(np.arctan2(xyz[0], xyz[1]))
    to_lat = np.arcsin(np.sin(lat) * np.cos(angle) + np.cos(lat) * np.sin(angle) * np.cos(bearing))
    east = np.arctan2(np.sin(bearing) * np.sin(angle) * np.cos(lat), np.cos(angle) - np.sin(lat) * np.sin(to_lat))
    return float(np.degrees(to_lat)), float(np.degrees(lon + east))


def _present(found: Found, channel: str, rows: list[_Data], warnings: list[str]) -> list[_File]:
    """Files of a sensor that exist, by time."""
    files = list[_File]()
    for data in rows:
        name = Path(data.filename)
        if name.is_absolute() or ".." in name.parts:
            cause = f"record {data.token!r}: the file name {data.filename!r} leaves the data set"
            raise InputError(found._table("sample_data"), cause, UNPACK)
        files.append(_File(data.timestamp * US, found.root / name, data))
    present = {one.time: one for one in files if one.path.is_file()}
    if len(present) < len(rows):
        missing = f"{len(rows) - len(present)} of {len(rows)} files of {channel} are missing"
        kept = ", and only keyframes are left" if present and all(f.data.is_key_frame for f in present.values()) else ""
        warnings.append(f"{missing}{kept}: unpack all parts of the data set that contain {found.name}")
    return [present[time] for time in sorted(present)]


def _mounting(found: Found, tokens: set[str], calibrations: dict[str, _Calibration], channel: str) -> F64:
    """T_ego_sensor (4, 4) of a sensor."""
    if len(tokens) > 1:
        cause = f"{channel} has {len(tokens)} calibrations in {found.name}"
        raise InputError(found._table("sample_data"), cause, UNPACK)
    return _pose(calibrations[next(iter(tokens))], found._table("calibrated_sensor"))


def _pose(row: _Pose | _Calibration, table: Path) -> F64:
    try:
        return recording.pose(row.translation, row.rotation)
    except ValueError as error:
        raise InputError(table, f"record {row.token!r} {error}", UNPACK) from None


def _camera(found: Found, calibration: _Calibration, data: _Data) -> Camera:
    K = np.array(calibration.camera_intrinsic)
    if K.shape != (3, 3) or K[0, 0] <= 0 or K[1, 1] <= 0:
        cause = f"record {calibration.token!r} has no camera_intrinsic (3x3)"
        raise InputError(found._table("calibrated_sensor"), cause, UNPACK)
    if data.width < 1 or data.height < 1:
        raise InputError(found._table("sample_data"), f"record {data.token!r} has no width and height", UNPACK)
    return Camera("pinhole", data.width, data.height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def _linked(rows: dict[str, Any], row: Any, field: str, table: Path) -> Any:
    """The record that a field refers to."""
    token = getattr(row, field)
    if token not in rows:
        raise InputError(table, f"record {row.token!r}: there is no record for its {field} {token!r}", UNPACK)
    return rows[token]


def _read(table: Path, kind: type[Any], field: str = "", values: set[str] | None = None) -> Iterator[Any]:
    """Validated records; with `field`, those where it is one of `values`."""
    adapter = TypeAdapter(kind)
    for row in _rows(table):
        if values is None or str(row.get(field)) in values:
            yield recording.validated(adapter, row, table, UNPACK)


def _rows(table: Path) -> Iterator[dict[str, Any]]:
    """Records of a table, read piece by piece: those of the whole data set have a gigabyte.

    Raises:
        InputError: missing, or not a list of records.
    """
    decode, separator = json.JSONDecoder().raw_decode, re.compile(r"[\s,]*")
    file_checks.check(table, UNPACK)
    try:
        with table.open(encoding="utf-8") as file:
            text = file.read(CHUNK).lstrip()
            if not text.startswith("["):
                raise ValueError("no list")
            at = 1
            while True:
                at = separator.match(text, at).end()  # type: ignore[union-attr]
                if text[at : at + 1] == "]":
                    return
                try:
                    row, at = decode(text, at)
                except json.JSONDecodeError as error:
                    more = file.read(CHUNK) if len(text) - at < MAX_RECORD + CHUNK else ""
                    if not more:
                        raise ValueError(f"it ends within a record, or one is damaged: {error.msg}") from None
                    text, at = text[at:] + more, 0
                    continue
                if not isinstance(row, dict) or not isinstance(row.get("token"), str):
                    raise ValueError("a record has no token")
                yield row
    except (ValueError, RecursionError) as error:
        raise InputError(table, f"is not a nuScenes table ({error})", UNPACK) from None
