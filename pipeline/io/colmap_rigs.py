"""Rigs and frames of COLMAP models (from version 3.12 on), which hold the poses of photos: `rigs.*` and `frames.*`.

A photo's pose is that of its camera in the rig, composed with that of the rig in the frame; poses in `images.*` are
copies that other programs may have left behind.

Source: https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64

Sensor = tuple[str, int]
"""Type and id."""


class Rig(NamedTuple):
    """A rig: (4, 4) transforms rig to sensor, by sensor; None: not calibrated."""

    rig_id: int
    sensors: dict[Sensor, F64 | None]


class RigFrame(NamedTuple):
    """Photos taken at once: (4, 4) transform world to rig, and the sensor of each image by image id."""

    rig_id: int
    pose: F64
    images: dict[int, Sensor]


def world_to_camera(rigs: Iterable[Rig], frames: Iterable[RigFrame]) -> dict[int, F64]:
    """Poses (4, 4) world to camera by image id, of all images whose camera is calibrated in its rig.

    Raises:
        ValueError: a frame refers to a rig or a camera that is missing.
    """
    by_id = {rig.rig_id: rig.sensors for rig in rigs}
    poses = {}
    for frame in frames:
        for image, sensor in frame.images.items():
            if sensor not in by_id.get(frame.rig_id, {}):
                raise ValueError(f"camera {sensor[1]} of image {image} is not in rig {frame.rig_id}")
            in_rig = by_id[frame.rig_id][sensor]
            if in_rig is not None and np.isfinite(frame.pose).all():
                poses[image] = in_rig @ frame.pose
    return poses


def transform(pose: Sequence[float]) -> F64:
    """(4, 4) transform of COLMAP's seven numbers: quaternion, w first, and translation.

    Raises:
        ValueError: the quaternion is null.
    """
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    if np.isfinite(pose).all():
        out[:3, :3] = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
    else:  # the frame isn't registered
        out[:3, :3] = np.nan
    out[:3, 3] = pose[4:]
    return out


def rig_lines(lines: Iterable[str]) -> Iterator[Rig]:
    """Rigs of a text file without comments and empty lines."""
    for line in lines:
        words = line.split()[::-1]
        rig_id, count = int(words.pop()), int(words.pop())
        sensors: dict[Sensor, F64 | None] = {}
        if count:
            sensors[words.pop(), int(words.pop())] = np.eye(4)
        for _ in range(count - 1):
            sensor, known = (words.pop(), int(words.pop())), int(words.pop())
            sensors[sensor] = transform([float(words.pop()) for _ in range(7)]) if known else None
        yield Rig(rig_id, sensors)


def frame_lines(lines: Iterable[str]) -> Iterator[RigFrame]:
    """Frames of a text file without comments and empty lines."""
    for line in lines:
        _, rig_id, *rest = line.split()
        count, data = int(rest[7]), rest[8:]
        found = {int(data[3 * i + 2]): (data[3 * i], int(data[3 * i + 1])) for i in range(count)}
        yield RigFrame(int(rig_id), transform([float(one) for one in rest[:7]]), _cameras_only(found))


def rigs(data: bytes) -> Iterator[Rig]:
    """Rigs of a binary file."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        rig_id, sensor_count = struct.unpack_from("<II", data, at)
        at += 8
        sensors: dict[Sensor, F64 | None] = {}
        for index in range(sensor_count):
            kind, sensor_id = struct.unpack_from("<iI", data, at)
            at, pose = at + 8, None
            if index == 0:
                pose = np.eye(4)
            else:
                known, at = data[at], at + 1
                if known:
                    pose, at = transform(struct.unpack_from("<7d", data, at)), at + 56
            sensors[_name(kind), sensor_id] = pose
        yield Rig(rig_id, sensors)


def frames(data: bytes) -> Iterator[RigFrame]:
    """Frames of a binary file."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, rig_id, *pose, number = struct.unpack_from("<II7dI", data, at)
        at += 68
        found = {}
        for _ in range(number):
            kind, sensor_id, image = struct.unpack_from("<iIQ", data, at)
            found[image], at = (_name(kind), sensor_id), at + 16
        yield RigFrame(rig_id, transform(pose), _cameras_only(found))


def _name(kind: int) -> str:
    return "CAMERA" if kind == 0 else f"sensor {kind}"


def _cameras_only(images: dict[int, Sensor]) -> dict[int, Sensor]:
    return {image: sensor for image, sensor in images.items() if sensor[0] == "CAMERA"}
