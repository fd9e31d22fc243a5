"""Pix4D's calibrated camera parameters (PROJECT_calibrated_camera_parameters.txt, of the folder 1_initial/params).

For each photo: name and size; the matrix K; three radial and two tangential coefficients, which are OpenCV's k1, k2, k3
and p1, p2; the position t and the rotation R of the camera model m = K [R | -Rt] X, with OpenCV's axes. Positions are
relative to PROJECT_offset.xyz beside the file, in the project's output CRS (PROJECT_wkt.prj, if it was exported).
The centre of the top left pixel is (0.5, 0.5).

Source: https://support.pix4d.com/hc/en-us/articles/202977149 (parameters of the file),
https://support.pix4d.com/hc/en-us/articles/202559089 (camera model)
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io import tables
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.photogrammetry import Model, Photos, Shot
from scan2sim.pipeline.io.photogrammetry.bundler import camera_key, parse_row

ENDING = "_calibrated_camera_parameters.txt"
REMEDY = f"Give PROJECT{ENDING} (of the project's folder 1_initial/params), or its folder"
HEADER_END = "camera model"
"""Beginning of the last line of the header."""
LINES_PER_PHOTO = 10


def read(model: Path, photos: Photos) -> Model:
    """Read the file, or the only one in a folder; the offset and the CRS are beside it."""
    path = _file(model)
    lines = [line.strip() for line in tables.read_text(path).splitlines() if line.strip()]
    first = next((i + 1 for i, line in enumerate(lines) if line.lower().startswith(HEADER_END)), 0)
    if not lines or not first or not lines[0].lower().startswith("filename"):
        raise InputError(path, "is not a file of calibrated camera parameters", REMEDY)
    if (len(lines) - first) % LINES_PER_PHOTO:
        raise InputError(path, "is truncated: it ends within a photo", "Copy it again")
    project = path.name.removesuffix(ENDING)
    offset, notes = _offset(path.with_name(f"{project}_offset.xyz"))
    lenses: dict[Camera, str] = {}
    shots: list[Shot] = []
    for at in range(first, len(lines), LINES_PER_PHOTO):
        try:
            name, camera, pose = _photo(iter(lines[at : at + LINES_PER_PHOTO]))
        except ValueError as error:
            raise InputError(path, f"photo {lines[at]:.60}: {str(error)[:100]}", "Export it again") from None
        pose[:3, 3] += offset
        shots.append(Shot(name, camera_key(lenses, camera), pose))
    cameras = {key: camera for camera, key in lenses.items()}
    crs, crs_notes = _crs(path.with_name(f"{project}_wkt.prj"))
    return Model(cameras, tuple(shots), np.empty((0, 3)), crs=crs, notes=notes + crs_notes)


def _file(model: Path) -> Path:
    if not model.is_dir():
        return model
    found = sorted(model.glob(f"*{ENDING}"))
    if len(found) != 1:
        raise InputError(model, f"contains {len(found)} files *{ENDING}", REMEDY)
    return found[0]


def _photo(lines: Iterator[str]) -> tuple[str, Camera, F64]:
    """Name, camera and pose (4, 4) to the project's coordinates of a photo.

    Raises:
        ValueError: a line isn't as expected.
    """
    name, width, height = next(lines).rsplit(maxsplit=2)
    K = np.array([parse_row(next(lines), 3) for _ in range(3)])
    k1, k2, k3 = parse_row(next(lines), 3)
    p1, p2 = parse_row(next(lines), 2)
    t = parse_row(next(lines), 3)
    R = np.array([parse_row(next(lines), 3) for _ in range(3)])
    if not (K[0, 0] > 0 and K[1, 1] > 0) or K[0, 1] or K[1, 0] or (K[2] != (0, 0, 1)).any():
        raise ValueError("its matrix K is invalid, or has skew")
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise ValueError("its rotation matrix is invalid")
    distortion = (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2)
    intrinsics = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]) - 0.5, float(K[1, 2]) - 0.5
    camera = Camera("opencv", int(width), int(height), *intrinsics, tuple(map(float, distortion)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T, t
    return name, camera, pose


def _offset(path: Path) -> tuple[F64, tuple[str, ...]]:
    """Offset (3,) of the project's coordinates, and a note if the file is missing."""
    if not path.is_file():
        return np.zeros(3), (f"there is no {path.name} beside it: positions are those of the project, without offset",)
    try:
        return parse_row(tables.read_text(path).replace(",", " "), 3), ()
    except ValueError as error:
        raise InputError(path, f"is not an offset ({error})", "Export it again: three numbers") from None


def _crs(path: Path) -> tuple[str | None, tuple[str, ...]]:
    """The project's output CRS, if it was exported, and a note if it can't be read."""
    from pyproj.exceptions import CRSError

    if not path.is_file():
        return None, ()
    try:
        return crs_io.short(tables.read_text(path).strip()), ()
    except CRSError as error:
        return None, (f"the CRS in {path.name} can't be read ({str(error)[:80]}) and counts as none",)
