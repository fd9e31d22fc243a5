"""Trajectory files, one format per suffix; their positions are CRS coordinates of a `Frame`.

| suffix | content |
| --- | --- |
| .csv | a header line, then time,x,y,z[,qx,qy,qz,qw][,unsure][,sx,sy,sz[,srx,sry,srz]]: all but correlations; tables of other programs, with or without a header line (`trajectory_columns`) |
| .tum | time x y z qx qy qz qw per line, the format of the TUM benchmark and evo |
| .kitti | 12 numbers per line, row-major 3x4; ten poses per second unless times are given |
| .out, .sbet | SBET of a GNSS/INS, projected to the CRS; read-only (`pipeline.io.sbet`) |
| .geojson | the path in WGS84, and a point for each unsure section; write-only |

Quaternions rotate sensor axes to world axes, scalar last. `sx` to `sz` are standard deviations in the CRS's unit,
`srx` to `srz` in radians. The format of files with other suffixes is detected from their first line. Times since the
epoch in milli-, micro- or nanoseconds become seconds; lines that repeat the previous one are left out.
"""  # noqa: E501

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError, SettingError, from_os_error
from scan2sim.pipeline.core.poses import nearest_rotation
from scan2sim.pipeline.core.types import F64, Frame, Trajectory
from scan2sim.pipeline.io import file_checks, foreign_files, sbet, tables
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.trajectory_columns import MATRIX, UNNAMED, is_number, named, seconds, unnamed

POSITION_COLUMNS = ("time", "x", "y", "z")
QUATERNION_COLUMNS = ("qx", "qy", "qz", "qw")
SIGMA_COLUMNS = ("sx", "sy", "sz", "srx", "sry", "srz")
REMEDIES = {
    ".csv": "Write a CSV: a header line, then time,x,y,z[,qx,qy,qz,qw] per line, CRS coordinates",
    ".tum": "Write time x y z qx qy qz qw per line",
    ".kitti": "Write 12 numbers per line, row-major 3x4",
}
GPS_REMEDY = "Project it to the clouds' CRS (time,x,y,z); `import sweeps` and `import images` take it by --gps"
KITTI_RATE_HZ = 10.0  # KITTI's cameras: 10 poses per second
MAX_COORDINATE_M = 1e9
"""Plausibility limit: no position is farther from the origin of a CRS."""
TEXT_SUFFIXES = (".csv", ".txt", ".asc", ".xyz")
"""Suffixes of texts that may be a trajectory or a cloud."""
HEAD_BYTES = 1 << 16
"""Part of a text by which a trajectory is recognized."""
QuaternionOrder = Literal["xyzw", "wxyz"]
QUATERNIONS_HELP = "Order of the trajectory's quaternions: xyzw as documented, or wxyz."
Lines = list[tuple[int, list[str]]]  # line number in the file, from 1 on, and cells


def read(
    path: Path, frame: Frame | None = None, *, times: F64 | None = None, ordered: bool = True, timed: bool = False
) -> Trajectory:
    """Read a trajectory into local coordinates of `frame` (default: coordinates of the file are kept).

    Args:
        path: trajectory file.
        frame: CRS and unit of the file's positions, and the local origin.
        times: (T,) seconds, for a .kitti file, which has none.
        ordered: require ascending times; otherwise poses are sorted by time.
        timed: require times, rather than assume `KITTI_RATE_HZ`.

    Raises:
        InputError: unreadable, empty, NaN, wrong columns, times out of order, invalid rotation; names file and line.
    """
    frame = frame or Frame()
    if sbet.is_sbet(path):
        return sbet.read(path, frame)
    kind, lines = _lines(path, _text(path))
    trajectory, lines = _from_lines(path, kind, lines, frame, times, timed)
    far = np.flatnonzero(~(np.abs(trajectory.positions) < MAX_COORDINATE_M).all(axis=1))
    if len(far):
        raise _bad(path, kind, lines[far[0]][0], "its position is out of range", "Remove lines without a pose")
    order = np.argsort(trajectory.times, kind="stable")
    if ordered and (np.diff(trajectory.times) <= 0).any():
        late = int(np.flatnonzero(np.diff(trajectory.times) <= 0)[0]) + 1
        number = lines[late][0] if late < len(lines) else late + 1
        raise _bad(
            path, kind, number, "its time is not after that of the previous line", "Sort by time, without duplicates"
        )
    return trajectory if ordered else _select(trajectory, order)


def is_trajectory(path: Path) -> bool:
    """Whether a file is a trajectory by its suffix, or a text whose first lines are poses with rotations."""
    suffix = path.suffix.lower()
    if suffix in (".tum", ".kitti"):
        return True
    if suffix not in TEXT_SUFFIXES:
        return False
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    text = head.decode("utf-8-sig", "replace")
    if len(head) == HEAD_BYTES:
        text = text.rpartition("\n")[0]
    try:
        found, _ = _from_lines(path, *_lines(path, text), Frame(), None, False)
    except InputError:
        return False
    return found.rotations is not None


def read_local(path: Path, crs: str, quaternions: QuaternionOrder = "xyzw") -> tuple[Trajectory, Frame]:
    """Read a trajectory, local to a frame with its origin near the first pose.

    Args:
        path: trajectory file.
        crs: CRS of its positions.
        quaternions: order of its quaternions.

    Raises:
        InputError: it can't be read, has no rotations, or `crs` is not a projected CRS.
    """
    file_checks.check(path)
    known, unit = crs_io.common(path, crs, None, (), ())
    poses = read(path, Frame(known, unit=unit))
    if poses.rotations is None:
        raise InputError(path, "has only positions", "Give a trajectory with rotations: time,x,y,z,qx,qy,qz,qw")
    x, y, z = np.floor(poses.positions[0]).tolist()
    frame = Frame(known, (x, y, z), unit)
    local = Trajectory(poses.times, poses.positions - frame.origin, poses.rotations, poses.unsure)
    return (local if quaternions == "xyzw" else reordered(local, "wxyz")), frame


def reordered(path: Trajectory, order: QuaternionOrder) -> Trajectory:
    """The trajectory whose quaternions were read in the other order than `order`, read in `order`."""
    from scipy.spatial.transform import Rotation

    assert path.rotations is not None
    rolled = np.roll(Rotation.from_matrix(path.rotations).as_quat(), -1 if order == "wxyz" else 1, axis=1)
    return replace(path, rotations=Rotation.from_quat(rolled).as_matrix())


def write(path: Path, trajectory: Trajectory, frame: Frame | None = None) -> None:
    """Write a trajectory (positions local to `frame`) in the format of the path's suffix, atomically.

    Raises:
        SettingError: unknown suffix; the format needs rotations but there are none; GeoJSON without a CRS.
        DataError: the trajectory is empty or contains NaN.
        SpaceError: the disk is full or not writable.
    """
    frame = frame or Frame()
    writers = {".csv": _to_csv, ".tum": _to_tum, ".kitti": _to_kitti, ".geojson": _to_geojson}
    kind = path.suffix.lower()
    if kind not in writers:
        raise SettingError(path, "has an unknown trajectory format", f"Use one of the suffixes {', '.join(writers)}")
    if kind in (".tum", ".kitti") and trajectory.rotations is None:
        raise SettingError(path, "needs rotations, but the trajectory has only positions", "Write .csv or .geojson")
    if not len(trajectory) or not all(np.isfinite(part).all() for part in (trajectory.times, trajectory.positions)):
        raise DataError(path, "the trajectory is empty or contains NaN", "Remove invalid poses")
    text = writers[kind](path, trajectory, frame)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Temporary path beside `path`: renamed to `path` when the block succeeds, deleted when it raises.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise from_os_error(error, path) from error
    finally:
        temporary.unlink(missing_ok=True)


def _bad(path: Path, kind: str, line: int, cause: str, remedy: str | None = None) -> InputError:
    return InputError(path, f"is not a valid trajectory (line {line}: {cause})", remedy or REMEDIES[kind])


def _text(path: Path) -> str:
    if path.suffix.lower() == ".geojson":
        raise InputError(path, "is GeoJSON, which can only be written", "Give the .csv beside it")
    file_checks.check(path)
    try:
        return tables.read_text(path)
    except InputError as error:  # binary, such as SBET
        raise foreign_files.unread(path, error.cause, error.remedy) from None


def _lines(path: Path, text: str) -> tuple[str, Lines]:
    """Format of a file's text and its lines, without blank ones and comments (except a header line)."""
    kind = path.suffix.lower()
    filled = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    plain = [(i, line) for i, line in filled if not line.lstrip().startswith("#")]
    if not plain:
        raise InputError(path, "is not a trajectory (it contains no poses)", REMEDIES.get(kind, REMEDIES[".csv"]))
    delimiter, decimal_commas = tables.separators(plain[-1][1])
    if kind not in REMEDIES or delimiter in (",", ";"):
        width = len(plain[0][1].split())
        kind = ".csv" if delimiter in (",", ";") else {8: ".tum", 12: ".kitti"}.get(width, ".csv")
    if kind != ".csv" and not is_number(plain[0][1].split()[0]):
        kind = ".csv"  # a header line without #
    if kind == ".tum" and (names := _other_order([line for _, line in filled[: filled.index(plain[0])]])):
        kind, plain = ".csv", [(0, (delimiter or " ").join(names)), *plain]
    elif kind == ".csv":
        plain = filled[:1] + [line for line in plain if line not in filled[:1]]
    if decimal_commas:
        plain = [(i, line.replace(",", ".")) for i, line in plain]
    return kind, [(i, line.split(delimiter)) for i, line in plain]


def _from_lines(
    path: Path, kind: str, lines: Lines, frame: Frame, times: F64 | None, timed: bool
) -> tuple[Trajectory, Lines]:
    """Poses in the order of the file, and their lines: those that repeat the previous one are left out."""
    if kind == ".kitti":
        if timed and times is None:
            raise InputError(path, "has no times", REMEDIES[".csv"])
        return _from_kitti(path, lines, frame, times), lines
    columns: tuple[str, ...] = POSITION_COLUMNS + QUATERNION_COLUMNS
    if kind == ".csv":
        columns, lines = _header_line(path, lines)
    if {"time", "sec"} & set(columns):  # without times, repeated lines are those of a stationary vehicle
        lines = [one for one, before in zip(lines, [(0, [""]), *lines], strict=False) if one[1] != before[1]]
    return _from_columns(path, kind, columns, lines, frame, times, timed), lines


def _other_order(comments: Sequence[str]) -> list[str]:
    """Names of the columns of TUM in another order (`# timestamp tx ty tz qw qx qy qz`); empty without any."""
    for line in comments:
        names = re.split(r"[,;\s]+", line.strip(" #%\t,;"))
        found = named(names)
        if len(found) == 8 and {*found} == {*UNNAMED[8]} and found != UNNAMED[8]:
            return names
    return []


def _header_line(path: Path, lines: Lines) -> tuple[tuple[str, ...], Lines]:
    """Our names of the columns of a table, empty for those that aren't read; and the lines after its header line."""
    number, cells = lines[0]
    first = cells[0].lstrip()
    if not first.startswith(("#", "%")) and (found := unnamed(cells)) is not None:
        return found, lines
    if all(is_number(cell) for cell in cells):
        raise _bad(path, ".csv", number, f"it has {len(cells)} columns and no header line with their names")
    names = named(cells)
    if len(lines) < 2:
        raise InputError(path, "is not a trajectory (it contains no poses)", REMEDIES[".csv"])
    duplicate = next((name for name in names if name and names.count(name) > 1), None)
    if duplicate is not None:
        raise _bad(path, ".csv", number, f"two columns are named `{duplicate}`")
    timed = "time" in names or {"sec", "nanosec"} <= set(names)
    if timed and set("xyz") <= set(names):
        partial = {
            "rotation": QUATERNION_COLUMNS,
            "position deviation": SIGMA_COLUMNS[:3],
            "rotation deviation": SIGMA_COLUMNS[3:],
        }
        for what, columns in partial.items():
            if 0 < len(set(columns) & set(names)) < len(columns):
                raise _bad(path, ".csv", number, f"its {what} needs all of {','.join(columns)}")
        return names, lines[1:]
    if first.startswith("#") and (found := unnamed(lines[1][1])) is not None:
        return found, lines[1:]  # the first line is a comment
    listed = f"columns are {','.join(cell.strip() for cell in cells)[:80]}"
    if any(cell.strip(" #").lower().startswith("lat") for cell in cells):
        raise InputError(path, f"is a GPS track, not a trajectory ({listed})", GPS_REMEDY)
    raise _bad(path, ".csv", number, listed)


def _numbers(path: Path, kind: str, lines: Lines, width: int, used: Sequence[int] | None = None) -> F64:
    """Parse the cells of all lines, of `width` cells each, in the columns `used` (default: all): (T, len(used))."""
    columns = range(width) if used is None else used
    rows = np.empty((len(lines), len(columns)))
    for i, (number, cells) in enumerate(lines):
        if len(cells) != width:
            raise _bad(path, kind, number, f"{len(cells)} columns, expected {width}")
        try:
            rows[i] = [float(cells[k]) for k in columns]
        except ValueError as error:
            raise _bad(path, kind, number, str(error)) from None
    odd = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(odd):
        raise _bad(path, kind, lines[odd[0]][0], "contains NaN or infinity", "Remove lines without a pose")
    return rows


def _from_columns(
    path: Path, kind: str, names: tuple[str, ...], lines: Lines, frame: Frame, times: F64 | None, timed: bool
) -> Trajectory:
    from scipy.spatial.transform import Rotation

    used = [k for k, name in enumerate(names) if name]
    rows = _numbers(path, kind, lines, len(names), used)
    column = {names[k]: rows[:, i] for i, k in enumerate(used)}
    if "sec" in column and "nanosec" in column:
        column["time"] = column["sec"] + 1e-9 * column["nanosec"]

    def block(columns: Sequence[str]) -> F64 | None:
        return np.stack([column[name] for name in columns], axis=1) if set(columns) <= set(column) else None

    if (matrices := block(MATRIX)) is not None:
        if "time" in column:
            times = seconds(column["time"])
        elif timed and times is None:
            raise InputError(path, "has no times", REMEDIES[".csv"])
        return _from_matrices(path, matrices, lines, frame, times)
    quaternions = block(QUATERNION_COLUMNS)
    if quaternions is not None:
        odd = np.flatnonzero(np.abs(np.linalg.norm(quaternions, axis=1) - 1) > 0.01)
        if len(odd):
            raise _bad(
                path, kind, lines[odd[0]][0], "its quaternion is not normalized", "Give unit quaternions qx, qy, qz, qw"
            )
    covariance = None
    if set(SIGMA_COLUMNS[:3]) <= set(column):
        deviation = np.full((len(rows), 6), np.inf)  # rotations are unknown unless the file has their columns
        for k, name in enumerate(SIGMA_COLUMNS):
            if name in column:
                deviation[:, k] = column[name] * (frame.unit if k < 3 else 1)
        covariance = np.zeros((len(rows), 6, 6))
        covariance[:, np.arange(6), np.arange(6)] = deviation**2
    return Trajectory(
        seconds(column["time"]),
        frame.to_local(np.stack([column[name] for name in POSITION_COLUMNS[1:]], axis=1)),
        None if quaternions is None else Rotation.from_quat(quaternions).as_matrix(),
        column["unsure"] != 0 if "unsure" in column else None,
        covariance,
    )


def _from_kitti(path: Path, lines: Lines, frame: Frame, times: F64 | None) -> Trajectory:
    return _from_matrices(path, _numbers(path, ".kitti", lines, 12), lines, frame, times)


def _from_matrices(path: Path, rows: F64, lines: Lines, frame: Frame, times: F64 | None) -> Trajectory:
    """Trajectory of (T, 12) row-major 3x4 poses."""
    matrices = rows.reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    skew = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    odd = np.flatnonzero((skew > 1e-3) | (np.linalg.det(rotations) < 0))
    if len(odd):
        raise _bad(path, ".kitti", lines[odd[0]][0], "its left 3x3 is not a rotation matrix")
    if times is None:
        times = np.arange(len(lines)) / KITTI_RATE_HZ
    if len(times) != len(lines):
        raise InputError(path, f"has {len(lines)} poses for {len(times)} times", "Give one time per line")
    return Trajectory(np.asarray(times, np.float64), frame.to_local(matrices[:, :, 3]), nearest_rotation(rotations))


def _select(trajectory: Trajectory, index: Any) -> Trajectory:
    t = trajectory
    optional = (None if part is None else part[index] for part in (t.rotations, t.unsure, t.covariance))
    return Trajectory(t.times[index], t.positions[index], *optional)


def _quaternions(rotations: F64) -> F64:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotations).as_quat(canonical=True)


def _rows(columns: Sequence[tuple[F64, str]], separator: str) -> str:
    """Text lines of columns, each (T,) or (T, K) with its number format."""
    parts = [(part.reshape(len(part), -1), form) for part, form in columns]
    template = separator.join(separator.join([form] * part.shape[1]) for part, form in parts)
    return "".join(template % tuple(row) + "\n" for row in np.column_stack([part for part, _ in parts]).tolist())


def _to_csv(path: Path, t: Trajectory, frame: Frame) -> str:
    names, columns = list(POSITION_COLUMNS), [(t.times, "%.6f"), (frame.to_crs(t.positions), "%.6f")]
    if t.rotations is not None:
        names += QUATERNION_COLUMNS
        columns.append((_quaternions(t.rotations), "%.9f"))
    if t.unsure is not None:
        names.append("unsure")
        columns.append((t.unsure.astype(np.float64), "%d"))
    if t.covariance is not None:
        deviation = np.sqrt(np.einsum("tkk->tk", t.covariance)) / ([frame.unit] * 3 + [1.0] * 3)
        known = 6 if np.isfinite(deviation).all() else 3
        names += SIGMA_COLUMNS[:known]
        columns.append((deviation[:, :known], "%.6g"))
    return ",".join(names) + "\n" + _rows(columns, ",")


def _to_tum(path: Path, t: Trajectory, frame: Frame) -> str:
    assert t.rotations is not None
    columns = [(t.times, "%.6f"), (frame.to_crs(t.positions), "%.6f"), (_quaternions(t.rotations), "%.9f")]
    return "# timestamp tx ty tz qx qy qz qw\n" + _rows(columns, " ")


def _to_kitti(path: Path, t: Trajectory, frame: Frame) -> str:
    assert t.rotations is not None
    matrices = np.concatenate([t.rotations, frame.to_crs(t.positions)[:, :, None]], axis=2)
    return _rows([(matrices.reshape(-1, 12), "%.12e")], " ")


def _to_geojson(path: Path, t: Trajectory, frame: Frame) -> str:
    """The path, and a point in the middle of each unsure section with its largest horizontal deviation (1 sigma)."""
    if crs_io.to_wgs84(frame) is None:  # raises for an invalid CRS
        raise SettingError(path, "GeoJSON needs a CRS, but the trajectory is local", "Write .csv, or align to GPS")
    from pyproj import CRS, Transformer

    x, y, _ = frame.to_crs(t.positions).T
    horizontal = CRS.from_user_input(frame.crs).to_2d()  # heights are not transformed
    lon, lat = Transformer.from_crs(horizontal, "EPSG:4326", always_xy=True).transform(x, y)
    height = t.positions[:, 2] + frame.origin[2]
    coordinates = np.column_stack([np.round(lon, 8), np.round(lat, 8), np.round(height, 3)]).tolist()
    path_properties = {"kind": "path", "start_s": float(t.times[0]), "end_s": float(t.times[-1]), "poses": len(t)}
    line = (
        {"type": "LineString", "coordinates": coordinates}
        if len(t) > 1
        else {"type": "Point", "coordinates": coordinates[0]}
    )
    features = [{"type": "Feature", "properties": path_properties, "geometry": line}]
    edges = np.diff(np.concatenate([[False], t.unsure if t.unsure is not None else [], [False]]).astype(int))
    for first, end in zip(np.flatnonzero(edges > 0).tolist(), np.flatnonzero(edges < 0).tolist(), strict=True):
        properties = {
            "kind": "unsure",
            "start_s": float(t.times[first]),
            "end_s": float(t.times[end - 1]),
            "length_m": round(float(np.linalg.norm(np.diff(t.positions[first:end], axis=0), axis=1).sum()), 3),
            "sigma_m": None if t.covariance is None else _max_horizontal_sigma(t.covariance[first:end]),
        }
        point = {"type": "Point", "coordinates": coordinates[(first + end - 1) // 2]}
        features.append({"type": "Feature", "properties": properties, "geometry": point})
    return json.dumps({"type": "FeatureCollection", "features": features}) + "\n"


def _max_horizontal_sigma(covariance: F64) -> float | None:
    """Largest horizontal standard deviation (m) of (N, 6, 6) covariances, along the major axis."""
    horizontal = covariance[:, :2, :2]
    if not np.isfinite(horizontal).all():
        return None
    return round(float(np.sqrt(max(0.0, np.linalg.eigvalsh(horizontal).max()))), 3)
