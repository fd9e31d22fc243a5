"""VisualSFM's N-View Match files (NVM_V3): the first model of a file, which is the largest.

A camera is `name f qw qx qy qz cx cy cz r 0`: the rotation is world to camera with OpenCV's axes, the place is the
camera's centre. Distortion goes the other way round than elsewhere: what is measured at m (in focal lengths from the
picture's middle) would be at m (1 + r |m|2) without the lens. OpenCV's k1...k6 are fitted to its inverse, and refused
if they are more than 0.05 pixels off. Sizes are the photos'.

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
from scan2sim.pipeline.io.photogrammetry.bundler import named, numbered, row

REMEDY = "Name the .nvm file that VisualSFM has saved (NVM_V3)"


def read(model: Path, photos: Photos) -> Model:
    """A .nvm file."""
    lines = numbered(model)
    try:
        head = next(lines)
        if not head.startswith("NVM_V3"):
            raise ValueError("it doesn't begin with NVM_V3")
        fixed = _fixed(head)
        count = int(next(lines))
        if count < 1:
            raise ValueError(f"{count} cameras")
        shots: list[Shot] = []
        lenses: dict[Camera, str] = {}
        for _ in range(count):
            name, *rest = next(lines).rsplit(maxsplit=10)
            f, *q_and_c, r, _ = row(" ".join(rest), 10)
            key = named(lenses, _camera(model, photos.size(name), f, r, fixed))
            shots.append(Shot(name, key, _pose(np.array(q_and_c[:4]), np.array(q_and_c[4:]))))
        points = int(next(lines, "0"))
        values = [np.array(next(lines).split()[:6], np.float64) for _ in range(points)]
        rows = np.array(values).reshape(-1, 6)
    except StopIteration:
        raise InputError(model, "is truncated: it ends before its last camera or point", "Copy it again") from None
    except ValueError as error:
        raise InputError(model, f"is no readable NVM file ({str(error)[:100]})", REMEDY) from None
    cameras = {key: camera for camera, key in lenses.items()}
    return Model(cameras, tuple(shots), rows[:, :3], np.clip(rows[:, 3:], 0, 255).astype(np.uint8))


def _fixed(head: str) -> tuple[float, ...] | None:
    """fx, cx, fy, cy of `NVM_V3 FixedK fx cx fy cy [r]`: one calibration for all, where it was given."""
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
    k, off = _inverse(r, distortion_fit.reach(width, height, fx, fy, cx, cy), f)
    if off > distortion_fit.EXACT:
        raise InputError(
            model, f"its lens (r = {r:g}) is {off:.3f} pixels off in OpenCV's model", "Undistort the photos"
        )
    return Camera("opencv", width, height, fx, fy, cx, cy, (k[0], k[1], 0.0, 0.0, *k[2:]))


@cache
def _inverse(r: float, reach: float, f: float) -> tuple[tuple[float, ...], float]:
    """k1...k6 of OpenCV, and how many pixels they are off at worst."""
    measured = np.linspace(0, 1.05 * reach, 20_000)
    straight = measured * (1 + r * measured**2)
    if (np.diff(straight) <= 0).any():
        return (), np.inf  # it folds back within the picture

    def factor(radius: F64) -> F64:
        return np.interp(radius, straight, measured) / radius

    k, off = distortion_fit.radial(factor, float(straight[-1]), f)
    return tuple(k.tolist()), off


def _pose(q: F64, centre: F64) -> F64:
    if not abs(np.linalg.norm(q) - 1) < 1e-2:
        raise ValueError("a quaternion's length is not 1")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(np.roll(q, -1)).as_matrix().T, centre
    return pose
