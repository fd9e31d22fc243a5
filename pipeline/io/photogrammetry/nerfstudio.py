"""nerfstudio's `transforms.json`, as Polycam, Record3D, KIRI Engine, instant-ngp and others write it, too.

Poses are camera to world with OpenGL's axes (x right, y up, looking along -z); the world is z up. (0, 0) is the corner
of the top left pixel. Intrinsics are those of a frame, or shared. `applied_transform` and `applied_scale` map the
coordinates of the original program to those of the file: `applied_scale * (R x + t)`. They are undone: lengths are
metres if the original's were, and a cloud of the original program fits. The file's z axis remains up.

The cloud is `ply_file_path`, else the depth images (`pipeline.importers.depth_images`).

Source: nerfstudio's documentation (https://docs.nerf.studio/quickstart/data_conventions.html); its data parser for
`applied_scale` and the positions of pixels, instant-ngp's loader for `camera_angle_x`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.poses import nearest_rotation
from scan2sim.pipeline.core.types import F64, U8, Camera, Frame
from scan2sim.pipeline.geometry.similarity import Similarity
from scan2sim.pipeline.io import clouds, file_checks
from scan2sim.pipeline.io.images.image import SUFFIXES, size_of
from scan2sim.pipeline.io.photogrammetry import Model, Photos, Shot
from scan2sim.pipeline.io.photogrammetry.bundler import camera_key
from scan2sim.pipeline.io.tile_folder import without_parents

FILE = "transforms.json"
REMEDY = "Export it again, or give the transforms.json of a nerfstudio data set, or its folder"
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Order of `distortion_params`."""
CAPTURES = {
    "keyframes": ("raw data of Polycam", "Convert it: ns-process-data polycam --data CAPTURE.zip --output-dir FOLDER"),
    "EXR_RGBD": ("a capture of Record3D", "Convert it: ns-process-data record3d --data FOLDER --output-dir OTHER"),
    "rgbd": ("an unpacked .r3d of Record3D", "Export an EXR + RGB sequence, and convert it: ns-process-data record3d"),
    "sparse": ("a project of COLMAP", "Use scan2sim import colmap FOLDER/sparse/0 FOLDER/images"),
}
"""Folders in captures, what they belong to, and what to do."""
MAX_STRETCH = 0.01
"""Largest relative difference of the aspect ratio of an image to that of its intrinsics."""
MAX_NAMES = 3  # listed in a warning


def read(model: Path, photos: Photos) -> Model:
    """Read a transforms.json, or the one of a folder; frames without an image are left out."""
    path = model / FILE if model.is_dir() else model
    if not path.exists():
        _check_folder(model)
    body = _body(path)
    cameras: dict[Camera, str] = {}
    shots: list[Shot] = []
    missing: dict[str, list[str]] = {}
    try:
        undo, up = _original(body)
        for i, frame in enumerate(body["frames"]):
            name = str(frame["file_path"])
            values = {**body, **frame}
            file = _find(photos.folder, name, SUFFIXES)
            if file is None:
                missing.setdefault("have no image, and are left out", []).append(name)
                continue
            size = size_of(file)
            side = tuple(float(values.get(key) or length) for key, length in zip("wh", size, strict=True))
            if not (min(side) > 0 and abs(size[0] * side[1] / (size[1] * side[0]) - 1) < MAX_STRETCH):
                missing.setdefault("have an image of another shape than w x h, and are left out", []).append(name)
                continue
            camera = _camera(path, name, values, size, (side[0], side[1]))
            mask, depth = (_beside(path, frame, key, missing) for key in ("mask_path", "depth_file_path"))
            if mask is not None and size_of(mask) != size:
                missing.setdefault("have a mask of another size, which is ignored", []).append(name)
                mask = None
            pose = _pose(frame["transform_matrix"], f"frame {i} ({name})", undo)
            shots.append(
                Shot(file.relative_to(photos.folder).as_posix(), camera_key(cameras, camera), pose, mask, depth)
            )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        cause = f"no {error}" if isinstance(error, KeyError) else str(error)[:120]
        raise InputError(path, f"has missing or invalid values: {cause}", REMEDY) from None
    notes = [_listed(names, what) for what, names in missing.items()]
    if not shots:
        raise InputError(path, "has no frame with an image", f"Give the folder of its photos ({', '.join(notes)})")
    xyz, rgb = _points(path, body, notes)
    return Model(
        {key: camera for camera, key in cameras.items()},
        tuple(sorted(shots, key=lambda shot: shot.file)),
        undo.apply(xyz),
        rgb,
        up=up,
        notes=tuple(notes),
    )


def _check_folder(folder: Path) -> None:
    """Check that a folder isn't a capture from which nerfstudio first makes a transforms.json.

    Raises:
        InputError: it is one; names the command.
    """
    for inside, (what, remedy) in CAPTURES.items():
        if (folder / inside).exists():
            raise InputError(folder, f"is {what}, without a {FILE}", remedy)


def _listed(names: Sequence[str], what: str) -> str:
    more = ", ..." if len(names) > MAX_NAMES else ""
    return f"{len(names)} frames {what}: {', '.join(names[:MAX_NAMES])}{more}"


def _body(path: Path) -> dict[str, Any]:
    file_checks.check(path, REMEDY)
    try:
        body = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, f"is not readable JSON ({str(error)[:100]})", REMEDY) from None
    if not (isinstance(body, dict) and isinstance(body.get("frames"), list) and body["frames"]):
        raise InputError(path, "has no `frames`", REMEDY)
    return body


def _find(folder: Path, name: str, suffixes: Sequence[str] = ()) -> Path | None:
    """The file of a name in a folder: by its path, or the end of it, with or without its suffix."""
    parts = Path(without_parents(name.replace("\\", "/"))).parts
    for first in range(len(parts)):
        path = folder.joinpath(*parts[first:])
        for candidate in (path, *(path.with_name(path.name + suffix) for suffix in suffixes)):
            if candidate.is_file():
                return candidate
    return None


def _beside(path: Path, frame: Mapping[str, Any], key: str, missing: dict[str, list[str]]) -> Path | None:
    """The file that `key` of a frame names, beside the transforms.json; None without one."""
    if not frame.get(key):
        return None
    found = _find(path.parent, str(frame[key]))
    if found is None:
        missing.setdefault(f"have a `{key}` that doesn't exist", []).append(str(frame[key]))
    return found


def _camera(
    path: Path, name: str, values: Mapping[str, Any], size: tuple[int, int], side: tuple[float, float]
) -> Camera:
    """Camera of a photo of `size`, whose intrinsics are those of an image of `side`, width and height in pixels."""
    kind = "OPENCV_FISHEYE" if values.get("is_fisheye") else str(values.get("camera_model", "OPENCV"))
    if kind == "EQUIRECTANGULAR":
        return Camera("equirectangular", *size)
    if kind not in (*PERSPECTIVE, *FISHEYE):
        cause = f"{name} has the camera model {kind}, which is not supported"
        raise InputError(path, cause, f"Undistort the photos, or use {', '.join((*PERSPECTIVE, *FISHEYE))}")
    width, height = side
    sx, sy = size[0] / width, size[1] / height
    if "fl_x" in values:
        fx = float(values["fl_x"])
        fy = float(values.get("fl_y", fx))
    else:
        fx = _focal(width, values["camera_angle_x"])
        fy = _focal(height, values["camera_angle_y"]) if "camera_angle_y" in values else fx
    cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    listed = values.get("distortion_params")
    given = dict(zip(COEFFICIENTS, listed, strict=True)) if listed else values
    k1, k2, k3, k4, p1, p2 = (float(given.get(key, 0.0)) for key in COEFFICIENTS)
    if not (all(map(math.isfinite, (fx, fy, cx, cy, k1, k2, k3, k4, p1, p2))) and min(fx, fy) > 0):
        raise ValueError(f"the intrinsics of {name}")
    lens = (fx * sx, fy * sy, cx * sx - 0.5, cy * sy - 0.5)
    if kind in FISHEYE:
        return Camera("fisheye", *size, *lens, (k1, k2, k3, k4))
    if k4 or any(float(given.get(key, 0.0)) for key in ("k5", "k6")):
        raise InputError(path, f"{name}: k4, k5, k6 of a perspective camera are not supported", "Undistort the photos")
    if not any((k1, k2, k3, p1, p2)):
        return Camera("pinhole", *size, *lens)
    return Camera("opencv", *size, *lens, (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2))


def _focal(side: float, angle: Any) -> float:
    return 0.5 * side / math.tan(0.5 * float(angle))


def _matrix(values: Any, where: str) -> F64:
    """The upper rows (3, 4) of a transform."""
    matrix = np.array(values, np.float64)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise ValueError(f"{where} is not a matrix of 4 x 4 finite numbers")
    return matrix[:3]


def _original(body: Mapping[str, Any]) -> tuple[Similarity, tuple[float, float, float] | None]:
    """Similarity from the file's coordinates to the original ones, and the up direction there (None: +z)."""
    scale = float(body.get("applied_scale", 1.0))
    matrix = _matrix(body.get("applied_transform", np.eye(4)), "applied_transform")
    stretch = float(np.cbrt(np.linalg.det(matrix[:, :3])))
    if not (math.isfinite(scale) and scale > 0 and stretch > 1e-9):
        raise ValueError("applied_transform or applied_scale can't be undone")
    R = _rotation(matrix[:, :3] / stretch, "applied_transform")
    undo = Similarity(1 / (scale * stretch), R.T, -R.T @ matrix[:, 3] / stretch)
    x, y, z = R[2].tolist()
    return undo, None if z > 1 - 1e-9 else (x, y, z)


def _rotation(R: F64, where: str) -> F64:
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise ValueError(f"{where} is not a rotation")
    return nearest_rotation(R)


def _pose(values: Any, where: str, undo: Similarity) -> F64:
    """Pose (4, 4), camera (x right, y down, z forward) to original coordinates."""
    matrix = _matrix(values, f"transform_matrix of {where}")
    pose = np.eye(4)
    R = _rotation(matrix[:, :3], f"transform_matrix of {where}")
    pose[:3, :3] = undo.rotation @ R @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = undo.apply(matrix[None, :, 3])[0]
    return pose


def _points(path: Path, body: Mapping[str, Any], notes: list[str]) -> tuple[F64, U8 | None]:
    """Points (N, 3) of `ply_file_path` in the file's coordinates, and their colours."""
    name = body.get("ply_file_path")
    file = _find(path.parent, str(name)) if name else None
    if name and file is None:
        notes.append(f"its cloud {name} doesn't exist")
    if file is None:
        return np.empty((0, 3)), None
    parts = list(clouds.chunks(file, Frame()))
    rgb = [part.rgb for part in parts if part.rgb is not None]
    xyz = np.concatenate([np.empty((0, 3)), *(part.frame.to_crs(part.xyz) for part in parts)])
    return xyz, np.concatenate(rgb) if rgb and len(rgb) == len(parts) else None
