"""VisualSFM's N-View Match files (NVM_V3): the first model of a file, which is the largest.

A camera is `name f qw qx qy qz cx cy cz r 0`: the rotation is world to camera with OpenCV's axes, c is the camera
centre. The distortion model maps distorted to undistorted points: what is measured at m (in focal lengths from the
image centre) is at m (1 + r |m|2) without distortion. OpenCV's k1...k6 are fitted to its inverse; the camera is
rejected if the fit error exceeds 0.05 pixels. Image sizes are read from the photos.

Source: http://ccwu.me/vsfm/doc.html#nvm, and `LoadNVM`, `SetNormalizedMeasurementDistortion` of Multicore Bundle
Adjustment (pba/util.h, DataInterface.h) by the same author.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.camera import distortion_fit
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io.photogrammetry import Model, Photos, Shot
from scan2sim.pipeline.io.photogrammetry.bundler import camera_key, non_empty_lines, parse_row

REMEDY = "Give the .nvm file that VisualSFM has saved (NVM_V3)"


def read(model: Path, photos: Photos) -> Model:
    """Read a .nvm file."""
    lines = non_empty_lines(model)
    try:
        head = next(lines)
        if not head.startswith("NVM_V3"):
            raise ValueError("it doesn't start with NVM_V3")
        fixed = _fixed_calibration(head)
        count = int(next(lines))
        if count < 1:
            raise ValueError(f"{count} cameras")
        shots: list[Shot] = []
        lenses: dict[Camera, str] = {}
        for _ in range(count):
            name, *rest = next(lines).rsplit(maxsplit=10)
            f, *q_and_c, r, _ = parse_row(" ".join(rest), 10)
            key = camera_key(lenses, _camera(model, photos.size(name), f, r, fixed))
            shots.append(Shot(name, key, _pose(np.array(q_and_c[:4]), np.array(q_and_c[4:]))))
        points = int(next(lines, "0"))
        values = [np.array(next(lines).split()[:6], np.float64) for _ in range(points)]
        rows = np.array(values).reshape(-1, 6)
    except StopIteration:
        raise InputError(model, "is truncated: it ends before its last camera or point", "Copy it again") from None
    except ValueError as error:
        raise InputError(model, f"is not a readable NVM file ({str(error)[:100]})", REMEDY) from None
    cameras = {key: camera for camera, key in lenses.items()}
    return Model(cameras, tuple(shots), rows[:, :3], np.clip(rows[:, 3:], 0, 255).astype(np.uint8))


def _fixed_calibration(head: str) -> tuple[float, ...] | None:
    """fx, cx, fy, cy of `NVM_V3 FixedK fx cx fy cy [r]`, a calibration shared by all photos, if given."""
    words = head.split()
    if "FixedK" not in words:
        return None
    fx, cx, fy, cy, *_ = (float(word) for word in words[words.index("FixedK") + 1 :])
    return fx, cx, fy, cy


def _camera(model: Path, size: tuple[int, int], f: float, r: float, fixed: tuple[float, ...] | None) -> Camera:
    width, height = size
    if not f > 0:
        raise ValueError(f"focal length {f}")
    fx, cx, fy, cy = fixed or (f, width / 2, f, height / 2)
    cx, cy = cx - 0.5, cy - 0.5
    if r == 0:
        return Camera("pinhole", width, height, fx, fy, cx, cy)
    k, fit_error = _inverse(r, distortion_fit.max_distorted_radius(width, height, fx, fy, cx, cy), f)
    if fit_error > distortion_fit.MAX_FIT_ERROR_PX:
        cause = f"its distortion (r = {r:g}) fits OpenCV's model with an error of {fit_error:.3f} pixels"
        raise InputError(model, cause, "Undistort the photos")
    return Camera("opencv", width, height, fx, fy, cx, cy, (k[0], k[1], 0.0, 0.0, *k[2:]))


@cache
def _inverse(r: float, max_radius: float, f: float) -> tuple[tuple[float, ...], float]:
    """OpenCV's k1...k6, and their largest error in pixels; `max_radius` is the largest distorted radius."""
    distorted = np.linspace(0, 1.05 * max_radius, 20_000)
    undistorted = distorted * (1 + r * distorted**2)
    if (np.diff(undistorted) <= 0).any():
        return (), np.inf  # the distortion isn't invertible within the image

    def factor(radius: F64) -> F64:
        return np.interp(radius, undistorted, distorted) / radius

    k, fit_error = distortion_fit.fit_radial(factor, float(undistorted[-1]), f)
    return tuple(k.tolist()), fit_error


def _pose(q: F64, centre: F64) -> F64:
    if not abs(np.linalg.norm(q) - 1) < 1e-2:
        raise ValueError("a quaternion is not normalized")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(np.roll(q, -1)).as_matrix().T, centre
    return pose
