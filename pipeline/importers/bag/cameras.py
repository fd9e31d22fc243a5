"""Camera models of `sensor_msgs/CameraInfo`."""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import Camera, CameraModel

MODELS: dict[str, CameraModel] = {
    "": "opencv", "plumb_bob": "opencv", "rational_polynomial": "opencv", "radtan": "opencv",
    "equidistant": "fisheye", "fisheye": "fisheye", "kannala_brandt4": "fisheye", "kannala_brandt": "fisheye",
}  # fmt: skip
"""`distortion_model` to the project's; their coefficients have the same order as in OpenCV."""
LENGTHS: dict[CameraModel, tuple[int, ...]] = {"opencv": (4, 5, 8), "fisheye": (4,)}


MAX_OFF_CENTRE = 0.05
"""Largest usual distance of a principal point from the middle of the image, as a share of its width."""


class InvalidCamera(Exception):
    """A CameraInfo from which no camera can be made; the text says why."""


def camera_of(info: Any, *, rectified: bool) -> Camera:
    """The camera of a `CameraInfo`.

    Args:
        info: the message; of ROS 1 (fields D, K, P) or ROS 2 (d, k, p).
        rectified: for a rectified image, whose intrinsics are those of P, without distortion.

    Raises:
        InvalidCamera: it isn't calibrated, or its distortion model is unknown.
    """
    K, D, P = (np.asarray(_field(info, name), np.float64) for name in "kdp")
    name = str(info.distortion_model)
    width, height = int(info.width), int(info.height)
    fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if rectified and P[0] > 0 else (K[0], K[4], K[2], K[5])
    if not (width and height and np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0):
        raise InvalidCamera(f"is not calibrated (size {width}x{height}, focal lengths {fx:g}, {fy:g})")
    # regions of interest and binning: calibration is that of the full resolution
    roi, bin_x, bin_y = info.roi, max(1, int(info.binning_x)), max(1, int(info.binning_y))
    cx, cy = cx - roi.x_offset, cy - roi.y_offset
    width, height = int(roi.width) or width, int(roi.height) or height
    fx, fy, cx, cy = fx / bin_x, fy / bin_y, (cx + 0.5) / bin_x - 0.5, (cy + 0.5) / bin_y - 0.5
    size = width // bin_x, height // bin_y
    if rectified or not D.any():
        plain: CameraModel = "fisheye" if not rectified and MODELS.get(name) == "fisheye" else "pinhole"
        return Camera(
            plain, *size, float(fx), float(fy), float(cx), float(cy), (0.0,) * 4 if plain == "fisheye" else ()
        )
    if name not in MODELS:
        raise InvalidCamera(f"has the unknown distortion model {name!r} (known: {', '.join(filter(None, MODELS))})")
    model = MODELS[name]
    wanted = next((n for n in LENGTHS[model] if n >= len(np.trim_zeros(D, "b")) and n <= len(D)), None)
    if wanted is None or not np.isfinite(D).all():
        raise InvalidCamera(f"has {len(D)} coefficients of the model {name!r}")
    return Camera(model, *size, float(fx), float(fy), float(cx), float(cy), tuple(float(d) for d in D[:wanted]))


def has_only_projection(info: Any) -> bool:
    """Whether a `CameraInfo` has P, but no K: that of images which were rectified."""
    K, P = (np.asarray(_field(info, name), np.float64) for name in "kp")
    return not K.any() and bool(P[0] > 0)


def looks_rectified(info: Any) -> bool:
    """Whether the images of a `CameraInfo` with distortion have the size of rectified ones: by the principal points.

    That of K is far from the middle then, that of P isn't (kitti2bag: rectified images with K and D of the raw ones).
    """
    K, D, P = (np.asarray(_field(info, name), np.float64) for name in "kdp")
    if not (K[0] > 0 and P[0] > 0 and D.any()):
        return False
    middle = np.array([info.width, info.height]) / 2
    raw, rectified = (float(np.linalg.norm(centre - middle)) for centre in (K[[2, 5]], P[[2, 6]]))
    return raw > MAX_OFF_CENTRE * float(info.width) and rectified < raw / 2


def camera_offset(info: Any) -> float:
    """Offset of a camera from its frame by P of its `CameraInfo`: not 0 for the second camera of a stereo pair."""
    return float(_field(info, "p")[3])


def _field(info: Any, name: str) -> Any:
    return getattr(info, name, None) if hasattr(info, name) else getattr(info, name.upper())
