"""Point cloud files: a file a format (`pipeline.core.plugins`), found by the file's suffix.

A format's module has `SUFFIXES`, `read_header(path) -> (count, low, high, crs[, notes])`, `read(path, frame)` and
`chunks(path, frame, size)`, and, where classes have names in the file, `class_names(path) -> (ours, names)`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from scan2sim.pipeline.core import classes, plugins
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.types import F64, U8, Frame, PointCloud
from scan2sim.pipeline.io import file_checks

CHUNK = 2_000_000
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


class Format(Protocol):
    """What a format's module has.

    Attributes:
        SUFFIXES: ends of its files' names, or whole names.
    """

    SUFFIXES: tuple[str, ...]

    def read_header(self, path: Path) -> tuple[Any, ...]:
        """What `Header` takes."""

    def read(self, path: Path, frame: Frame) -> PointCloud:
        """See `read`."""

    def chunks(self, path: Path, frame: Frame, size: int) -> Iterator[PointCloud]:
        """See `chunks`."""


def formats() -> dict[str, str]:
    """Suffixes of cloud files, and one name, to the formats that read them."""
    return plugins.by_suffix(__name__)


def known(path: Path) -> bool:
    """Whether a file's name is that of a cloud."""
    return not {path.suffix.lower(), path.name}.isdisjoint(formats())


def _reader(path: Path) -> Any:
    found = formats()
    name = found.get(path.name) or found.get(path.suffix.lower())
    if name is None:
        raise InputError(path, f"is no known cloud format ({path.suffix or 'no suffix'})", f"Use {KNOWN}")
    file_checks.check(path)
    reader = plugins.module(__name__, name)
    need(str(path), *plugins.needs(reader))
    return reader


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
    """Lookup table (256,) of what a cloud's class codes are here; `given` is the user's word (`pipeline.core.classes`).

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
