"""Pose of the camera in the world: by `/tf` and `/tf_static`, or by an odometry topic and a mount."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.bag.transforms import pose_matrix, transform_matrix
from scan2sim.services.world_camera.transforms import Transforms

Axes = Literal["auto", "optical", "body"]
"""Axes of the camera's frame: "optical" x right, y down, z ahead; "body" x ahead, y left, z up (REP 103)."""
BODY_FROM_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
"""(4, 4) from optical axes to those of a body."""
OPTICAL_SUFFIXES = ("optical", "optical_frame", "optical_link")
MAP_FRAME, START_FRAMES = "map", ("odom", "")
"""Frame of a robot's map, and frames that begin where the robot starts; "": that of an odometry topic."""
ODOMETRY_PARENT, ODOMETRY_CHILD = "odometry", "robot"
"""Frames of an odometry topic here, whatever its messages call them."""
MAX_COORDINATE_M = 1e7
"""Largest coordinate of a transform."""
Warn = Callable[[str, str], None]
"""Called with the kind of a problem and its description."""


def pose_of(values: tuple[float, ...]) -> F64:
    """(4, 4) of x, y, z in metres and roll, pitch, yaw in degrees about the fixed axes x, y, z."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", values[3:], degrees=True).as_matrix()
    T[:3, 3] = values[:3]
    return T


def default_origin(world: Path, fixed_frame: str) -> F64:
    """Pose (4, 4) of a fixed frame in a world: where the robot starts, of its map, or the world's own.

    Args:
        world: folder with `metadata.json`.
        fixed_frame: "map": by `T_world_map`; one of `START_FRAMES`: by the pose of the robot, or the spawn pose; others
            are the world's own. A leading slash (ROS 1) has no meaning.

    Raises:
        InputError: the file can't be read, or has no pose where the robot starts.
    """
    frame = _plain(fixed_frame)
    if frame not in (MAP_FRAME, *START_FRAMES):
        return np.eye(4)
    path = world / "metadata.json"
    try:
        metadata = json.loads(path.read_text(encoding="utf-8"))
        if frame == MAP_FRAME:
            return np.array(metadata.get("T_world_map", np.eye(4)), np.float64).reshape(4, 4)
        start = metadata.get("robot") or metadata["spawn"]
        return pose_of((*start["position_m"], *np.degrees(start["angles_rad"]).tolist()))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        cause = f"doesn't say where the robot starts ({type(error).__name__}: {error})"
        raise InputError(path, cause, "Give --origin X Y Z ROLL PITCH YAW") from None


class PoseSource:
    """Poses of the camera over time; messages that can't be used are reported and ignored."""

    def __init__(
        self, fixed_frame: str, origin: F64, mount: F64, axes: Axes, *, warn: Warn, clock: Callable[[], int]
    ) -> None:
        """Create it without any pose.

        Args:
            fixed_frame: frame that doesn't move in the world; "": that of an odometry topic.
            origin: (4, 4) its pose in the world.
            mount: (4, 4) pose of the camera in its frame, along the frame's axes, or on the robot.
            axes: of the camera's frame.
            warn: gets problems with messages.
            clock: nanoseconds since the epoch, the time of messages without one.
        """
        self._fixed, self._origin, self._mount, self._axes = fixed_frame, origin, mount, axes
        self._warn, self._clock = warn, clock
        self._transforms = Transforms()

    @property
    def by_odometry(self) -> bool:
        """Whether poses are those of an odometry topic."""
        return not self._fixed

    def receive_tf(self, message: Any, *, static: bool) -> None:
        """Add the transforms of a `tf2_msgs/TFMessage`."""
        for one in message.transforms:
            parent, child = _plain(one.header.frame_id), _plain(one.child_frame_id)
            pose = self._valid(transform_matrix, one.transform, f"the transform from {parent!r:.100} to {child!r:.100}")
            if pose is None:
                continue
            if static:
                self._transforms.add_static(parent, child, pose)
            else:
                self._transforms.add(parent, child, stamp_ns(one.header) or self._clock(), pose)

    def receive_odometry(self, message: Any) -> None:
        """Add the pose of a `nav_msgs/Odometry`."""
        pose = self._valid(pose_matrix, message.pose.pose, "a pose of the odometry")
        if pose is not None:
            self._transforms.add(ODOMETRY_PARENT, ODOMETRY_CHILD, stamp_ns(message.header) or self._clock(), pose)

    def _valid(self, matrix: Callable[[Any], F64], pose: Any, what: str) -> F64 | None:
        """Pose (4, 4) of a message; None, with a warning, if it is invalid."""
        try:
            T = matrix(pose)
        except ValueError:
            self._warn("pose", f"{what} is invalid: its quaternion is zero, or a number isn't finite")
            return None
        if np.abs(T[:3, 3]).max() > MAX_COORDINATE_M:
            self._warn("pose", f"{what} is {np.abs(T[:3, 3]).max():.3g} m away")
            return None
        return T

    def _ends(self, frame: str) -> tuple[str, str]:
        return (ODOMETRY_PARENT, ODOMETRY_CHILD) if self.by_odometry else (_plain(self._fixed), _plain(frame))

    def missing(self, frame: str) -> str | None:
        """Why no pose of a camera's frame is known; None if one is."""
        if self._transforms.are_connected(*self._ends(frame)):
            return None
        if self.by_odometry:
            return "no odometry has arrived"
        known = ", ".join(self._transforms.frames()) or "none"
        return f"/tf doesn't connect {self._fixed!r} (--fixed-frame) and {frame!r} (--frame); frames: {known:.500}"

    def newest(self, frame: str) -> int | None:
        """Latest time at which the pose of a camera's frame is known, nanoseconds; None: it doesn't move.

        Raises:
            KeyError: no pose of it is known (`missing`).
        """
        return self._transforms.newest(*self._ends(frame))

    def at(self, frame: str, time: int) -> F64 | None:
        """`T_world_cam` (4, 4), optical axes, of a camera's frame at a time; None if it isn't known then."""
        T_fixed_frame = self._transforms.at(*self._ends(frame), time)
        if T_fixed_frame is None:
            return None
        T = self._origin @ T_fixed_frame @ self._mount
        return T if self._is_optical(frame) else T @ BODY_FROM_OPTICAL

    def _is_optical(self, frame: str) -> bool:
        if self._axes == "auto":
            return not self.by_odometry and frame.endswith(OPTICAL_SUFFIXES)
        return self._axes == "optical"


def stamp_ns(header: Any) -> int:
    """Time stamp of a `std_msgs/Header`, nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _plain(frame: str) -> str:
    """Name of a frame without the leading slash of ROS 1."""
    return frame.lstrip("/")
