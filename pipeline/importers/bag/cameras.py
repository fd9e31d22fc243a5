"""Peculiarities of recorded `sensor_msgs/CameraInfo`: rectified images, the second camera of a stereo pair."""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.io.camera_info import field

MAX_OFF_CENTRE = 0.05
"""Largest usual distance of a principal point from the middle of the image, as a share of its width."""


def has_only_projection(info: Any) -> bool:
    """Whether a `CameraInfo` has P, but no K: that of images which were rectified."""
    K, P = (np.asarray(field(info, name), np.float64) for name in "kp")
    return not K.any() and bool(P[0] > 0)


def looks_rectified(info: Any) -> bool:
    """Whether the images of a `CameraInfo` with distortion have the size of rectified ones: by the principal points.

    That of K is far from the middle then, that of P isn't (kitti2bag: rectified images with K and D of the raw ones).
    """
    K, D, P = (np.asarray(field(info, name), np.float64) for name in "kdp")
    if not (K[0] > 0 and P[0] > 0 and D.any()):
        return False
    middle = np.array([info.width, info.height]) / 2
    raw, rectified = (float(np.linalg.norm(centre - middle)) for centre in (K[[2, 5]], P[[2, 6]]))
    return raw > MAX_OFF_CENTRE * float(info.width) and rectified < raw / 2


def camera_offset(info: Any) -> float:
    """Offset of a camera from its frame by P of its `CameraInfo`: not 0 for the second camera of a stereo pair."""
    return float(field(info, "p")[3])
