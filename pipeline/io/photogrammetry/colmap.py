"""COLMAP models (text or binary): cameras, images, points3D.

COLMAP stores world-to-camera poses with OpenCV's axes, and the centre of its top left pixel is (0.5, 0.5): the reader
inverts poses and shifts principal points by half a pixel. Models with `rigs` and `frames` have their poses there
(`pipeline.io.colmap_rigs`).

Source: https://colmap.github.io/format.html, https://colmap.github.io/cameras.html
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera, CameraModel
from scan2sim.pipeline.io import colmap_rigs, file_checks
from scan2sim.pipeline.io.photogrammetry import Model, Photos, Shot
from scan2sim.pipeline.io.trajectory_columns import is_number

# COLMAP's camera model: ours, number of focal lengths, indices of COLMAP's coefficients among ours
MODELS: dict[str, tuple[CameraModel, int, tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": ("pinhole", 1, ()),
    "PINHOLE": ("pinhole", 2, ()),
    "SIMPLE_RADIAL": ("opencv", 1, (0,)),
    "RADIAL": ("opencv", 1, (0, 1)),
    "OPENCV": ("opencv", 2, (0, 1, 2, 3)),
    "FULL_OPENCV": ("opencv", 2, (0, 1, 2, 3, 4, 5, 6, 7)),
    "SIMPLE_FISHEYE": ("fisheye", 1, ()),
    "FISHEYE": ("fisheye", 2, ()),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, (0,)),
    "RADIAL_FISHEYE": ("fisheye", 1, (0, 1)),
    "OPENCV_FISHEYE": ("fisheye", 2, (0, 1, 2, 3)),
}


# camera models of binary files, indexed by their id: name and number of parameters
BINARY_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4),
    ("EUCM", 6), ("EQUIRECTANGULAR", 2),
)  # fmt: skip


class ColmapCamera(NamedTuple):
    """A camera as stored by COLMAP."""

    camera_id: int
    model_name: str
    width: int
    height: int
    params: tuple[float, ...]


class ColmapImage(NamedTuple):
    """A photo: its id, its camera, and its pose (4, 4) world to camera."""

    image_id: int
    camera_id: int
    name: str
    pose: F64


MAX_POSE_DIFFERENCE = 1e-4
"""Distance of the poses of `images` from those of frames, as a share of the extent, that is no difference."""
Point = tuple[int, tuple[float, ...], tuple[int, ...]]
"""Id, coordinates, colour."""


def read(model: Path, photos: Photos) -> Model:
    """Read a folder with cameras, images, points3D and, if it has them, rigs and frames: .bin or .txt (`sparse/0`).

    Raises:
        InputError: a file is missing or damaged, or a camera model isn't supported.
    """
    suffix = next((end for end in (".bin", ".txt") if (model / f"cameras{end}").is_file()), None)
    if suffix is None:
        raise InputError(
            model, "contains no COLMAP model (no cameras.bin or cameras.txt)", "Give its folder, often sparse/0"
        )
    parsers: Any = (_cameras, _images, _points) if suffix == ".bin" else (_camera_lines, _image_lines, _point_lines)
    names = [model / f"{name}{suffix}" for name in ("cameras", "images", "points3D")]
    colmap_cameras, images, points = (_parsed(file, parse) for file, parse in zip(names, parsers, strict=True))
    cameras = {camera.camera_id: camera for camera in colmap_cameras}
    images, notes = _with_poses_of_frames(model, suffix, images)
    images.sort(key=lambda image: image.name)
    points.sort()
    used = sorted({image.camera_id for image in images})
    if not cameras.keys() >= set(used):
        raise InputError(names[1], "refers to a camera that is missing in cameras.*", "Export the model again")
    return Model(
        {f"camera_{key}": camera_of(model, cameras[key]) for key in used},
        tuple(
            Shot(image.name, f"camera_{image.camera_id}", np.asarray(np.linalg.inv(image.pose), np.float64))
            for image in images
        ),
        np.array([xyz for _, xyz, _ in points], np.float64).reshape(-1, 3),
        np.array([rgb for _, _, rgb in points], np.uint8).reshape(-1, 3),
        notes=notes,
    )


def _with_poses_of_frames(
    model: Path, suffix: str, images: list[ColmapImage]
) -> tuple[list[ColmapImage], tuple[str, ...]]:
    """Images with the poses of the model's rigs and frames, if it has them; and a note if those of `images` differ."""
    files = [model / f"{name}{suffix}" for name in ("rigs", "frames")]
    if not any(file.exists() for file in files):
        return images, ()
    binary = suffix == ".bin"
    rigs = _parsed(files[0], colmap_rigs.rigs if binary else lambda lines: colmap_rigs.rig_lines(_rows(lines)))
    frames = _parsed(files[1], colmap_rigs.frames if binary else lambda lines: colmap_rigs.frame_lines(_rows(lines)))
    try:
        poses = colmap_rigs.world_to_camera(rigs, frames)
    except ValueError as error:
        raise InputError(files[1], f"doesn't fit {files[0].name} ({error})", "Export the model again") from None
    placed = [image._replace(pose=poses.get(image.image_id, image.pose)) for image in images]
    centres = [np.linalg.inv([one.pose for one in part])[:, :3, 3] for part in (images, placed) if part]
    apart = float(np.linalg.norm(centres[0] - centres[1], axis=1).max()) if centres else 0.0
    if apart < MAX_POSE_DIFFERENCE * (1 + float(np.ptp(centres[1], axis=0).max() if centres else 0)):
        return placed, ()
    note = (
        f"the poses of {files[0].name} and {files[1].name} are used; images{suffix} has others, up to {apart:.3g} off"
    )
    return placed, (note,)


def camera_of(model: Path, camera: ColmapCamera) -> Camera:
    """Convert a camera of COLMAP.

    Raises:
        InputError: its camera model isn't supported.
    """
    kind = camera.model_name
    if kind == "EQUIRECTANGULAR":
        return Camera("equirectangular", camera.width, camera.height)
    if kind not in MODELS:
        raise InputError(
            model,
            f"camera {camera.camera_id} has the model {kind}, which is not supported",
            "Undistort the photos (`colmap image_undistorter`), or use one of " + ", ".join(MODELS),
        )
    ours, focals, indices = MODELS[kind]
    p = [float(value) for value in camera.params]
    fx, fy, cx, cy, *rest = [p[0], *p] if focals == 1 else p
    size = 0 if ours == "pinhole" or not indices else 8 if max(indices) > 3 else 4
    distortion = [0.0] * size
    for at, value in zip(indices, rest, strict=True):
        distortion[at] = value
    return Camera(ours, camera.width, camera.height, fx, fy, cx - 0.5, cy - 0.5, tuple(distortion))


def _parsed(file: Path, parse: Callable[[Any], Iterator[Any]]) -> list[Any]:
    """All records of a file, binary or text."""
    try:
        data = file_checks.check(file, "Export the model again").read_bytes()
        return list(parse(data if file.suffix == ".bin" else data.decode().split("\n")))
    except OSError as error:
        raise InputError(file, f"can't be read ({error.strerror})", "Export the model again") from None
    except (ValueError, IndexError, OverflowError, struct.error) as error:
        raise InputError(file, f"is not a readable COLMAP model ({error})", "Export the model again") from None


def _cameras(data: bytes) -> Iterator[ColmapCamera]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        key, number, width, height = struct.unpack_from("<IiQQ", data, at)
        if not 0 <= number < len(BINARY_MODELS):
            raise ValueError(f"camera {key} has the unknown model {number}")
        name, size = BINARY_MODELS[number]
        yield ColmapCamera(key, name, width, height, struct.unpack_from(f"<{size}d", data, at + 24))
        at += 24 + 8 * size


def _images(data: bytes) -> Iterator[ColmapImage]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        key, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(0, at + 64)
        yield _posed(key, camera, data[at + 64 : end].decode(), tuple(pose))
        (seen,) = struct.unpack_from("<Q", data, end + 1)  # observations: x, y, point
        at = end + 9 + 24 * seen
    if at > len(data):
        raise ValueError("it is truncated")


def _points(data: bytes) -> Iterator[Point]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        key, x, y, z, r, g, b, _, seen = struct.unpack_from("<Q3d3BdQ", data, at)
        yield key, (x, y, z), (r, g, b)
        at += 51 + 8 * seen  # the track: image, observation
    if at > len(data):
        raise ValueError("it is truncated")


def _camera_lines(lines: list[str]) -> Iterator[ColmapCamera]:
    for line in _rows(lines):
        key, name, width, height, *params = line.split()
        if len(params) != dict(BINARY_MODELS).get(name, len(params)):
            raise ValueError(f"camera {key} has {len(params)} parameters")
        yield ColmapCamera(int(key), name, int(width), int(height), tuple(map(float, params)))


def _image_lines(lines: list[str]) -> Iterator[ColmapImage]:
    """Photos; each is followed by a line of its observations, which may be empty and which other programs omit."""
    after_photo = False
    for line in lines:
        words = line.split()
        if line.startswith("#") or (after_photo and len(words) % 3 == 0 and all(map(is_number, words[:12]))):
            after_photo = after_photo and line.startswith("#")
        elif words:
            words = line.split(maxsplit=9)
            yield _posed(int(words[0]), int(words[8]), words[9].strip(), tuple(map(float, words[1:8])))
            after_photo = True


def _point_lines(lines: list[str]) -> Iterator[Point]:
    for line in _rows(lines):
        key, x, y, z, r, g, b, *_ = line.split()
        yield int(key), (float(x), float(y), float(z)), tuple(bytes((int(r), int(g), int(b))))


def _posed(key: int, camera: int, name: str, pose: tuple[float, ...]) -> ColmapImage:
    if not 1e-6 < math.hypot(*pose[:4]) < 1e6:
        raise ValueError(f"{name} has no rotation")
    return ColmapImage(key, camera, name, colmap_rigs.transform(pose))


def _rows(lines: Iterable[str]) -> Iterator[str]:
    return (line for line in lines if line.strip() and not line.startswith("#"))
