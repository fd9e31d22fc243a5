"""A moving scanner's sweeps and a trajectory (visual SLAM's, for example) as a tile.

A sweep is a file of points in the scanner's axes: .bin (float32 x, y, z, reflectance, as KITTI's), .pcd, .ply, .las or
.laz. Each is placed by the pose of its time; where there is no trajectory, the room `slam` makes one of them. Poses
are the scanner's, or those of a camera beside it whose place is known (`T_camera_scanner`). Photos become posed views,
and colour the points of the sweeps that were taken beside them.

What belongs to a stretch where poses were bridged, not seen (`unsure`), is left out: it would smear the walls that
other sweeps have drawn sharply.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from scan2sim.pipeline.camera.poses import interpolate, nearest_rotation
from scan2sim.pipeline.core.errors import DataError, InputError, SettingError
from scan2sim.pipeline.core.parameters import Metres, Range, Shift, Voxel
from scan2sim.pipeline.core.step import Params, Report, silent
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Camera, Frame, PointCloud, Trajectory
from scan2sim.pipeline.importers.merge_sweeps import borrow_colours, colour, phase_of, read_bin, thin
from scan2sim.pipeline.importers.tile_folder import place, tile_folder
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import file_checks as files
from scan2sim.pipeline.io import toml
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images.image import SUFFIXES, read_rgb, size_of
from scan2sim.pipeline.io.point_chunks import sixteen_bits
from scan2sim.pipeline.io.tile import DISTORTION_LENGTHS, CameraEntry, read_tile, tile_name, write_tile

VERSION = 1
"""Raised whenever the same sweeps come to another tile with the same options."""
SWEEPS = (".bin", ".pcd", ".ply", ".las", ".laz")
GAP = 1.0
"""Seconds between two poses (or three times what is usual) over which there is no pose in between."""
BESIDE = 2.0
"""Metres between the places of a sweep and of the photo that colours it: nothing is to stand between."""
PENDING = 20_000_000
"""Points that are gathered before they are thinned."""
RATE = 10.0
"""Sweeps a second, where nothing tells."""
NANOSECONDS = 1e17
"""A file's name that is so large a whole number is a time in nanoseconds, otherwise a frame's number."""


@dataclass(frozen=True)
class Pictures:
    """Photos to import.

    Attributes:
        folder: of the photos.
        camera: that took them.
        times: file of their times, seconds, one a line, or None: by their names, or by their order.
        mask: picture, 0 where none of them must be used (the car itself), or None.
        extrinsics: (4, 4) T_camera_scanner of their camera where it isn't the one whose poses are given
            (`photo_extrinsics`), or None.
    """

    folder: Path
    camera: Camera
    times: Path | None = None
    mask: Path | None = None
    extrinsics: F64 | None = None


class Turning(Params):
    """When a sweep's points were measured.

    Attributes:
        deskew: place each point by the pose of its own moment, for sweeps that aren't compensated for motion. "kitti":
            the scanner turns clockwise and faces forward (x) at the sweep's time; "times": as the points' own times say
            (.pcd, .ply, .las, .laz), in the clock of the sweeps' times, or counted from the sweep's.
        period: seconds of a turn, for `deskew`; by default the time between sweeps.
    """

    deskew: Literal["none", "kitti", "times"] = Field(
        "none", description="Points by the pose of their own moment: kitti, or times (the points' own); or none."
    )
    period: Annotated[float, Field(ge=0.0001, le=1000)] | None = Field(
        None, description="Seconds of the scanner's turn; default: between sweeps."
    )


class Placing(Turning):
    """How sweeps are placed.

    Attributes:
        scanner_poses: the poses are the scanner's; by default they are the camera's if there are extrinsics.
        time_offset: seconds to add to all times of sweeps and photos.
        max_range, min_range: metres from the scanner: farther returns, and those of the car itself, are left out.
        voxel: keep one point a voxel of so many metres (that which was measured from nearest by), or None: all.
        keep_unsure: keep what was taken where poses are unsure.
        crs: of the trajectory, a projected one; "local" without georeference.
    """

    scanner_poses: bool = Field(False, description="Poses are the scanner's all the same.")
    time_offset: Shift = Field(0.0, description="Seconds to add to times of sweeps and photos.")
    max_range: Range = Field(50.0, description="Metres; returns from further away are left out.")
    min_range: Metres = Field(1.0, description="Metres; nearer returns, the car's own, are left out.")
    voxel: Voxel | None = Field(None, description="Keep one point in so many metres.")
    keep_unsure: bool = Field(False, description="Take unsure stretches of the path, too.")
    crs: str = Field("local", description='CRS of the poses: "EPSG:32633", or "local".')


def import_sweeps(
    sweeps: Path,
    poses: Path,
    out: Path,
    placing: Placing,
    *,
    extrinsics: F64 | None = None,
    times: Path | None = None,
    photos: Pictures | None = None,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Make a tile of sweeps placed by a trajectory.

    Times of sweeps and photos are in the trajectory's clock. Where a file of them isn't given, they are told by the
    files' names if those are seconds (with a decimal point) or nanoseconds; otherwise sweep i belongs to pose i: by
    their order if there are as many of one as of the other, else by the numbers that are the files' names.

    Args:
        sweeps: folder of sweeps, or one sweep.
        poses: trajectory file (.csv, .tum, .kitti), z-up, CRS coordinates.
        out: the tile's folder to make.
        placing: how.
        extrinsics: (4, 4) T_camera_scanner, the scanner's axes to the camera's; see `read_extrinsics`.
        times: file of the sweeps' times, seconds, one a line.
        photos: to colour the points, and to be views of the tile; needs `extrinsics`.
        link: link to photos instead of copying them.
        warn: receives what was left out, and what looks wrong.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file is missing or damaged, or sweeps, photos and poses don't belong together.
        SettingError: `out` is not empty, or options that make no sense.
        DataError: nothing is left.
    """
    _check(placing, extrinsics, photos)
    files = files_of(sweeps, SWEEPS, "sweeps")
    path, frame = read_poses(poses, placing.crs)
    T_camera_scanner = np.eye(4) if extrinsics is None else extrinsics
    T = path.poses if placing.scanner_poses else path.poses @ T_camera_scanner  # scanner to world
    if T[:, 2, 2].mean() < 0.3:
        warn(
            "the scanner's z axis doesn't point upwards: are the poses z-up, and the extrinsics the right way round "
            "(the scanner's axes to the camera's)?"
        )
    way = _Way(path, T, placing.keep_unsure)
    seconds = moments(files, times, path, sweeps, offset=placing.time_offset)
    half = half_turn(placing, seconds, path.times)
    good = way.judge(seconds, half, f"{len(files)} sweeps", poses, warn)
    shots = (
        _shots(photos, way, path, poses, placing.time_offset, T_camera_scanner, warn) if photos is not None else _NONE
    )

    merged = _Merged(placing.voxel)
    chosen = np.flatnonzero(good)
    for done, i in enumerate(chosen):
        report(0.8 * done / len(chosen), files[i].name)
        merged.add(_placed(files[i], float(seconds[i]), half, way, shots, photos, placing))
    whole = merged.all()
    if not len(whole["xyz"]):
        raise DataError(sweeps, "has no points within range", "Widen --max-range, or look at the files")
    report(0.8, "colours")
    rgb = None
    if whole["seen"].any():
        rgb = borrow_colours(whole["xyz"], whole["rgb"], whole["seen"], whole["range"])
    elif photos is not None:
        warn("no point has been seen by a photo: are photos and sweeps of the same time, and the extrinsics right?")
    intensity = whole["intensity"] if whole["intensity"].any() else None
    cloud = PointCloud(frame, whole["xyz"], rgb, time=whole["time"], intensity=intensity)
    report(0.9, "writing")
    with tile_folder(out, overwrite) as work:
        las.write(work / "cloud.laz", cloud)
        scanner = Trajectory(path.times, T[:, :3, 3], T[:, :3, :3], path.unsure)
        trajectory_io.write(work / "trajectory.csv", scanner, frame)
        write_tile(
            work,
            name=tile_name(name or Path(out).name),
            crs=placing.crs,
            clouds=["cloud.laz"],
            cameras={"camera": photos.camera} if photos is not None else {},
            photos=_entries(shots, photos, frame, work, link),
            trajectory="trajectory.csv",
        )
        read_tile(work)  # what it refuses is refused here, before the tile appears
    report(1.0, "done")
    return Path(out) / "tile.toml"


# --- what is given


def read_extrinsics(path: Path) -> F64:
    """(4, 4) T_camera_scanner of a text file: three or four rows of four numbers, or KITTI's calibration.

    Of KITTI's, `calib_velo_to_cam.txt` (R: and T:) and `calib.txt` of its odometry (Tr:) are understood.

    Raises:
        InputError: it is neither, or no rigid motion.
    """
    remedy = "Write T_camera_scanner: three rows of four numbers, scanner axes to camera axes"
    lines = [line.partition("#")[0].strip() for line in files.lines(path)]
    named = {key.strip(): rest for key, colon, rest in (line.partition(":") for line in lines) if colon}
    try:
        if "Tr" in named:
            rows = _numbers(named["Tr"]).reshape(3, 4)
        elif {"R", "T"} <= set(named):
            rows = np.column_stack([_numbers(named["R"]).reshape(3, 3), _numbers(named["T"]).reshape(3)])
        else:
            rows = np.array([_numbers(line) for line in lines if line])
            if rows.shape not in ((3, 4), (4, 4)) or (len(rows) == 4 and not np.allclose(rows[3], [0, 0, 0, 1])):
                raise ValueError(f"{len(rows)} rows")
    except ValueError as error:
        raise InputError(path, f"holds no 3x4 or 4x4 matrix ({error})", remedy) from None
    R = rows[:3, :3]
    if not np.isfinite(rows).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError(path, "its left 3x3 is no rotation", remedy)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = nearest_rotation(R), rows[:3, 3]
    return T


def photo_extrinsics(path: Path, photos: Path) -> F64 | None:
    """(4, 4) T_camera_scanner of the camera of a folder of photos, by `calib.txt` of KITTI's odometry.

    `Tr` is of camera 0, whose poses that set gives; the photos of `image_2` were taken 6 cm beside it, as P2 says.

    Returns:
        None where the file isn't KITTI's, or the folder's name isn't that of one of its cameras: photos are then of the
        camera that `read_extrinsics` tells.

    Raises:
        InputError: as `read_extrinsics`; the file has no sound P of that camera.
    """
    name = re.fullmatch(r"image_0?(\d)", photos.resolve().name)
    named = {key.strip(): rest for key, colon, rest in (line.partition(":") for line in files.lines(path)) if colon}
    if name is None or "Tr" not in named:
        return None
    T, key = read_extrinsics(path), f"P{name[1]}"
    try:
        P = _numbers(named[key]).reshape(3, 4)
        T[:3, 3] += np.linalg.solve(P[:, :3], P[:, 3])
        if not np.isfinite(T).all():
            raise ValueError("not finite")
    except (KeyError, ValueError, np.linalg.LinAlgError) as error:
        remedy = "Unpack the calibration again, or give T_camera_scanner of the photos' camera"
        raise InputError(path, f"has no sound `{key}` ({error})", remedy) from None
    return T


def read_camera(path: Path, width: int, height: int) -> Camera:
    """The camera of photos of a size, of the `[[cameras]]` of a tile.toml, or of a file that holds nothing else.

    Raises:
        InputError: there is none, or it makes no sense.
    """
    path = path / "tile.toml" if path.is_dir() else path
    remedy = "Write [[cameras]] with id, model, size, focal, centre as in a tile.toml (docs/formats.md)"
    try:
        cameras = [CameraEntry.model_validate(entry) for entry in toml.table(path).get("cameras", [])]
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(path, f"field `cameras.{where}`: {first['msg']}", remedy) from None
    except TypeError:
        raise InputError(path, "its `cameras` are no tables", remedy) from None
    for c in cameras:
        if c.size == (width, height):
            if c.model != "equirectangular" and not min(c.focal) > 0:
                raise InputError(path, f"camera `{c.id}`: focal {c.focal} is not positive", remedy)
            if len(c.distortion) not in DISTORTION_LENGTHS[c.model]:
                lengths = " or ".join(map(str, DISTORTION_LENGTHS[c.model]))
                raise InputError(path, f"camera `{c.id}`: {len(c.distortion)} coefficients, not {lengths}", remedy)
            return Camera(c.model, *c.size, *c.focal, *c.centre, c.distortion)
    found = ", ".join(f"{c.size[0]}x{c.size[1]}" for c in cameras) or "none"
    raise InputError(path, f"has no camera of {width}x{height} (it has {found})", remedy)


def camera_of_photos(
    photos: Path,
    *,
    model: str = "auto",
    focal: float | None = None,
    centre: tuple[float, float] | None = None,
    file: Path | None = None,
) -> Camera:
    """The camera of a folder of photos: of `file` (`read_camera`), or by its numbers.

    Args:
        model: "auto" (a photo twice as wide as high, without a focal length, is equirectangular), "pinhole" or
            "equirectangular".
        focal, centre: pixels; the centre by default the middle.

    Raises:
        InputError: no photos, no focal length. SettingError: unknown model.
    """
    if model not in ("auto", "pinhole", "equirectangular"):
        raise SettingError("camera", f"there is no model {model!r}", "Use auto, pinhole, equirectangular, or a file")
    first = files_of(photos, SUFFIXES, "photos")[0]
    width, height = size_of(first)
    if file is not None:
        return read_camera(file, width, height)
    if model == "equirectangular" or (model == "auto" and focal is None and width == 2 * height):
        return Camera("equirectangular", width, height)
    if focal is None or not focal > 0:
        raise InputError(photos, "needs a camera", "Give --focal (pixels), or a file that describes it")
    cx, cy = centre or ((width - 1) / 2, (height - 1) / 2)
    return Camera("pinhole", width, height, focal, focal, cx, cy)


def _numbers(text: str) -> F64:
    return np.array(text.replace(",", " ").split(), np.float64)


def _check(placing: Placing, extrinsics: F64 | None, photos: Pictures | None) -> None:
    if extrinsics is None and photos is not None:
        raise SettingError("extrinsics", "photos need the camera's place at the scanner", "Give T_camera_scanner")
    near, far = placing.min_range, placing.max_range
    if near >= far:
        raise SettingError("max_range", f"{far:g} m doesn't exceed min_range, {near:g} m", "Widen the range")


def half_turn(placing: Turning, sweeps: F64, poses: F64) -> float:
    """Seconds by which a sweep's points are older and younger than its time, by times of sweeps and of poses."""
    if placing.deskew == "none":
        return 0.0
    if placing.period is not None:
        return placing.period / 2
    spacing = np.diff(np.unique(sweeps)) if len(sweeps) > 1 else np.diff(poses)
    return (float(np.median(spacing)) if len(spacing) else 1 / RATE) / 2


def ages(sweep: Sweep, moment: float, half: float, deskew: str, file: Path) -> F64:
    """(N,) seconds after the sweep's `moment` at which each of its points was measured, as `Placing.deskew` says.

    Points' own times are in the clock of `moment`, or count from it (or from a moment shortly before).

    Raises:
        InputError: they are to tell, but there are none, or they are of another clock.
    """
    if deskew == "none" or not len(sweep.xyz):
        return np.zeros(len(sweep.xyz))
    if deskew == "kitti":
        return (2 * phase_of(sweep.xyz) - 1) * half
    if sweep.time is None:
        raise InputError(file, "has no times of its points", "Use --deskew kitti, or none")
    for since in (sweep.time - moment, sweep.time):
        if np.abs(since).max() < GAP:
            return since
    raise InputError(
        file, f"its points are of {sweep.time.min():.2f} to {sweep.time.max():.2f} s, the sweep of {moment:.2f} s",
        "Give the sweeps' times in the points' clock, or --deskew none",
    )  # fmt: skip


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def files_of(folder: Path, suffixes: Sequence[str] = SWEEPS, what: str = "sweeps") -> list[Path]:
    """Files of these suffixes in a folder, in the order of their names (2 before 10); or the one that is named.

    Raises:
        InputError: there are none.
    """
    if folder.is_file() and folder.suffix.lower() in suffixes:
        return [folder]
    if not folder.exists():
        raise InputError(folder, "is missing", "Put it there, or mend the name")
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes] if folder.is_dir() else []
    if not found:
        raise InputError(folder, f"holds no {what} ({' '.join(suffixes)})", f"Name the folder of the {what}")
    return sorted(found, key=_natural)


def read_poses(poses: Path, crs: str) -> tuple[Trajectory, Frame]:
    """The trajectory, local to a frame whose origin is near its first pose.

    Raises:
        InputError: it can't be read, knows positions alone, or `crs` is no projected CRS.
    """
    if not poses.is_file():
        raise InputError(poses, "is missing", "Put it there, or mend the name")
    known, unit = crs_io.common(poses, crs, None, (), ())
    path = trajectory_io.read(poses, Frame(known, unit=unit))
    if path.rotations is None:
        raise InputError(poses, "knows positions alone", "Give a trajectory with rotations: time,x,y,z,qx,qy,qz,qw")
    x, y, z = np.floor(path.positions[0]).tolist()
    frame = Frame(known, (x, y, z), unit)
    return Trajectory(path.times, path.positions - frame.origin, path.rotations, path.unsure), frame


def told_times(files: Sequence[Path], times: Path | None, what: str = "sweeps") -> F64 | None:
    """(N,) seconds of each file, by a file of them or by their names; None where neither tells.

    Raises:
        InputError: the file is none of so many times.
    """
    if times is not None:
        try:
            seconds = np.loadtxt(times, ndmin=1).astype(np.float64)
        except FileNotFoundError:
            raise InputError(times, "is missing", "Put it there, or mend the name") from None
        except (OSError, ValueError) as error:
            raise InputError(times, f"is no list of times ({error})", "Write seconds, one a line") from None
        if seconds.shape != (len(files),) or not np.isfinite(seconds).all():
            raise InputError(
                times, f"has {seconds.size} times for {len(files)} {what}", "Write a time for each, in order"
            )
        return seconds
    names = [file.stem for file in files]
    if all(name.isdigit() for name in names):
        numbers = [int(name) for name in names]
        return np.array([1e-9 * number for number in numbers]) if min(numbers) > NANOSECONDS else None
    fractions = all(re.fullmatch(r"-?\d+\.\d+", name) for name in names)
    return np.array([float(name) for name in names]) if fractions else None


def moments(
    files: Sequence[Path], times: Path | None, path: Trajectory, folder: Path, what: str = "sweeps", offset: float = 0.0
) -> F64:
    """(N,) seconds of each file, in the trajectory's clock: as `told_times`, or those of its poses.

    Raises:
        InputError: nothing tells them.
    """
    told = told_times(files, times, what)
    if told is not None:
        return told + offset
    if len(files) == len(path):
        return path.times + offset
    names = [file.stem for file in files]
    if all(name.isdigit() for name in names) and max(map(int, names)) < len(path):
        return path.times[[int(name) for name in names]] + offset
    raise InputError(
        folder, f"has {len(files)} {what} for {len(path)} poses, and their names are no times",
        "Give their times in a file, seconds, one a line",
    )  # fmt: skip


# --- where the scanner was


class _Way:
    """Poses of the scanner, and which of them can be relied on."""

    def __init__(self, path: Trajectory, T: F64, keep_unsure: bool) -> None:
        self.times, self.T = path.times, T
        steps = np.diff(path.times)
        self.usual = float(np.median(steps)) if len(steps) else 0.0
        unsure = np.zeros(len(path), bool) if path.unsure is None or keep_unsure else path.unsure
        wide = steps > max(GAP, 3 * self.usual)
        self._unsure = np.concatenate([[0], np.cumsum(unsure)])
        self._gaps = np.concatenate([[0], np.cumsum(wide)])

    def at(self, times: F64) -> F64:
        """(N, 4, 4) scanner to local coordinates."""
        low = max(0, int(np.searchsorted(self.times, times.min())) - 2)
        high = int(np.searchsorted(self.times, times.max())) + 2
        return interpolate(self.T[low:high], self.times[low:high], times)

    def judge(self, times: F64, half: float, what: str, poses: Path, warn: Callable[[str], None]) -> Bools:
        """(N,) whether poses can be had for the whole of `times` -+ `half`; what can't be is told.

        Raises:
            InputError: none has a pose. DataError: all are unsure.
        """
        reach = self.usual / 2 + 1e-6  # half a turn of the scanner, say
        within = (times >= self.times[0] - reach) & (times <= self.times[-1] + reach)
        if not within.any():
            raise InputError(
                poses,
                f"spans {self.times[0]:.2f} to {self.times[-1]:.2f} s, the {what} {times.min():.2f} to "
                f"{times.max():.2f} s",
                "Give times of the trajectory's clock, or --time-offset",
            )
        last = len(self.times) - 1
        first = np.clip(np.searchsorted(self.times, times - half, "right") - 1, 0, last)
        end = np.clip(np.searchsorted(self.times, times + half, "left"), 0, last)
        gap = self._gaps[end] - self._gaps[first] > 0
        unsure = self._unsure[end + 1] - self._unsure[first] > 0
        reasons = (
            (~within, "outside the trajectory's times"),
            (within & gap, "in gaps of the trajectory"),
            (within & ~gap & unsure, "where its poses are unsure (--keep-unsure keeps them)"),
        )
        for bad, reason in reasons:
            if bad.any():
                warn(f"{int(bad.sum())} of {what} are left out: {reason}")
        good = within & ~gap & ~unsure
        if not good.any():
            raise DataError(poses, f"none of {what} has a sure pose", "See where it was lost, or use --keep-unsure")
        return good


@dataclass(frozen=True)
class _Shots:
    """Photos that have a pose: `files`, `times` (P,), `T` (P, 4, 4) camera to local coordinates."""

    files: list[Path]
    times: F64
    T: F64
    mask: U8 | None = None


_NONE = _Shots([], np.zeros(0), np.zeros((0, 4, 4)))


def _shots(
    photos: Pictures,
    way: _Way,
    path: Trajectory,
    poses: Path,
    offset: float,
    T_camera_scanner: F64,
    warn: Callable[[str], None],
) -> _Shots:
    files = files_of(photos.folder, SUFFIXES, "photos")
    seconds = moments(files, photos.times, path, photos.folder, "photos", offset)
    good = np.flatnonzero(way.judge(seconds, 0.0, f"{len(files)} photos", poses, warn))
    mask = None
    if photos.mask is not None:
        picture = read_rgb(photos.mask)
        size = photos.camera.height, photos.camera.width
        if picture.shape[:2] != size:
            raise InputError(photos.mask, f"is no picture of {size[1]}x{size[0]}", "Give a mask of the photos' size")
        mask = picture[..., 0]
    own = T_camera_scanner if photos.extrinsics is None else photos.extrinsics
    T = np.concatenate([way.at(seconds[i : i + 1]) for i in good]) @ np.linalg.inv(own)
    return _Shots([files[i] for i in good], seconds[good], T, mask)


def _entries(shots: _Shots, photos: Pictures | None, frame: Frame, work: Path, link: bool) -> list[dict[str, Any]]:
    """Photos as `write_tile` takes them, copied or linked."""
    mask = None
    if shots.files and photos is not None and photos.mask is not None:
        mask = place(photos.mask, work, f"masks/{photos.mask.name}", link)
    return [
        {
            "file": place(file, work, f"photos/{file.name}", link),
            "camera": "camera",
            "position": frame.to_crs(T[:3, 3]),
            "rotation": T[:3, :3],
            "time": float(time),
            "mask": mask,
        }
        for file, time, T in zip(shots.files, shots.times, shots.T, strict=True)
    ]


# --- points


def _placed(
    file: Path,
    moment: float,
    half: float,
    way: _Way,
    shots: _Shots,
    photos: Pictures | None,
    placing: Placing,
) -> dict[str, Any]:
    """A sweep's points in local coordinates, coloured by the photo that was taken beside it."""
    sweep = read_sweep(file).between(placing.min_range, placing.max_range)
    xyz, own = sweep.xyz, sweep.rgb
    here = way.at(np.array([moment]))[0]
    times = moment + ages(sweep, moment - placing.time_offset, half, placing.deskew, file)
    if half and len(xyz):
        at = way.at(times)
        world = np.einsum("nij,nj->ni", at[:, :3, :3], xyz) + at[:, :3, 3]
    else:
        world = xyz @ here[:3, :3].T + here[:3, 3]
    rgb, seen = np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz), bool)
    if photos is None and own is not None:
        rgb, seen = own, np.ones(len(xyz), bool)
    elif photos is not None and shots.files and len(xyz):
        k = int(np.abs(shots.times - moment).argmin())
        if np.linalg.norm(shots.T[k, :3, 3] - here[:3, 3]) < BESIDE:
            colour(world, shots.T[k], photos.camera, shots.files[k], rgb, seen, mask=shots.mask)
    return {
        "xyz": world.astype(np.float32),
        "rgb": rgb,
        "seen": seen,
        "time": times,
        "intensity": sweep.intensity,
        "range": np.linalg.norm(xyz, axis=1).astype(np.float32),
    }


class Sweep(NamedTuple):
    """`xyz` (N, 3) in scanner axes, `intensity` (N,), 0 where there is none, `rgb` (N, 3), `time` (N,) s, or None."""

    xyz: F32
    intensity: npt.NDArray[np.uint16]
    rgb: U8 | None = None
    time: F64 | None = None

    def between(self, near: float, far: float) -> Sweep:
        """The points so many metres from the scanner."""
        distance = np.linalg.norm(self.xyz, axis=1)
        return self.take(np.logical_and(distance >= near, distance <= far))

    def take(self, keep: Bools) -> Sweep:
        """The points that a mask (N,) selects."""
        rgb = None if self.rgb is None else self.rgb[keep]
        return Sweep(self.xyz[keep], self.intensity[keep], rgb, None if self.time is None else self.time[keep])


def read_sweep(path: Path) -> Sweep:
    """A sweep's points, those alone that are somewhere.

    Raises:
        InputError: missing, damaged, or of an unknown format.
    """
    kind = path.suffix.lower()
    if kind == ".bin":
        xyz, reflectance = read_bin(path)
        return Sweep(xyz, _sixteen_bits(reflectance))
    cloud = cloud_io.read(path, Frame())
    levels = np.zeros(len(cloud), np.uint16) if cloud.intensity is None else cloud.intensity
    return Sweep(cloud.xyz, levels, cloud.rgb, cloud.time).take(np.asarray(np.isfinite(cloud.xyz).all(axis=1)))


def _sixteen_bits(levels: npt.NDArray[Any]) -> npt.NDArray[np.uint16]:
    """Intensities in 0 to 1, in 0 to 255, or larger, to 0 to 65535."""
    scaled = sixteen_bits(levels, float(np.nan_to_num(levels).max(initial=0)))
    return np.zeros(len(levels), np.uint16) if scaled is None else scaled


class _Merged:
    """Points of many sweeps, thinned on the way where that is asked for."""

    def __init__(self, voxel: float | None) -> None:
        self.voxel, self._parts, self._pending = voxel, list[dict[str, Any]](), 0

    def add(self, part: dict[str, Any]) -> None:
        self._parts.append(part)
        self._pending += len(part["xyz"])
        if self.voxel is not None and self._pending > PENDING:
            self._join()

    def all(self) -> dict[str, Any]:
        self._join()
        return self._parts[0]

    def _join(self) -> None:
        whole = {key: np.concatenate([part[key] for part in self._parts]) for key in self._parts[0]}
        if self.voxel is not None and len(whole["xyz"]):
            # what has a colour goes first
            keep = thin(whole["xyz"], self.voxel, np.where(whole["seen"], 0.0, 1e6) + whole["range"])
            whole = {key: values[np.sort(keep)] for key, values in whole.items()}
        self._parts, self._pending = [whole], 0
