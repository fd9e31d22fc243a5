"""What messages about poses contain: valid poses, orientations, positions and their accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.bag.transforms import pose_matrix


def odometry_child(message: Any) -> str:
    """Frame whose pose an Odometry message gives; base_link if it doesn't say."""
    return str(message.child_frame_id).lstrip("/") or "base_link"


def odometry_poses(messages: Sequence[Any]) -> F64:
    """Poses (N, 4, 4) of Odometry messages, without invalid ones."""
    T = []
    for message in messages:
        with suppress(ValueError):
            T.append(pose_matrix(message.pose.pose))
    return np.array(T).reshape(-1, 4, 4)


def without_orientation(imus: Sequence[Any]) -> bool:
    """Whether Imu messages have no orientation: none is valid, or it stays that of an empty message while it turns.

    Drivers of ROS 2 that don't fill it in leave the default of the message, (0, 0, 0, 1) with covariance 0.
    """
    valid = [imu for imu in imus if has_orientation(imu)]
    turns = any(abs(getattr(imu.angular_velocity, axis)) > 0 for imu in valid for axis in "xyz")
    return all((q := imu.orientation).x == q.y == q.z == 0 for imu in valid) and (turns or not valid)


def has_orientation(imu: Any) -> bool:
    """Whether an Imu message has an orientation (REP 145: a covariance of -1 means it has none)."""
    q = imu.orientation
    length = float(np.linalg.norm([q.x, q.y, q.z, q.w]))
    return float(imu.orientation_covariance[0]) != -1 and abs(length - 1) < 0.1


def valid_fix(fix: Any) -> bool:
    """Whether a NavSatFix has a position that UTM covers."""
    position = (float(fix.latitude), float(fix.longitude), float(fix.altitude))
    return int(fix.status.status) >= 0 and bool(np.isfinite(position).all()) and abs(position[0]) <= 84


def fix_sigma(fix: Any) -> float | None:
    """Horizontal standard deviation of a NavSatFix in metres, or None if it is unknown (also if it is zero)."""
    variance = (float(fix.position_covariance[0]) + float(fix.position_covariance[4])) / 2
    return float(np.sqrt(variance)) if int(fix.position_covariance_type) != 0 and variance > 0 else None
