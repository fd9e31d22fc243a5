"""Point cloud readers: one module per format (`pipeline.core.plugins`), selected by the file's suffix.

A format's module has `SUFFIXES`, `read_header(path) -> (count, low, high, crs[, notes])`, and `parts(path)`, its points
in chunks (LAS instead: `read(path, frame)` and `chunks(path, frame, size)`); if its files name classes,
`class_names(path) -> (ours, names)`; and if its points have flags that the header doesn't count,
`flags(path) -> (withheld, overlap)`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from scan2sim.pipeline.core import classes, plugins
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import F64, U8, Frame, PointCloud
from scan2sim.pipeline.io import file_checks, foreign_files, mesh_files, point_chunks
from scan2sim.pipeline.io.point_chunks import Points, all_withheld

CHUNK_POINTS = 2_000_000
COPIED_SUFFIXES = (".las", ".laz", ".ply")
"""Files that are copied into a tile unchanged; other formats are converted to LAZ (`scan2sim import clouds`)."""
SIGNATURES = {
    b"LASF": (".las", "las"),
    b"ply\n": (".ply", "ply"),
    b"ply\r": (".ply", "ply"),
    b"# .PCD": (".pcd", "pcd"),
    b"ASTM-E57": (".e57", "e57"),
}
"""First bytes of cloud files: suffix and format."""
SUPPORTED_FORMATS = "LAS, LAZ, COPC, PLY, E57, PCD, PTX, XYZ (.xyz .csv .txt .asc .pts) or EPT (its ept.json)"

UNREADABLE_CRS = "its CRS can't be read"
"""Beginning of the note on a CRS that counts as none."""


@dataclass(frozen=True)
class Header:
    """Header of a cloud file.

    Attributes:
        count: number of points.
        low, high: (3,) bounds, CRS units, float64.
        crs: as WKT, or None.
        notes: warnings for the user: assumptions made to read the file, and tolerable errors in it.
    """

    count: int
    low: F64
    high: F64
    crs: str | None
    notes: tuple[str, ...] = ()


class Format(Protocol):
    """Interface of a format's module.

    Attributes:
        SUFFIXES: suffixes of its files, or whole file names.
    """

    SUFFIXES: tuple[str, ...]

    def read_header(self, path: Path) -> tuple[Any, ...]:
        """The fields of `Header`."""

    def parts(self, path: Path) -> Iterator[Points]:
        """All points in file order, in chunks."""


class CloudFormat(Protocol):
    """Interface of a format's module that makes clouds itself.

    Attributes:
        SUFFIXES: as in `Format`.
    """

    SUFFIXES: tuple[str, ...]

    def read_header(self, path: Path) -> tuple[Any, ...]:
        """The fields of `Header`."""

    def read(self, path: Path, frame: Frame) -> PointCloud:
        """See `read`."""

    def chunks(self, path: Path, frame: Frame, size: int) -> Iterator[PointCloud]:
        """See `chunks`."""


def formats() -> dict[str, str]:
    """Suffixes of cloud files (and whole names) to the formats that read them."""
    return plugins.by_suffix(__name__)


def is_cloud(path: Path) -> bool:
    """Whether a file's name is that of a cloud."""
    return not {path.suffix.lower(), path.name}.isdisjoint(formats())


def _reader(path: Path) -> Any:
    found = formats()
    name = found.get(path.name) or found.get(path.suffix.lower())
    if name is None and file_checks.check(path).suffix.lower() in mesh_files.SUFFIXES:
        remedy = f"Import the mesh: scan2sim import map {path} --out TILE"
        raise InputError(path, "is a mesh, not a point cloud", remedy)
    if name is None:
        cause = f"has an unknown cloud format ({path.suffix or 'no suffix'})"
        meshes = ", ".join(mesh_files.SUFFIXES)
        raise foreign_files.unread(path, cause, f"Use {SUPPORTED_FORMATS}; meshes ({meshes}) by scan2sim import map")
    file_checks.check_data(path)
    _check_suffix(path, name)
    reader = plugins.module(__name__, name)
    require(str(path), *plugins.needs(reader))
    return reader


def _check_suffix(path: Path, name: str) -> None:
    """Raise an error if a file's content is of another format than its suffix says."""
    with path.open("rb") as file:
        head = file.read(max(map(len, SIGNATURES)))
    for signature, (suffix, found) in SIGNATURES.items():
        if head.startswith(signature) and found != name:
            cause = f"is a {suffix[1:].upper()} file by its content, though its name ends in {path.suffix}"
            raise InputError(path, cause, f"Rename it to {path.stem}{suffix}")


def read_header(path: Path) -> Header:
    """Number of points, bounds and CRS; the points are read only if the format requires it.

    Raises:
        InputError: missing, truncated, or of an unknown format. UnavailableError: its library isn't installed.
    """
    return Header(*_reader(path).read_header(path))


def read(path: Path, frame: Frame) -> PointCloud:
    """Read a cloud into `frame`'s local coordinates; classes are the file's own codes (see `code_table`).

    Raises:
        InputError: missing, truncated, or of an unknown format. UnavailableError: its library isn't installed.
    """
    reader = _reader(path)
    if hasattr(reader, "parts"):
        return point_chunks.read_all(path, reader.parts(path), frame)
    cloud: PointCloud = reader.read(path, frame)
    return cloud


def left_out(declared: int, read: int) -> str:
    """Note on points that `read` leaves out though the header counts them; empty if there are none.

    Args:
        declared: number of points by the header.
        read: number of points that were read.
    """
    return f"{declared - read:,} withheld points are not used" if read < declared else ""


def flag_notes(path: Path) -> tuple[str, ...]:
    """Notes on points with the withheld or overlap flag of LAS; a header doesn't count them, all points are read.

    Raises:
        InputError: as `read`, or all points are withheld.
    """
    reader = _reader(path)
    if not hasattr(reader, "flags"):
        return ()
    withheld, overlap = reader.flags(path)
    if withheld == reader.read_header(path)[0]:
        raise all_withheld(path, withheld)
    second_line = f"{overlap:,} points have the overlap flag (a second flight line); they are used"
    return tuple(note for note in (left_out(withheld, 0), second_line if overlap else "") if note)


def code_table(path: Path, given: Mapping[int, int]) -> U8:
    """Lookup table (256,) from a cloud's class codes to those of `pipeline.core.classes`; `given` overrides it.

    Raises:
        InputError: as `read`.
    """
    reader = _reader(path)
    ours, names = reader.class_names(path) if hasattr(reader, "class_names") else (False, {})
    return classes.code_table(ours, names, given)


def chunks(path: Path, frame: Frame, size: int = CHUNK_POINTS) -> Iterator[PointCloud]:
    """A cloud's points in file order, `size` at a time.

    Args:
        path: the cloud.
        frame: only its CRS and unit are used; each chunk is in a frame of its own, with its origin near its points.
        size: points per chunk.

    Raises:
        InputError: missing, truncated (on reaching the end), or of an unknown format.
        UnavailableError: its library isn't installed.
    """
    reader = _reader(path)
    if hasattr(reader, "parts"):
        found = point_chunks.summary(path, reader.parts(path))
        yield from point_chunks.read_chunks(reader.parts(path), found, frame, size)
    else:
        yield from reader.chunks(path, frame, size)
