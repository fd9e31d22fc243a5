"""Messages of ROS 2 for tests, without a transport: objects with the fields of their types."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np


def header(seconds: float = 0.0, frame: str = "") -> Any:
    """A `std_msgs/Header`."""
    whole, rest = divmod(round(seconds * 1e9), 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=whole, nanosec=rest), frame_id=frame)


def vector(values: tuple[float, ...]) -> Any:
    """A vector, or a quaternion x y z w."""
    return SimpleNamespace(**dict(zip("xyzw", values, strict=False)))


LEVEL = (0.0, 0.0, 0.0, 1.0)


def tf(*links: tuple[str, str, float, tuple[float, ...], tuple[float, ...]]) -> Any:
    """A `tf2_msgs/TFMessage` of links: parent, child, seconds, position, quaternion x y z w."""
    return SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=header(seconds, parent),
                child_frame_id=child,
                transform=SimpleNamespace(translation=vector(position), rotation=vector(quaternion)),
            )
            for parent, child, seconds, position, quaternion in links
        ]
    )


def odometry(seconds: float, position: tuple[float, ...], quaternion: tuple[float, ...] = LEVEL) -> Any:
    """A `nav_msgs/Odometry`."""
    pose = SimpleNamespace(position=vector(position), orientation=vector(quaternion))
    return SimpleNamespace(header=header(seconds, "odom"), child_frame_id="base_link", pose=SimpleNamespace(pose=pose))


def camera_info(**changed: Any) -> Any:
    """A `sensor_msgs/CameraInfo` of 64 x 48 pixels."""
    k = np.array([50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1])
    p = np.array([40.0, 0, 30.5, 0, 0, 40.0, 22.5, 0, 0, 0, 1, 0])
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    fields = {
        "header": header(0, "front_optical_frame"), "height": 48, "width": 64, "distortion_model": "plumb_bob",
        "d": np.array([-0.2, 0.05, 0.001, 0.0, 0.0]), "k": k, "r": np.eye(3).ravel(), "p": p, "binning_x": 0,
        "binning_y": 0, "roi": roi,
    }  # fmt: skip
    return SimpleNamespace(**fields | changed)


def image(pixels: np.ndarray, kind: str, seconds: float = 0.0, **changed: Any) -> Any:
    """A `sensor_msgs/Image` of pixels (H, W) or (H, W, C) in the encoding `kind`."""
    height, width = pixels.shape[:2]
    fields = {
        "header": header(seconds), "height": height, "width": width, "encoding": kind, "is_bigendian": 0,
        "step": pixels.nbytes // max(1, height), "data": np.ascontiguousarray(pixels).reshape(-1).view(np.uint8),
    }  # fmt: skip
    return SimpleNamespace(**fields | changed)
