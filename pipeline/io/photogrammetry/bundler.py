"""Bundler models (bundle.out, v0.3), with their list of photos.

Cameras look along -z with y up; the origin is the middle of the image and its y axis points up. With P = R X + t and
p = -P / P.z, pixels are f (1 + k1 |p|2 + k2 |p|4) p. Rotating P by 180 degrees about x gives OpenCV's axes,
and the same coefficients.
Bundler stores no image sizes: they are read from the photos. A camera with f = 0 has no pose.

Source: Bundler v0.4 user's manual (https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html)
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.photogrammetry import Model, Photos, Shot
from scan2sim.pipeline.io.trajectory_columns import is_number

REMEDY = "Give Bundler's .out file (often bundle/bundle.out)"
FLIP = np.diag([1.0, -1.0, -1.0])


def read(model: Path, photos: Photos) -> Model:
    """Read a .out file; its list of photos is beside it, or one folder up: `list.txt`, or as `_names` lists."""
    path = next((model / p for p in ("bundle.out", "bundle/bundle.out") if (model / p).is_file()), model)
    lines = non_empty_lines(path)
    try:
        if not next(lines).startswith("# Bundle file"):
            raise ValueError("its first line is not `# Bundle file`")
        cameras, points = (int(value) for value in next(lines).split())
        if cameras < 1 or points < 0:
            raise ValueError(f"{cameras} cameras, {points} points")
        names = _names(path)
        if len(names) != cameras:
            raise InputError(
                path, f"has {cameras} cameras, but its list has {len(names)} photos", "Put its own list.txt beside it"
            )
        shots: list[Shot] = []
        lenses: dict[Camera, str] = {}
        for name in names:
            f, k1, k2 = parse_row(next(lines), 3)
            R = np.array([parse_row(next(lines), 3) for _ in range(3)])
            t = parse_row(next(lines), 3)
            if f > 0:
                key = camera_key(lenses, _camera(photos.size(name), f, k1, k2))
                shots.append(Shot(name, key, _pose(R, t)))
        xyz, rgb = [], []
        for _ in range(points):
            xyz.append(parse_row(next(lines), 3))
            rgb.append(parse_row(next(lines), 3))
            next(lines)  # its observations
    except StopIteration:
        raise InputError(path, "is truncated: it ends before its last camera or point", "Copy it again") from None
    except ValueError as error:
        raise InputError(path, f"is not a readable Bundler file ({str(error)[:100]})", REMEDY) from None
    unposed = len(names) - len(shots)
    note = (f"{unposed} photos without a pose are left out",) if unposed else ()
    cameras_by_name = {key: camera for camera, key in lenses.items()}
    colours = np.reshape(rgb, (-1, 3)).astype(np.uint8)
    return Model(cameras_by_name, tuple(shots), np.reshape(xyz, (-1, 3)), colours, notes=note)


def non_empty_lines(path: Path) -> Iterator[str]:
    """The lines of a text file that aren't empty, cut to at most 1 MiB each."""
    file_checks.check(path)
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            while line := file.readline(1 << 20):
                if line.strip():
                    yield line.strip()
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", REMEDY) from None


def parse_row(line: str, count: int) -> F64:
    """Parse the `count` numbers of a line."""
    values = np.array(line.split(), np.float64)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"expected {count} numbers in the line {line[:40]!r}")
    return values


def camera_key(known: dict[Camera, str], camera: Camera) -> str:
    """Key of a camera in `known`: of an equal camera, or a new key, which is added."""
    return known.setdefault(camera, f"camera_{len(known) + 1}")


def _names(path: Path) -> list[str]:
    """Names of the photos: a line each, which may end with `0` and the focal length by EXIF.

    The list has the name that Bundler, COLMAP (`bundle.list.txt`) or RealityCapture (`imagelist.lst`) gives it.
    """
    names = ("list.txt", f"{path.stem}.txt", f"{path.stem}.list.txt", f"{path.name}.list.txt", f"{path.stem}.lst")
    candidates = [folder / name for folder in (path.parent, path.parent.parent) for name in (*names, "imagelist.lst")]
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None:
        raise InputError(
            candidates[0], "file not found: Bundler's cameras have no names", "Put the list of photos there"
        )
    return [_without_number(_without_number(line)) for line in non_empty_lines(found)]


def _without_number(line: str) -> str:
    """A line without the number at its end, if it has one; names may contain blanks."""
    words = line.rsplit(maxsplit=1)
    return words[0] if len(words) > 1 and is_number(words[1]) else line


def _camera(size: tuple[int, int], f: float, k1: float, k2: float) -> Camera:
    width, height = size
    return Camera("opencv", width, height, f, f, width / 2 - 0.5, height / 2 - 0.5, (k1, k2, 0.0, 0.0))


def _pose(R: F64, t: F64) -> F64:
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise ValueError("a rotation matrix is invalid")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (FLIP @ R).T, -R.T @ t
    return pose
