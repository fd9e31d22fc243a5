"""A writer of ROS bags in all formats, with the messages that the import reads; needs no ROS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64, Camera

FORMATS = ("mcap", "sqlite3", "ros1")
LIVOX = "livox_ros_driver2/msg/CustomMsg"
LIVOX_POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n",
    "livox_ros_driver2/msg/CustomPoint",
)
LIVOX_DEFINITION = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "livox_ros_driver2/CustomPoint[] points\n"
)
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
MODELS = {"pinhole": "plumb_bob", "opencv": "plumb_bob", "fisheye": "equidistant"}


@dataclass
class BagFile:
    """An open bag for writing: messages are given as fields, in ROS 2's names."""

    form: str
    store: Any
    writer: Any
    connections: dict[str, Any] = field(default_factory=dict)

    def message(self, kind: str, **fields: Any) -> Any:
        """A message of a type such as "sensor_msgs/Imu"; missing fields are zero."""
        return self._filled(_full(kind), fields)

    def _filled(self, kind: str, given: dict[str, Any]) -> Any:
        values: dict[str, Any] = {}
        own = {name.lower(): value for name, value in given.items()}
        for name, (node, detail) in self.store.fielddefs[kind][1]:
            value = own.pop(name.lower(), None)
            if int(node) == 2 and (value is None or isinstance(value, dict)):
                value = self._filled(detail, value or {})
            elif value is None:
                value = _zero(int(node), detail)
            values[name] = value
        assert not own, f"{kind} has no {own}"
        return self.store.types[kind](**values)

    def write(self, topic: str, kind: str, log_s: float, **fields: Any) -> None:
        """Write a message, recorded at a time in seconds."""
        self.write_raw(topic, kind, log_s, self.serialized(kind, **fields))

    def serialized(self, kind: str, **fields: Any) -> bytes:
        """A message as bytes."""
        message = self.message(kind, **fields)
        serialize = self.store.serialize_ros1 if self.form == "ros1" else self.store.serialize_cdr
        return bytes(serialize(message, _full(kind)))

    def write_raw(self, topic: str, kind: str, log_s: float, raw: bytes) -> None:
        """Write the bytes of a message."""
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, _full(kind), typestore=self.store)
        self.writer.write(self.connections[topic], round(log_s * 1e9), raw)

    def header(self, time: float, frame: str) -> dict[str, Any]:
        """Fields of a header."""
        return {"stamp": stamp(time), "frame_id": frame}

    def transforms(self, topic: str, log_s: float, links: Sequence[tuple[str, str, F64, float]]) -> None:
        """Write transforms: parent, child, T_parent_child (4, 4), seconds."""
        ones = [
            self.message(
                "geometry_msgs/TransformStamped", header=self.header(time, parent), child_frame_id=child,
                transform={"translation": _xyz(T[:3, 3]), "rotation": _quaternion(T)},
            )
            for parent, child, T, time in links
        ]  # fmt: skip
        self.write(topic, "tf2_msgs/TFMessage", log_s, transforms=ones)

    def cloud(self, topic: str, time: float, frame: str, points: npt.NDArray[Any], **fields: Any) -> None:
        """Write a PointCloud2 of records (N,), recorded at its time unless `log_s` is given."""
        log_s = fields.pop("log_s", time)
        kinds: Any = points.dtype.fields or {}
        described = [
            self.message("sensor_msgs/PointField", name=name, offset=at, datatype=DATATYPES[kind.str[1:]], count=1)
            for name, (kind, at) in ((n, kinds[n][:2]) for n in points.dtype.names or ())
        ]
        size = points.dtype.itemsize
        body = {
            "height": 1, "width": len(points), "fields": described, "point_step": size, "row_step": size * len(points),
            "data": np.frombuffer(points.tobytes(), np.uint8), "is_dense": True,
        }  # fmt: skip
        self.write(topic, "sensor_msgs/PointCloud2", log_s, header=self.header(time, frame), **(body | fields))

    def livox(self, topic: str, time: float, frame: str, xyz: npt.NDArray[Any], offsets_ns: Sequence[int]) -> None:
        """Write a Livox CustomMsg."""
        points = [
            self.message(
                "livox_ros_driver2/CustomPoint", offset_time=int(t), x=float(p[0]), y=float(p[1]), z=float(p[2]),
                reflectivity=128,
            )
            for t, p in zip(offsets_ns, xyz, strict=True)
        ]  # fmt: skip
        self.write(
            topic, LIVOX, time, header=self.header(time, frame), timebase=round(time * 1e9), point_num=len(points),
            points=points,
        )  # fmt: skip

    def image(self, topic: str, time: float, frame: str, pixels: npt.NDArray[Any], encoding: str) -> None:
        """Write an Image of pixels (H, W) or (H, W, C)."""
        height, width = pixels.shape[:2]
        data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
        self.write(
            topic, "sensor_msgs/Image", time, header=self.header(time, frame), height=height, width=width,
            encoding=encoding, step=len(data) // max(1, height), data=data,
        )  # fmt: skip

    def compressed(self, topic: str, time: float, frame: str, content: bytes, kind: str = "jpeg") -> None:
        """Write a CompressedImage with the bytes of a file."""
        data = np.frombuffer(content, np.uint8)
        self.write(topic, "sensor_msgs/CompressedImage", time, header=self.header(time, frame), format=kind, data=data)

    def camera_info(self, topic: str, time: float, frame: str, camera: Camera) -> None:
        """Write the calibration of a camera."""
        K = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1])
        P = np.array([camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0])
        name = "rational_polynomial" if len(camera.distortion) == 8 else MODELS[camera.model]
        self.write(
            topic, "sensor_msgs/CameraInfo", time, header=self.header(time, frame), height=camera.height,
            width=camera.width, distortion_model=name, d=np.array(camera.distortion or [0.0] * 5), k=K,
            r=np.eye(3).ravel(), p=P,
        )  # fmt: skip

    def odometry(self, topic: str, time: float, frames: tuple[str, str], T: F64) -> None:
        """Write a pose (4, 4) of the second frame in the first one."""
        pose = {"position": _xyz(T[:3, 3]), "orientation": _quaternion(T)}
        self.write(
            topic, "nav_msgs/Odometry", time, header=self.header(time, frames[0]), child_frame_id=frames[1],
            pose={"pose": pose},
        )  # fmt: skip

    def fix(self, topic: str, time: float, frame: str, position: Sequence[float], sigma: float | None = None) -> None:
        """Write a NavSatFix: latitude, longitude, altitude."""
        covariance = np.zeros(9) if sigma is None else np.eye(3).ravel() * sigma**2
        self.write(
            topic, "sensor_msgs/NavSatFix", time, header=self.header(time, frame), latitude=float(position[0]),
            longitude=float(position[1]), altitude=float(position[2]), position_covariance=covariance,
            position_covariance_type=0 if sigma is None else 2,
        )  # fmt: skip

    def imu(self, topic: str, time: float, frame: str, R: F64) -> None:
        """Write an orientation (3, 3): axes of the IMU to east, north, up."""
        T = np.eye(4)
        T[:3, :3] = R
        self.write(topic, "sensor_msgs/Imu", time, header=self.header(time, frame), orientation=_quaternion(T))


@contextmanager
def bag_file(path: Path, form: str) -> Iterator[BagFile]:
    """Create a bag: a folder for "mcap" and "sqlite3", a file for "ros1"."""
    store = get_typestore(Stores.ROS1_NOETIC if form == "ros1" else Stores.ROS2_HUMBLE)
    if form == "ros1":
        text = "geometry_msgs/TransformStamped[] transforms\n"
        store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    store.register(get_types_from_msg(*LIVOX_POINT))
    store.register(get_types_from_msg(LIVOX_DEFINITION, LIVOX))
    if form == "ros1":
        with Writer1(path) as writer1:
            yield BagFile(form, store, writer1)
        return
    plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as writer2:
        yield BagFile(form, store, writer2)


def bag_path(folder: Path, form: str, name: str = "drive") -> Path:
    """Path of a bag of a format in a folder."""
    return folder / (f"{name}.bag" if form == "ros1" else f"{name}_{form}")


def stamp(time: float) -> dict[str, Any]:
    """Fields of a time in seconds."""
    nanoseconds = round(time * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def records(xyz: npt.NDArray[Any], **columns: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Records (N,) of points (N, 3), as float32, and further columns."""
    kinds: list[tuple[str, Any]] = [*((axis, "<f4") for axis in "xyz"), *((n, c.dtype) for n, c in columns.items())]
    rows = np.empty(len(xyz), kinds)
    for k, axis in enumerate("xyz"):
        rows[axis] = xyz[:, k]
    for name, column in columns.items():
        rows[name] = column
    return rows


def _full(kind: str) -> str:
    package, _, name = kind.partition("/")
    return kind if "/msg/" in kind else f"{package}/msg/{name}"


def _zero(node: int, detail: Any) -> Any:
    """Zero of a field of basic type, array or sequence."""
    if node == 1:
        return "" if detail[0] == "string" else False if detail[0] == "bool" else 0.0 if "float" in detail[0] else 0
    (_, element), length = detail
    name = element[0] if isinstance(element, tuple) else ""
    return np.zeros(length if node == 3 else 0, name) if name and name != "string" else []


def _xyz(values: Sequence[float] | F64) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _quaternion(T: F64) -> dict[str, float]:
    return dict(zip("xyzw", map(float, Rotation.from_matrix(T[:3, :3]).as_quat()), strict=True))
