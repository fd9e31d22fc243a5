"""Point cloud files: one module a format, found by its name; each says whether it can run here.

A format's module has `read_header(path) -> (count, low, high, crs[, notes])`, `read(path, frame)` and
`chunks(path, frame, size)`, and, where it needs more than the project's own dependencies, `lacking()`: packages that
aren't installed, or None.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scan2sim.pipeline import classes
from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.extras import unavailable
from scan2sim.pipeline.io import files
from scan2sim.pipeline.types import F64, U8, Frame, PointCloud

CHUNK = 2_000_000
FORMATS = {
    ".las": "las", ".laz": "las", ".ply": "ply", ".e57": "e57", ".pcd": "pcd",
    ".xyz": "xyz", ".csv": "xyz", ".txt": "xyz", ".asc": "xyz", "ept.json": "ept",
}  # fmt: skip
"""Suffixes (and the one name) of cloud files, and the modules of `pipeline.io` that read them."""
AS_THEY_ARE = (".las", ".laz", ".ply")
"""What is taken into a tile as it is; clouds of other formats become LAZ there (`scan2sim import clouds`)."""
KNOWN = "LAS, LAZ, COPC, PLY, E57, PCD, XYZ (.xyz .csv .txt .asc) or EPT (its ept.json)"


@dataclass(frozen=True)
class Header:
    """What is known of a cloud file.

    Attributes:
        count: number of points.
        low, high: (3,) bounds, CRS units, float64.
        crs: as WKT, or None.
        notes: what had to be assumed to read it, and what is wrong with it, for the user.
    """

    count: int
    low: F64
    high: F64
    crs: str | None
    notes: tuple[str, ...] = ()


def known(path: Path) -> bool:
    """Whether a file's name is that of a cloud."""
    return path.suffix.lower() in FORMATS or path.name in FORMATS


def missing(suffix: str) -> str | None:
    """Packages that a format (a key of `FORMATS`) can't be read here without, or None."""
    module = importlib.import_module(f"scan2sim.pipeline.io.{FORMATS[suffix]}")
    found: str | None = module.lacking() if hasattr(module, "lacking") else None
    return found


def _reader(path: Path) -> Any:
    key = path.name if path.name in FORMATS else path.suffix.lower()
    if key not in FORMATS:
        raise InputError(path, f"is no known cloud format ({path.suffix or 'no suffix'})", f"Use {KNOWN}")
    files.check(path)
    lacking = missing(key)
    if lacking:
        raise unavailable(str(path), lacking)
    return importlib.import_module(f"scan2sim.pipeline.io.{FORMATS[key]}")


def read_header(path: Path) -> Header:
    """Number of points, bounds and CRS, without reading the points where the format allows it.

    Raises:
        InputError: missing, truncated, or of an unknown format. UnavailableError: its library isn't installed.
    """
    return Header(*_reader(path).read_header(path))


def read(path: Path, frame: Frame) -> PointCloud:
    """Read a cloud into `frame`'s local coordinates; its classes are the file's codes (see `meanings`).

    Raises:
        InputError: missing, truncated, or of an unknown format. UnavailableError: its library isn't installed.
    """
    cloud: PointCloud = _reader(path).read(path, frame)
    return cloud


def meanings(path: Path, given: Mapping[int, int]) -> U8:
    """Lookup table (256,) of what a cloud's class codes are here; `given` is the user's word (`pipeline.classes`).

    Raises:
        InputError: as `read`.
    """
    reader = _reader(path)
    ours, names = reader.class_names(path) if hasattr(reader, "class_names") else (False, {})
    return classes.meanings(ours, names, given)


def chunks(path: Path, frame: Frame, size: int = CHUNK) -> Iterator[PointCloud]:
    """A cloud's points in their order, `size` at a time.

    Args:
        path: of the cloud.
        frame: its CRS and unit count; each part is in a frame of its own, with its origin near its points.
        size: points.

    Raises:
        InputError: missing, truncated (on reaching the end), or of an unknown format.
        UnavailableError: its library isn't installed.
    """
    yield from _reader(path).chunks(path, frame, size)
