"""A small drive with ground truth, written in the layouts of nuScenes and PandaSet."""

from __future__ import annotations

import gzip
import io
import json
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64, Camera

START = 1_532_402_927.6
PLACE = np.array([411.3, 1180.9, 0.0])  # of the drive on the map
CAMERA = Camera("pinhole", 64, 48, 40.0, 41.0, 31.0, 23.0)
COLOURS = {"CAM_FRONT": (250, 20, 20), "CAM_BACK": (20, 20, 250)}


def rigid(turn: Rotation, shift: Sequence[float]) -> F64:
    """Transform (4, 4) of a rotation and a shift."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), shift
    return T


AHEAD = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # camera to vehicle axes
T_EGO_LIDAR = rigid(Rotation.from_euler("z", -90, degrees=True), [0.94, 0.0, 1.84])
T_EGO_CAMERA = {
    "CAM_FRONT": rigid(Rotation.from_rotvec([0.01, 0.02, 0]) * AHEAD, [1.7, 0.0, 1.5]),
    "CAM_BACK": rigid(Rotation.from_euler("z", 180, degrees=True) * AHEAD, [0.0, 0.1, 1.6]),
}


@dataclass
class Drive:
    """A drive past random points.

    Attributes:
        sweeps: number of sweeps, 20 per second.
        world: (N, 3) points on the map, seen by all sweeps.
    """

    sweeps: int = 8
    world: F64 = field(
        default_factory=lambda: PLACE + np.random.default_rng(0).uniform((-25, -25, 0), (25, 25, 6), (200, 3))
    )

    @property
    def times(self) -> F64:
        """Times of the sweeps, whole microseconds."""
        return np.asarray(START + 0.05 * np.arange(self.sweeps), np.float64)

    def photo_times(self, camera: str) -> F64:
        """Times of the photos of a camera, 12 per second: not those of the sweeps."""
        late = 0.003 if camera == "CAM_FRONT" else 0.017
        return START + late + np.arange(0, 0.05 * self.sweeps - 0.03, 0.083)

    def ego(self, time: float) -> F64:
        """Pose (4, 4) of the vehicle on the map: a curve, faster and faster."""
        s = time - START
        return rigid(Rotation.from_euler("z", 0.3 + 0.1 * s), (PLACE + [8 * s + s * s, 0.7 * s * s, 0]).tolist())

    def scanner(self, time: float) -> F64:
        """Pose (4, 4) of the lidar on the map."""
        return self.ego(time) @ T_EGO_LIDAR

    def sweep(self, time: float) -> F64:
        """Points (N, 3) in axes of the lidar."""
        T = self.scanner(time)
        return (self.world - T[:3, 3]) @ T[:3, :3]


def photo(camera: str) -> bytes:
    """A photo of one colour."""
    image = np.full((CAMERA.height, CAMERA.width, 3), COLOURS[camera][::-1], np.uint8)
    return bytes(cv2.imencode(".jpg", image)[1])


def us(time: float) -> int:
    """Microseconds."""
    return round(time * 1e6)


def write_nuscenes(
    folder: Path,
    drive: Drive,
    *,
    scene: str = "scene-0061",
    location: str = "singapore-onenorth",
    version: str = "v1.0-mini",
) -> Path:
    """Write a scene, beside another one without files, and return the folder."""
    tables = folder / version
    tables.mkdir(parents=True)
    rows = {
        name: list[dict[str, Any]]() for name in ("sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")
    }
    mounted = {"LIDAR_TOP": T_EGO_LIDAR, **T_EGO_CAMERA, "RADAR_FRONT": np.eye(4)}
    K = [[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]]
    for name, T in mounted.items():
        kind = {"LIDAR": "lidar", "CAM": "camera", "RADAR": "radar"}[name.split("_")[0]]
        rows["sensor"].append({"token": f"sensor {name}", "channel": name, "modality": kind})
        rows["calibrated_sensor"].append(
            {
                "token": f"calibration {name}", "sensor_token": f"sensor {name}", **_pose(T),
                "camera_intrinsic": K if kind == "camera" else [],
            }
        )  # fmt: skip
    for own in ("another", scene):
        for name in mounted:
            times = drive.times if name in ("LIDAR_TOP", "RADAR_FRONT") else drive.photo_times(name)
            for k, time in enumerate(times.tolist()):
                key, token = k % 4 == 0, f"{own} {name} {k}"
                file = f"{'samples' if key else 'sweeps'}/{name}/{own}__{name}__{us(time)}"
                file += {"C": ".jpg", "L": ".pcd.bin", "R": ".pcd"}[name[0]]
                rows["ego_pose"].append({"token": f"pose {token}", "timestamp": us(time), **_pose(drive.ego(time))})
                rows["sample_data"].append(
                    {
                        "token": token, "sample_token": f"sample {own} {k // 4}", "ego_pose_token": f"pose {token}",
                        "calibrated_sensor_token": f"calibration {name}", "timestamp": us(time),
                        "fileformat": file.rsplit(".", 1)[-1], "is_key_frame": key, "filename": file, "prev": "",
                        "next": "", "width": CAMERA.width if name[0] == "C" else 0,
                        "height": CAMERA.height if name[0] == "C" else 0,
                    }
                )  # fmt: skip
                if own == scene:
                    path = folder / file
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(photo(name) if name[0] == "C" else _bin(drive.sweep(time)))
        for k in range((drive.sweeps + 3) // 4):
            rows["sample"].append({"token": f"sample {own} {k}", "timestamp": 0, "scene_token": f"token {own}"})
    scenes = [
        {"token": f"token {own}", "name": own, "log_token": "log", "description": ""} for own in ("another", scene)
    ]
    logs = [{"token": "log", "logfile": "n015", "vehicle": "n015", "date_captured": "2018-07-24", "location": location}]
    for table, content in {**rows, "scene": scenes, "log": logs}.items():
        (tables / f"{table}.json").write_text(json.dumps(content, indent=0), encoding="utf-8")
    return folder


def _pose(T: F64) -> dict[str, Any]:
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    return {"translation": T[:3, 3].tolist(), "rotation": quaternion.tolist()}


def _bin(xyz: F64) -> bytes:
    rows = np.column_stack([xyz, np.full(len(xyz), 51), np.arange(len(xyz)) % 32])
    return rows.astype("<f4").tobytes()


NAMES = {"CAM_FRONT": "front_camera", "CAM_BACK": "back_camera"}
"""Cameras of PandaSet."""


def write_pandaset(folder: Path, drive: Drive, gps: F64 | None = None) -> Path:
    """Write a sequence and return its folder; `gps`: (N, 3) latitudes, longitudes (degrees), heights of the sweeps."""
    (folder / "lidar").mkdir(parents=True)
    sensors = {"lidar": (drive.times, [drive.scanner(t) for t in drive.times])}
    for camera, name in NAMES.items():
        place, times = folder / "camera" / name, drive.photo_times(camera)
        place.mkdir(parents=True)
        sensors[f"camera/{name}"] = (times, [drive.ego(t) @ T_EGO_CAMERA[camera] for t in times])
        for k in range(len(times)):
            (place / f"{k:02d}.jpg").write_bytes(photo(camera))
        lens = {"fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}
        (place / "intrinsics.json").write_text(json.dumps(lens), encoding="utf-8")
    for k, time in enumerate(drive.times):
        columns = {axis: drive.world[:, i] for i, axis in enumerate("xyz")}
        columns |= {"i": np.full(len(drive.world), 51.0), "t": np.full(len(drive.world), time)}
        (folder / "lidar" / f"{k:02d}.pkl.gz").write_bytes(gzip.compress(pickled_table(columns)))
    for name, (times, poses) in sensors.items():
        entries = [
            {
                "position": dict(zip("xyz", one["translation"], strict=True)),
                "heading": dict(zip("wxyz", one["rotation"], strict=True)),
            }
            for one in map(_pose, poses)
        ]
        (folder / name / "poses.json").write_text(json.dumps(entries), encoding="utf-8")
        (folder / name / "timestamps.json").write_text(json.dumps(times.tolist()), encoding="utf-8")
    if gps is not None:
        (folder / "meta").mkdir()
        fixes = [{"lat": a, "long": b, "height": c, "xvel": 0.0, "yvel": 0.0} for a, b, c in gps.tolist()]
        (folder / "meta" / "gps.json").write_text(json.dumps(fixes), encoding="utf-8")
    return folder


class _Global:
    """A name in a module that needn't exist."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name

    def __call__(self) -> None:
        raise AssertionError("only its name is pickled")


@dataclass
class _Made:
    """An object that is made by a call of a global, and by its state."""

    function: _Global
    arguments: tuple[Any, ...]
    state: Any = None


class _Pickler(vars(pickle)["_Pickler"]):  # type: ignore[misc]  # in Python, so that names can be written
    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, _Global):
            return obj.name
        if isinstance(obj, _Made):
            return obj.function, obj.arguments, obj.state
        return NotImplemented

    def save_global(self, obj: Any, name: str | None = None) -> None:
        if isinstance(obj, _Global):
            self.write(pickle.GLOBAL + f"{obj.module}\n{obj.name}\n".encode())
            self.memoize(obj)
        else:
            super().save_global(obj, name)


def pickled_table(columns: dict[str, F64]) -> bytes:
    """A table of floats, and a column `d` of integers, as pandas 1.0 pickled it when the data set was published."""
    names, rows = [*columns, "d"], len(next(iter(columns.values())))

    def index(kind: str, data: Any) -> _Made:
        cls = _Global("pandas.core.indexes.numeric" if kind == "Int64Index" else "pandas.core.indexes.base", kind)
        return _Made(_Global("pandas.core.indexes.base", "_new_Index"), (cls, {"data": data, "name": None}))

    axes = [index("Index", np.array(names, object)), index("Int64Index", np.arange(rows))]
    values = [np.stack(list(columns.values())), np.zeros((1, rows), np.int64)]
    places = [slice(0, len(columns), 1), slice(len(columns), len(names), 1)]
    blocks = [{"values": v, "mgr_locs": p} for v, p in zip(values, places, strict=True)]
    state = (axes, values, [axes[0], axes[0]], {"0.14.1": {"axes": axes, "blocks": blocks}})
    manager = _Made(_Global("pandas.core.internals.managers", "BlockManager"), (), state)
    frame = {"_data": manager, "_typ": "dataframe", "_metadata": [], "attrs": {}}
    file = io.BytesIO()
    _Pickler(file, 4).dump(_Made(_Global("pandas.core.frame", "DataFrame"), (), frame))
    return file.getvalue()
