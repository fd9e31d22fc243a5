"""A drive of a data set, whatever its layout: sweeps, photos of several cameras, and the path of the scanner."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import Seconds
from scan2sim.pipeline.core.step import Params, Report, silent
from scan2sim.pipeline.core.types import F64, Frame, Trajectory
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.rig import RigCamera, write_rig
from scan2sim.pipeline.io.sweep_files import Sweep, time_stem, write_sweep
from scan2sim.pipeline.io.tile_folder import add_file

T = TypeVar("T")
ReadSweep: TypeAlias = Callable[[Path, int], Sweep]
"""Reads a sweep in scanner axes, of its file and time in nanoseconds."""
AUTO, NONE = "auto", "none"
US = 1000
"""Nanoseconds per microsecond, the resolution of the times in trajectory files."""


class DatasetParams(Params):
    """What is imported of a drive of a data set.

    Attributes:
        camera: names of cameras; default: all; "none" for no photos.
        photo_interval: least time between two photos of a camera, seconds; default: all photos.
        crs: "auto": UTM if the data set has a georeference, else "local", its own coordinates; or a projected CRS.
    """

    camera: tuple[str, ...] = Field((), description="Camera to take photos of, or none; repeatable; default: all.")
    photo_interval: Seconds | None = Field(
        None, description="Least time between two photos of a camera in seconds; default: all photos."
    )
    crs: str = Field(
        AUTO,
        description="CRS of the world: auto (UTM), local (the data set's coordinates), or a code such as EPSG:32619.",
    )

    def chosen(self, cameras: Sequence[str], folder: Path) -> list[str]:
        """The cameras to import, of those of a drive.

        Raises:
            SettingError: one that is named doesn't exist.
        """
        if self.camera == (NONE,):
            return []
        for name in self.camera:
            if name not in cameras:
                has = f"{folder} has {', '.join(cameras)}" if cameras else f"{folder} has no photos"
                raise SettingError("--camera", f"there is no camera {name!r}", f"Choose others: {has}")
        return [name for name in cameras if not self.camera or name in self.camera]

    def thinned(self, times_ns: Iterable[int]) -> list[int]:
        """Indices of a camera's photos that are kept, of ascending times."""
        kept, last = list[int](), None
        for i, time in enumerate(times_ns):
            if last is None or self.photo_interval is None or time - last >= self.photo_interval * 1e9:
                kept.append(i)
                last = time
        return kept


@dataclass(frozen=True)
class Recording:
    """A drive.

    Attributes:
        name: what it is, for messages.
        sweeps: time (ns) and file of each sweep, ascending.
        cameras: intrinsics and mounting of each camera.
        photos: time (ns) and file of each photo, ascending, by camera.
        frame: CRS and local origin.
        path: poses of the scanner in local coordinates, at the times of all sweeps and photos.
        notes: properties of the data that a user should know.
        warnings: omissions and suspected errors.
    """

    name: str
    sweeps: list[tuple[int, Path]]
    cameras: list[RigCamera]
    photos: dict[str, list[tuple[int, Path]]]
    frame: Frame
    path: Trajectory
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def metrics(self) -> dict[str, Any]:
        """Numbers of sweeps and photos, and a summary."""
        sweeps, photos = len(self.sweeps), sum(map(len, self.photos.values()))
        seconds = (self.sweeps[-1][0] - self.sweeps[0][0]) / 1e9
        text = f"{sweeps:,} sweeps and {photos:,} photos in {seconds:,.1f} s of {self.name}"
        summary = "; ".join((text, *self.notes))
        return {"sweeps": sweeps, "photos": photos, "seconds": round(seconds, 3), "summary": summary}


def write(recording: Recording, read: ReadSweep, out: Path, report: Report = silent) -> dict[str, Path]:
    """Write a drive into the folder `out`: `sweeps/`, `photos/` (a rig of symlinks) and `poses.csv`, of the scanner.

    Args:
        recording: the drive.
        read: reads a sweep.
        out: folder to write to.
        report: receives progress.

    Returns:
        Paths by name: sweeps, poses, and photos if there are any.

    Raises:
        InputError: a file can't be read.
    """
    (out / "sweeps").mkdir()
    for i, (time, file) in enumerate(recording.sweeps):
        report(i / len(recording.sweeps), file.name)
        write_sweep(out / "sweeps" / f"{time_stem(time)}.ply", read(file, time))
    trajectory_io.write(out / "poses.csv", recording.path, recording.frame)
    written = {"sweeps": out / "sweeps", "poses": out / "poses.csv"}
    if recording.cameras:
        for camera in recording.cameras:
            for time, file in recording.photos[camera.id]:
                add_file(file, out / "photos", f"{camera.id}/{time_stem(time)}{file.suffix.lower()}", link=True)
        write_rig(out / "photos", recording.cameras)
        written["photos"] = out / "photos"
    return written


def joined_path(parts: Iterable[tuple[Sequence[int], F64]]) -> tuple[F64, F64]:
    """Times (T,) in seconds, ascending, and poses (T, 4, 4), of several sensors; of equal times the first."""
    given = list(parts)
    times = np.concatenate([np.asarray(times, np.int64) for times, _ in given])
    microseconds, first = np.unique(np.rint(times / US).astype(np.int64), return_index=True)
    return microseconds / 1e6, np.concatenate([poses for _, poses in given])[first]


def placed(poses: F64, times: F64, frame: Frame, yaw: float, anchor: F64) -> Trajectory:
    """The path of `poses` (T, 4, 4), turned by `yaw` (radians, about z); `anchor` (3,) moves to the frame's origin."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("z", yaw).as_matrix()
    return Trajectory(times, (poses[:, :3, 3] - anchor) @ turn.T, turn @ poses[:, :3, :3])


def frame_at(where: Path, crs: str, latitude: float, longitude: float, height: float) -> Frame:
    """Frame of a projected CRS ("auto": UTM) with its origin at a geographic position (degrees, metres).

    Raises:
        InputError: it isn't a projected CRS, or the position is outside of it.
    """
    from pyproj import Transformer

    crs, unit = crs_io.common(where, crs_io.utm(latitude, longitude) if crs == AUTO else crs, None, (), ())
    east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
    if not np.isfinite([east, north]).all():
        raise InputError(where, f"is outside of the area of {crs_io.name(crs)}", "Give another --crs")
    return Frame(crs, (east * unit, north * unit, height), unit)


def pose(position: Sequence[float], wxyz: Sequence[float]) -> F64:
    """Pose (4, 4) of a position and a quaternion, scalar first.

    Raises:
        ValueError: NaN, or no rotation.
    """
    from scipy.spatial.transform import Rotation

    if not (np.isfinite(position).all() and abs(float(np.linalg.norm(wxyz)) - 1) < 0.01):
        raise ValueError("is not a pose: a position in metres, and a unit quaternion w, x, y, z")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), position
    return T


def intensities(levels: F64) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Intensities 0 to 255 as 0 to 65535."""
    return np.clip(np.rint(np.nan_to_num(levels) * 257), 0, 65535).astype(np.uint16)


def read_json(path: Path, kind: TypeAdapter[T], remedy: str) -> T:
    """Content of a JSON file.

    Raises:
        InputError: it doesn't exist, or has other content; names the entry.
    """
    try:
        return kind.validate_json(file_checks.check(path, remedy).read_bytes())
    except ValidationError as error:
        raise InputError(path, _problem(error), remedy) from None


def validated(kind: TypeAdapter[T], row: Mapping[str, Any], path: Path, remedy: str) -> T:
    """A record of a table.

    Raises:
        InputError: a field is missing or wrong.
    """
    try:
        return kind.validate_python(row)
    except ValidationError as error:
        raise InputError(path, f"record {row.get('token')!r}: {_problem(error)}", remedy) from None


def _problem(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return f"field `{where}`: {first['msg']}" if where else str(first["msg"])
