"""Files of lidar sweeps: points in scanner axes, and their times.

A sweep is a file of points: .bin (float32 values, as in KITTI or nuScenes), .pcd, .ply, .las or .laz.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Frame, Trajectory
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.label_sets import SEMANTIC_KITTI
from scan2sim.pipeline.io.point_chunks import to_uint16

SWEEP_SUFFIXES = (".bin", ".pcd", ".ply", ".las", ".laz")
BIN_LAYOUTS = {4: "x y z reflectance (KITTI)", 5: "x y z intensity ring (nuScenes)", 6: "x y z intensity time ring"}
"""Layouts of .bin files by their number of float32 values per point."""
MAX_COORDINATE = 10_000.0
"""Coordinates in scanner axes are below this, metres."""
MAX_RINGS = 1024
DEFAULT_RATE_HZ = 10.0
"""Sweep rate that is assumed if there are no times."""
MIN_NANOSECONDS = 1e17
"""File names that are integers above this are times in nanoseconds, smaller ones are frame numbers."""


class Sweep(NamedTuple):
    """`xyz` (N, 3) in scanner axes, `intensity` (N,), 0 if unknown, `rgb` (N, 3), `time` (N,) s, `classification` (N,).

    The last three are None if the file doesn't have them.
    """

    xyz: F32
    intensity: npt.NDArray[np.uint16]
    rgb: U8 | None = None
    time: F64 | None = None
    classification: U8 | None = None

    def between(self, near: float, far: float) -> Sweep:
        """The points between `near` and `far` metres from the scanner."""
        distance = np.linalg.norm(self.xyz, axis=1)
        return self.take(np.logical_and(distance >= near, distance <= far))

    def take(self, keep: Bools) -> Sweep:
        """The points selected by a mask (N,)."""
        columns: Any = (None if column is None else column[keep] for column in self)
        return Sweep(*columns)


def list_files(folder: Path, suffixes: Sequence[str] = SWEEP_SUFFIXES, what: str = "sweeps") -> list[Path]:
    """Files with the given suffixes in a folder, in natural order of their names (2 before 10); or the given file.

    Raises:
        InputError: there are none.
    """
    if folder.is_file() and folder.suffix.lower() in suffixes:
        return [folder]
    if not folder.exists():
        raise InputError(folder, "folder not found", file_checks.CHECK_PATH)
    inside = folder.iterdir() if folder.is_dir() else ()
    found = [p for p in inside if p.suffix.lower() in suffixes and not file_checks.hidden(p)]
    if not found:
        raise InputError(folder, f"contains no {what} ({' '.join(suffixes)})", f"Give the folder of the {what}")
    return sorted(found, key=lambda path: file_checks.natural_order(path.name))


def read_sweep(path: Path) -> Sweep:
    """Read the finite points of a sweep.

    Raises:
        InputError: missing, damaged, or of an unknown format.
    """
    kind = path.suffix.lower()
    if kind == ".bin":
        xyz, reflectance = read_bin(path)
        return Sweep(xyz, _intensities(reflectance))
    cloud = cloud_io.read(path, Frame())
    levels = np.zeros(len(cloud), np.uint16) if cloud.intensity is None else cloud.intensity
    return Sweep(cloud.xyz, levels, cloud.rgb, cloud.time).take(np.asarray(np.isfinite(cloud.xyz).all(axis=1)))


def write_sweep(path: Path, sweep: Sweep) -> None:
    """Write a sweep as a binary PLY, which `read_sweep` reads without loss."""
    columns: list[tuple[str, str, str, npt.NDArray[Any]]] = [
        *((axis, "float", "<f4", sweep.xyz[:, k]) for k, axis in enumerate("xyz")),
        ("intensity", "float", "<f4", sweep.intensity / np.float32(65535)),
    ]
    if sweep.time is not None:
        columns.append(("time", "double", "<f8", sweep.time))
    if sweep.rgb is not None:
        columns += [(name, "uchar", "u1", sweep.rgb[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    rows = np.empty(len(sweep.xyz), [(name, kind) for name, _, kind, _ in columns])
    for name, _, _, values in columns:
        rows[name] = values
    header = "".join(f"property {kind} {name}\n" for name, kind, _, _ in columns)
    with path.open("wb") as file:
        file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{header}end_header\n".encode())
        rows.tofile(file)


def read_bin(path: Path) -> tuple[F32, F32]:
    """Points (N, 3) in scanner axes and reflectance (N,), 0 to 1, of a sweep of float32 values (`BIN_LAYOUTS`).

    Raises:
        InputError: not such a file.
    """
    data = _bin_rows(path)[0]
    data = data[np.isfinite(data[:, :4]).all(axis=1)]
    reflectance = data[:, 3]
    largest = float(reflectance.max(initial=0))
    if largest > 1:  # of 8 or 16 bits
        reflectance = reflectance / np.float32(255 if largest <= 255 else 65535)
    return data[:, :3], np.clip(reflectance, 0, 1)


def read_labels(path: Path, points: int) -> U8:
    """(N,) class codes of the points of a sweep in a `.label` of SemanticKITTI: 16 bits of class, 16 of instance.

    Raises:
        InputError: it has another number of labels than the sweep has points.
    """
    labels = np.fromfile(file_checks.check(path), "<u4")
    if len(labels) != points or path.stat().st_size % 4:
        cause = f"has {len(labels):,} labels for a sweep of {points:,} points"
        raise InputError(path, cause, "Give the labels of these sweeps: a uint32 per point, by the same frame numbers")
    return SEMANTIC_KITTI.codes(labels & 0xFFFF).astype(np.uint8)


def reading(path: Path) -> str | None:
    """Note on the layout of a .bin sweep that isn't KITTI's; errors as `read_bin`."""
    layout = _bin_rows(path)[1] if path.suffix.lower() == ".bin" else BIN_LAYOUTS[4]
    return None if layout == BIN_LAYOUTS[4] else f"read as {layout}, by its values"


def _bin_rows(path: Path) -> tuple[F32, str]:
    """All values of a .bin sweep, a row for each point, and their layout: the first one that the values fit."""
    size = file_checks.check_data(path).stat().st_size
    fitting = [width for width in BIN_LAYOUTS if size % (4 * width) == 0]
    if not fitting:
        raise InputError(
            path, f"is not a sweep: {size:,} bytes are no whole number of points of 4 to 6 floats", "Copy it again"
        )
    data = np.fromfile(path, np.float32)
    for width in fitting:
        rows = data.reshape(-1, width)
        if _fits_bin(rows):
            return rows, BIN_LAYOUTS[width]
    texts = "; ".join(BIN_LAYOUTS[width] for width in fitting)
    raise InputError(path, f"is not a sweep: its values are not those of {texts}", "Convert it to PCD or PLY")


def _fits_bin(rows: F32) -> bool:
    """Whether rows are points: intensities aren't negative, rings are small integers, times are finite."""
    known = rows[np.isfinite(rows[:, :4]).all(axis=1)]
    if not len(known):
        return True
    intensity, last = known[:, 3], known[:, -1]
    in_range = np.abs(known[:, :3]).max() < MAX_COORDINATE and intensity.min() >= -1 and intensity.max() <= 65535
    rings = known.shape[1] == 4 or ((last >= -1).all() and last.max() < MAX_RINGS and (last == np.rint(last)).all())
    return bool(in_range and rings)


def _intensities(levels: npt.NDArray[Any]) -> npt.NDArray[np.uint16]:
    """Scale intensities of 0..1, 0..255 or more to 0..65535; zeros if there are none."""
    known = np.nan_to_num(levels)
    return to_uint16(known, float(known.min(initial=0)), float(known.max(initial=0)))


def read_times(path: Path) -> F64:
    """Times (N,) in seconds of a text file with one per line.

    Raises:
        InputError: it isn't one.
    """
    try:
        return np.loadtxt(file_checks.check(path), ndmin=1).astype(np.float64)
    except (OSError, ValueError) as error:
        raise InputError(path, f"is not a list of times ({error})", "Write seconds, one per line") from None


def file_times(paths: Sequence[Path], times: Path | None, what: str = "sweeps") -> F64 | None:
    """Time (N,) of each file in seconds, from a file of times or the file names; None if neither gives them.

    Raises:
        InputError: not a file of times, or their number differs from that of the files.
    """
    if times is not None:
        seconds = read_times(times)
        if seconds.shape != (len(paths),) or not np.isfinite(seconds).all():
            raise InputError(
                times, f"has {seconds.size} times for {len(paths)} {what}", "Write one time for each, in order"
            )
        return seconds
    names = [path.stem for path in paths]
    if all(name.isdigit() for name in names):
        numbers = [int(name) for name in names]
        return np.array([1e-9 * number for number in numbers]) if min(numbers) > MIN_NANOSECONDS else None
    fractions = all(re.fullmatch(r"-?\d+\.\d+", name) for name in names)
    return np.array([float(name) for name in names]) if fractions else None


def time_stem(time_ns: int) -> str:
    """Name of a file by its time: seconds with nine decimals, which `file_times` reads."""
    sign = "-" if time_ns < 0 else ""
    return f"{sign}{abs(time_ns) // 10**9}.{abs(time_ns) % 10**9:09d}"


def timestamps(
    files: Sequence[Path], times: Path | None, path: Trajectory, folder: Path, what: str = "sweeps", offset: float = 0.0
) -> F64:
    """Time (N,) of each file in the trajectory's clock, seconds: from `file_times`, else those of its poses.

    Raises:
        InputError: the times can't be determined.
    """
    given = file_times(files, times, what)
    if given is not None:
        return given + offset
    if len(files) == len(path):
        return path.times + offset
    names = [file.stem for file in files]
    if all(name.isdigit() for name in names) and max(map(int, names)) < len(path):
        return path.times[[int(name) for name in names]] + offset
    raise InputError(
        folder, f"has {len(files)} {what} for {len(path)} poses, and their names are not times",
        "Give their times in a file, seconds, one per line",
    )  # fmt: skip
