"""Point cloud files: LAS, LAZ and COPC through laspy, PLY through trimesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.io import las, ply
from scan2sim.pipeline.types import F64, Frame, PointCloud


@dataclass(frozen=True)
class Header:
    """What a cloud file says of itself: number of points, bounds (CRS units, float64), CRS as WKT or None."""

    count: int
    low: F64
    high: F64
    crs: str | None


READERS = {".las": las, ".laz": las, ".ply": ply}


def _reader(path: Path):  # type: ignore[no-untyped-def]  # a module
    try:
        return READERS[path.suffix.lower()]
    except KeyError:
        raise InputError(
            path, f"is no known cloud format ({path.suffix or 'no suffix'})", "Use LAS, LAZ, COPC or PLY"
        ) from None


def read_header(path: Path) -> Header:
    """Number of points, bounds and CRS, without reading the points where the format allows it.

    Raises:
        InputError: missing, truncated, or of an unknown format.
    """
    return Header(*_reader(path).read_header(path))


def read(path: Path, frame: Frame) -> PointCloud:
    """Read a cloud into `frame`'s local coordinates.

    Raises:
        InputError: missing, truncated, or of an unknown format.
    """
    return _reader(path).read(path, frame)


def chunks(path: Path, frame: Frame, size: int = las.CHUNK) -> Iterator[PointCloud]:
    """A cloud's points in their order, `size` at a time; a PLY file's all at once.

    Args:
        path: of the cloud.
        frame: its CRS and unit count; each part is in a frame of its own, with its origin near its points.
        size: points.

    Raises:
        InputError: missing, truncated (on reaching the end), or of an unknown format.
    """
    if _reader(path) is las:
        yield from las.chunks(path, frame, size)
    else:
        header = read_header(path)
        x, y, z = np.floor((header.low + header.high) / 2 * frame.unit).tolist()
        yield read(path, replace(frame, origin=(x, y, z)))
