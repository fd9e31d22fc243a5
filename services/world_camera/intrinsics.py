"""Intrinsics of the camera: from `sensor_msgs/CameraInfo`, or from a field of view."""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.io.camera_info import InvalidCamera, camera_of
from scan2sim.services.toolboxes.frames import check_size

MIN_FOCAL, MAX_FOCAL, MAX_CENTRE = 0.01, 20.0, 2.0
"""Limits of the focal lengths, and of the principal point's distance from the image, relative to its longer side."""
MAX_COEFFICIENT = 1000.0
"""Largest coefficient of distortion."""
COPIED_FIELDS = (
    "height", "width", "distortion_model", "d", "k", "r", "p", "binning_x", "binning_y", "roi",
)  # fmt: skip
"""Fields of a CameraInfo besides its header."""


class Intrinsics:
    """The camera that is rendered, and the CameraInfo that goes with its images.

    Attributes:
        camera: None until a valid CameraInfo has arrived, if one is awaited.
        fields: fields of the CameraInfo to publish (`COPIED_FIELDS`).
        frame: frame of the camera that the CameraInfo names; "" if none has.
    """

    def __init__(self, camera: Camera | None, *, rectified: bool = False) -> None:
        """Start with a camera, or None to wait for a CameraInfo.

        Args:
            camera: pinhole camera.
            rectified: of a CameraInfo, render the rectified image.
        """
        self.camera, self._rectified = camera, rectified
        self.fields: dict[str, Any] = {} if camera is None else fields_of(camera)
        self.frame = ""

    def receive(self, info: Any) -> str | None:
        """Use a CameraInfo.

        Returns:
            why it can't be used, in which case the last valid one remains; None: it is used.
        """
        try:
            camera = camera_of(info, rectified=self._rectified)
            _check(camera)
        except InvalidCamera as error:
            return f"the CameraInfo {error}"
        except InputError as error:
            return f"the CameraInfo {error.cause}"
        except (ValueError, TypeError, IndexError, OverflowError) as error:
            return f"the CameraInfo is malformed ({error})"
        self.camera, self.frame = camera, str(info.header.frame_id).lstrip("/")
        self.fields = {name: getattr(info, name) for name in COPIED_FIELDS}
        return None


def fields_of(camera: Camera) -> dict[str, Any]:
    """Fields of the CameraInfo of a pinhole camera."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    arrays = {"d": np.zeros(5), "k": np.array(k), "r": np.eye(3).ravel(), "p": np.array(p)}
    return {"height": camera.height, "width": camera.width, "distortion_model": "plumb_bob", **arrays}


def _check(camera: Camera) -> None:
    """Check that a camera's numbers are those of a camera, so that rendering it needs no more memory than its image.

    Raises:
        InputError: they aren't.
    """
    check_size("CameraInfo", camera.width, camera.height)
    side = max(camera.width, camera.height)
    focal = np.array([camera.fx, camera.fy]) / side
    if focal.min() < MIN_FOCAL or focal.max() > MAX_FOCAL:
        raise InputError("CameraInfo", f"has the focal lengths {camera.fx:g}, {camera.fy:g}", "Calibrate the camera")
    centre = np.array([camera.cx - camera.width / 2, camera.cy - camera.height / 2]) / side
    if np.abs(centre).max() > MAX_CENTRE:
        raise InputError("CameraInfo", f"has its centre at {camera.cx:g}, {camera.cy:g}", "Calibrate the camera")
    if np.abs(camera.distortion).max(initial=0.0) > MAX_COEFFICIENT:
        raise InputError("CameraInfo", f"has the distortion {camera.distortion}", "Calibrate the camera")
