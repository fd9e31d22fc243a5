"""Calibration files: extrinsics of a scanner and a camera, camera of a folder of photos."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from scan2sim.pipeline.camera import panorama
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.poses import nearest_rotation
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io import camera_calibrations, file_checks, toml
from scan2sim.pipeline.io.camera_calibrations import CalibratedCamera
from scan2sim.pipeline.io.images.image import SUFFIXES, read_levels, size_of
from scan2sim.pipeline.io.sweep_files import list_files
from scan2sim.pipeline.io.tile import CameraEntry, camera_entry, camera_of

CAMERAS_REMEDY = (
    "Write [[cameras]] with id, model, size, focal, centre as in a tile.toml (docs/reference/formats.md), or give the "
    "file of Kalibr, ROS, OpenCV or direct_visual_lidar_calibration (.yaml, .json, .xml)"
)
MAX_LEVER_ARM_M = 20.0
"""Largest distance of a camera from the scanner of a vehicle; calibrations in millimetres exceed it."""
MAX_VALUE = 1e8
"""Plausibility limit of calibration values."""


def read_extrinsics(path: Path) -> F64:
    """Read T_camera_scanner (4, 4) from a text file: three or four rows of four numbers, or a calibration of KITTI.

    Supported KITTI files: `calib_velo_to_cam.txt` (R: and T:), and `calib.txt` of the odometry data set (Tr:). Files
    with the suffix of YAML, JSON or XML are calibrations of other programs (`camera_calibrations`).

    Raises:
        InputError: another format, or not a rigid transform.
    """
    remedy = "Write T_camera_scanner: three rows of four numbers, scanner axes to camera axes"
    if is_foreign(path):
        return _rigid(path, camera_calibrations.read_extrinsics(path), remedy)
    lines = [line.partition("#")[0].strip() for line in file_checks.lines(path)]
    entries = _entries(lines)
    try:
        if "Tr" in entries:
            rows = _numbers(entries["Tr"]).reshape(3, 4)
        elif {"R", "T"} <= set(entries):
            rows = np.column_stack([_numbers(entries["R"]).reshape(3, 3), _numbers(entries["T"]).reshape(3)])
        else:
            rows = np.array([_numbers(line) for line in lines if line])
            if rows.shape not in ((3, 4), (4, 4)) or (len(rows) == 4 and not np.allclose(rows[3], [0, 0, 0, 1])):
                raise ValueError(f"{len(rows)} rows")
    except ValueError as error:
        raise InputError(path, f"contains no 3x4 or 4x4 matrix ({error})", remedy) from None
    return _rigid(path, rows, remedy)


def is_foreign(path: Path) -> bool:
    """Whether a file is a calibration of another program, by its suffix."""
    return path.suffix.lower() in camera_calibrations.SUFFIXES


def _rigid(path: Path, rows: F64, remedy: str) -> F64:
    """A rigid transform (4, 4) of rows (3 or 4, 4), with an exact rotation.

    Raises:
        InputError: it isn't rigid, or the translation can't be in metres.
    """
    R = rows[:3, :3]
    if not np.isfinite(rows).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError(path, "its left 3x3 is not a rotation matrix", remedy)
    distance = float(np.linalg.norm(rows[:3, 3]))
    if distance > MAX_LEVER_ARM_M:
        cause = f"puts the camera {distance:,.0f} m from the scanner"
        raise InputError(path, cause, "Give the translation in metres (it may be in millimetres)")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = nearest_rotation(R), rows[:3, 3]
    return T


def photo_extrinsics(path: Path, photos: Path) -> F64 | None:
    """T_camera_scanner (4, 4) of the camera of a photo folder, from `calib.txt` of KITTI odometry.

    `Tr` belongs to camera 0, whose poses that data set gives; the camera of `image_2` is 6 cm beside it (see P2).

    Returns:
        None if the file isn't KITTI's, or the folder isn't named like one of its cameras: the extrinsics of
        `read_extrinsics` then also apply to the photos.

    Raises:
        InputError: as `read_extrinsics`, or the file has no valid P of that camera.
    """
    name = re.fullmatch(r"image_0?(\d)", photos.resolve().name)
    entries = _entries(file_checks.lines(path))
    if name is None or "Tr" not in entries:
        return None
    T, key = read_extrinsics(path), f"P{name[1]}"
    try:
        P = _numbers(entries[key]).reshape(3, 4)
        T[:3, 3] += np.linalg.solve(P[:, :3], P[:, 3])
        if not np.isfinite(T).all():
            raise ValueError("not finite")
    except (KeyError, ValueError, np.linalg.LinAlgError) as error:
        remedy = "Unpack the calibration again, or give T_camera_scanner of the photos' camera"
        raise InputError(path, f"has no valid `{key}` ({error})", remedy) from None
    return T


def read_camera(
    path: Path, width: int, height: int, *, names: Sequence[str] = (), rectified: bool = False, photos: str = ""
) -> Camera:
    """The camera for photos of a size, from `[[cameras]]` of a TOML file or tile, or another program's calibration.

    Args:
        path: the file (`camera_calibrations` lists the other programs), or the folder of a tile.
        width, height: size of the photos, pixels.
        names: what the photos' camera may be called in the file (an id, a topic), which decides between several.
        rectified: the photos are rectified: of ROS, the intrinsics of P count.
        photos: which photos have that size, for messages; "": all.

    Raises:
        InputError: no camera of that size, or several that differ, or it is invalid.
    """
    path = path / "tile.toml" if path.is_dir() else path
    found = camera_calibrations.read_cameras(path, (width, height)) if is_foreign(path) else _cameras(path)
    fitting = [one for one in found if (one.camera.width, one.camera.height) == (width, height)]
    if not fitting:
        raise _no_camera_of_size(path, found, width, height, photos)
    named = [one for one in fitting if not set(names).isdisjoint(one.names)] or fitting
    if len({one.camera for one in named}) > 1:
        cause = f"has several cameras of {width}x{height} ({', '.join(one.names[0] for one in named)})"
        wanted = f"Give the right one the id {' or '.join(filter(None, names))}" if any(names) else "Remove the others"
        raise InputError(path, cause, f"{wanted}, or give a file with one camera")
    raw = named[0].camera
    chosen = (named[0].rectified or (None if raw.distortion else raw)) if rectified else raw
    if chosen is None:
        raise InputError(
            path, "has the camera of raw images, but those of the bag are rectified",
            "Choose the topic of the raw images with --camera, or write the pinhole camera of P as [[cameras]]",
        )  # fmt: skip
    return camera_of(path, CameraEntry.model_validate(camera_entry(named[0].names[0], chosen)))  # checks its numbers


def camera_names(path: Path, width: int, height: int) -> set[str]:
    """What the cameras of a file are called in it; arguments and errors as of `read_camera`."""
    found = camera_calibrations.read_cameras(path, (width, height)) if is_foreign(path) else _cameras(path)
    return {name for one in found for name in one.names}


def _no_camera_of_size(
    path: Path, found: Sequence[CalibratedCamera], width: int, height: int, photos: str
) -> InputError:
    """The error of `read_camera`: the sizes that there are, and what to write if the photos were scaled."""
    sizes = ", ".join(f"{one.camera.width}x{one.camera.height}" for one in found) or "none"
    remedy = CAMERAS_REMEDY
    scaled = [one.camera for one in found if one.camera.width * height == one.camera.height * width]
    if scaled and scaled[0].fx > 0:
        c = scaled[0].resized(width, height)
        remedy = (
            "If the photos are scaled, not cropped, write a TOML file: [[cameras]] with "
            f"focal = [{c.fx:.3f}, {c.fy:.3f}], centre = [{c.cx:.3f}, {c.cy:.3f}], the same model and distortion"
        )
    elif any((one.camera.width, one.camera.height) == (height, width) for one in found):
        remedy = "The photos are turned by 90 degrees: turn them back without loss (`jpegtran -rotate 90`, or 270)"
    of = f"{width}x{height}" + (f", the size of {photos}" if photos else "")
    return InputError(path, f"has no camera of {of} (it has {sizes})", remedy)


def _cameras(path: Path) -> list[CalibratedCamera]:
    """Cameras of a TOML file.

    Raises:
        InputError: one is invalid.
    """
    try:
        entries = [CameraEntry.model_validate(entry) for entry in toml.table(path).get("cameras", [])]
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(path, f"field `cameras.{where}`: {first['msg']}", CAMERAS_REMEDY) from None
    except TypeError:
        raise InputError(path, "its `cameras` are not tables", CAMERAS_REMEDY) from None
    cameras = [(entry.id, camera_of(path, entry)) for entry in entries]
    return [CalibratedCamera((name,), camera, camera) for name, camera in cameras]


def camera_of_photos(
    photos: Path,
    *,
    model: str = "auto",
    focal: float | None = None,
    centre: tuple[float, float] | None = None,
    file: Path | None = None,
) -> Camera:
    """The camera of a folder of photos, from `file` (`read_camera`) or the given parameters.

    Args:
        photos: folder of the photos.
        model: "auto" (a photo with aspect ratio 2:1 and no focal length is equirectangular), "pinhole" or
            "equirectangular".
        focal, centre: pixels; default centre: the middle of the photo.
        file: file with cameras.

    Raises:
        InputError: no photos, or no focal length. SettingError: unknown model, or a file and a number are given.
    """
    if model not in ("auto", "pinhole", "equirectangular"):
        raise SettingError("camera", f"unknown model {model!r}", "Use auto, pinhole, equirectangular, or a file")
    first = list_files(photos, SUFFIXES, "photos")[0]
    width, height = size_of(first)
    if file is not None:
        for name, given in (("focal", focal), ("centre", centre)):
            if given is not None:
                raise SettingError(f"--{name}", "is given beside a file with the camera", "Leave one of them out")
        return read_camera(file, width, height, names=(photos.resolve().name,))
    if model == "auto" and focal is None and width == 2 * height:
        panorama.check(first, read_levels(first))
        model = "equirectangular"
    if model == "equirectangular":
        return Camera("equirectangular", width, height)
    if focal is None or not focal > 0:
        raise InputError(photos, "have no camera", "Give --focal (pixels), or a file with the camera")
    cx, cy = centre or ((width - 1) / 2, (height - 1) / 2)
    return Camera("pinhole", width, height, focal, focal, cx, cy)


def read_entry(path: Path, key: str, size: int, remedy: str) -> F64:
    """The `size` numbers after `key:` in a calibration file.

    Raises:
        InputError: the file is missing, or has no such entry.
    """
    try:
        values = _numbers(_entries(file_checks.lines(path, remedy)).get(key, ""))
    except ValueError:
        values = np.zeros(0)
    if values.size != size or not (np.abs(values) < MAX_VALUE).all():
        raise InputError(path, f"has no `{key}` with {size} numbers", "Unpack the calibration again")
    return values


def _entries(lines: Iterable[str]) -> dict[str, str]:
    """Texts after `key:` by key."""
    return {key.strip(): rest for key, colon, rest in (line.partition(":") for line in lines) if colon}


def _numbers(text: str) -> F64:
    return np.array(text.replace(",", " ").split(), np.float64)
