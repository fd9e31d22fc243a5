"""Cameras of `sensor_msgs/CameraInfo`, and the distortion models of ROS, OpenCV, Kalibr and others by their names."""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, Camera, CameraModel

MODELS: dict[str, CameraModel] = {
    "": "opencv", "plumb_bob": "opencv", "rational_polynomial": "opencv", "radtan": "opencv",
    "equidistant": "fisheye", "fisheye": "fisheye", "kannala_brandt4": "fisheye", "kannala_brandt": "fisheye",
}  # fmt: skip
"""Distortion model to the project's; their coefficients have the same order as in OpenCV."""
LENGTHS: dict[CameraModel, tuple[int, ...]] = {"opencv": (4, 5, 8), "fisheye": (4,)}
MEI, DOUBLE_SPHERE, FIELD_OF_VIEW = "Mei's omnidirectional model", "the double sphere model", "the field of view model"
OTHER_MODELS = {
    "omni": MEI, "omnidir": MEI, "mei": MEI, "ds": DOUBLE_SPHERE, "double_sphere": DOUBLE_SPHERE,
    "eucm": "the extended unified model", "fov": FIELD_OF_VIEW, "atan": FIELD_OF_VIEW,
}  # fmt: skip
"""Models that no camera here can represent, and their full names; without coefficients they aren't pinholes either."""


class InvalidCamera(Exception):
    """A calibration from which no camera can be made; the text says why."""


def camera_of(info: Any, *, rectified: bool) -> Camera:
    """The camera of a `CameraInfo`.

    Args:
        info: the message; of ROS 1 (fields D, K, P) or ROS 2 (d, k, p).
        rectified: for a rectified image, whose intrinsics are those of P, without distortion.

    Raises:
        InvalidCamera: it isn't calibrated, or its distortion model is unknown.
    """
    K, D, P = (np.asarray(field(info, name), np.float64) for name in "kdp")
    width, height = int(info.width), int(info.height)
    fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if rectified and P[0] > 0 else (K[0], K[4], K[2], K[5])
    if not (width and height and np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0):
        raise InvalidCamera(f"is not calibrated (size {width}x{height}, focal lengths {fx:g}, {fy:g})")
    # regions of interest and binning: calibration is that of the full resolution
    roi, bin_x, bin_y = info.roi, max(1, int(info.binning_x)), max(1, int(info.binning_y))
    cx, cy = cx - roi.x_offset, cy - roi.y_offset
    width, height = int(roi.width) or width, int(roi.height) or height
    fx, fy, cx, cy = fx / bin_x, fy / bin_y, (cx + 0.5) / bin_x - 0.5, (cy + 0.5) / bin_y - 0.5
    model, distortion = distortion_of("", np.zeros(0)) if rectified else distortion_of(str(info.distortion_model), D)
    return Camera(model, width // bin_x, height // bin_y, float(fx), float(fy), float(cx), float(cy), distortion)


def distortion_of(name: str, D: F64) -> tuple[CameraModel, tuple[float, ...]]:
    """Camera model and coefficients of a distortion model: "pinhole" if all coefficients (N,) of a perspective are 0.

    Raises:
        InvalidCamera: the model has no counterpart, or another number of coefficients.
    """
    check_model(name)
    if not D.any():
        return ("fisheye", (0.0,) * 4) if MODELS.get(name) == "fisheye" else ("pinhole", ())
    if name not in MODELS:
        raise InvalidCamera(f"has the unknown distortion model {name!r} (known: {', '.join(filter(None, MODELS))})")
    model = MODELS[name]
    wanted = next((n for n in LENGTHS[model] if n >= len(np.trim_zeros(D, "b")) and n <= len(D)), None)
    if wanted is None or not np.isfinite(D).all():
        raise InvalidCamera(f"has {len(D)} coefficients of the model {name!r}")
    return model, tuple(float(d) for d in D[:wanted])


def check_model(name: str) -> None:
    """Raise InvalidCamera if a model, by its name in any program, is one of `OTHER_MODELS`."""
    if name in OTHER_MODELS:
        raise InvalidCamera(f"has the model {name!r} ({OTHER_MODELS[name]}), which has no counterpart here")


def field(info: Any, name: str) -> Any:
    """A field of a CameraInfo: in lower case in ROS 2, in upper case in ROS 1."""
    return getattr(info, name, None) if hasattr(info, name) else getattr(info, name.upper())
