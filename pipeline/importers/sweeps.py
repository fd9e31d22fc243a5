"""Importer of lidar sweeps of a moving scanner, with a trajectory (for example from visual SLAM).

A sweep is a file of points in the scanner's axes: .bin (float32 x, y, z, reflectance, as in KITTI), .pcd, .ply, .las or
.laz. It is transformed by the pose at its time; without a trajectory, the package `slam` estimates one from the sweeps.
Poses are those of the scanner, or of a camera with known extrinsics (`T_camera_scanner`). Photos become posed views,
and colour the points of sweeps that were recorded nearby.

Sweeps and photos on sections with dead-reckoned poses (`unsure`) are excluded: they would blur walls that other sweeps
have captured sharply.
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

from scan2sim.pipeline.core.errors import DataError, InputError, SettingError
from scan2sim.pipeline.core.parameters import Metres, Range, Shift, Voxel
from scan2sim.pipeline.core.poses import interpolate, nearest_rotation
from scan2sim.pipeline.core.step import Params, Report, silent
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Camera, Frame, PointCloud, Trajectory
from scan2sim.pipeline.importers.merge_sweeps import colour_from_photo, fill_colours, read_bin, scan_phase, thin_voxels
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import file_checks as files
from scan2sim.pipeline.io import toml
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images.image import SUFFIXES, read_rgb, size_of
from scan2sim.pipeline.io.point_chunks import to_uint16
from scan2sim.pipeline.io.tile import DISTORTION_LENGTHS, CameraEntry, read_tile, tile_name, write_tile
from scan2sim.pipeline.io.tile_folder import add_file, tile_folder

VERSION = 1
"""Version of the importer: raised when the same input and options give another tile."""
SWEEP_SUFFIXES = (".bin", ".pcd", ".ply", ".las", ".laz")
MAX_POSE_GAP_S = 1.0
"""Time between two poses up to which poses are interpolated (or three times the usual interval, if that is longer)."""
MAX_PHOTO_DISTANCE_M = 2.0
"""Distance between a sweep and the photo that colours it, so that their views of the scene hardly differ."""
MAX_PENDING_POINTS = 20_000_000
"""Points that are gathered before they are thinned."""
DEFAULT_RATE_HZ = 10.0
"""Sweep rate that is assumed if there are no times."""
MIN_NANOSECONDS = 1e17
"""File names that are integers above this are times in nanoseconds, smaller ones are frame numbers."""


@dataclass(frozen=True)
class PhotoInput:
    """Photos to import.

    Attributes:
        folder: folder of the photos.
        camera: their camera.
        times: file with their times, seconds, one per line; None: from their names or their order.
        mask: image, 0 where photos must not be used (ego-vehicle mask), or None.
        extrinsics: (4, 4) T_camera_scanner of their camera if it isn't the camera of the poses
            (`photo_extrinsics`), or None.
    """

    folder: Path
    camera: Camera
    times: Path | None = None
    mask: Path | None = None
    extrinsics: F64 | None = None


class DeskewParams(Params):
    """Motion compensation (deskewing): when each point of a sweep was measured.

    Attributes:
        deskew: transform each point by the pose at its own time, for sweeps that aren't motion-compensated. "kitti":
            the scanner rotates clockwise and points forward (x) at the sweep's time; "times": the points have times
            (.pcd, .ply, .las, .laz), in the clock of the sweeps' times, or relative to the sweep's time.
        period: duration of a rotation in seconds, for `deskew`; default: the time between sweeps.
    """

    deskew: Literal["none", "kitti", "times"] = Field(
        "none", description="Motion compensation: none, kitti (rotating scanner), or times (the points have times)."
    )
    period: Annotated[float, Field(ge=0.0001, le=1000)] | None = Field(
        None, description="Duration of a rotation of the scanner in seconds; default: the time between sweeps."
    )


class PlacementParams(DeskewParams):
    """Registration of sweeps by a trajectory.

    Attributes:
        scanner_poses: the poses are the scanner's; default: with extrinsics, they are the camera's.
        time_offset: seconds that are added to the times of sweeps and photos.
        max_range, min_range: distance limits from the scanner, metres; others are removed (too far, or the vehicle).
        voxel: voxel size in metres for thinning (keeps the point measured from nearest); None: no thinning.
        keep_unsure: keep sweeps and photos on unsure sections of the trajectory.
        crs: projected CRS of the trajectory; "local" without georeference.
    """

    scanner_poses: bool = Field(False, description="Treat the poses as scanner poses even if extrinsics are given.")
    time_offset: Shift = Field(0.0, description="Seconds to add to the times of sweeps and photos.")
    max_range: Range = Field(50.0, description="Maximum range in metres; farther returns are removed.")
    min_range: Metres = Field(1.0, description="Minimum range in metres; nearer returns (the vehicle) are removed.")
    voxel: Voxel | None = Field(None, description="Voxel size in metres: keep one point per voxel.")
    keep_unsure: bool = Field(False, description="Keep sweeps and photos on unsure sections of the trajectory.")
    crs: str = Field("local", description='CRS of the poses: "EPSG:32633", or "local".')


def import_sweeps(
    sweeps: Path,
    poses: Path,
    out: Path,
    placing: PlacementParams,
    *,
    extrinsics: F64 | None = None,
    times: Path | None = None,
    photos: PhotoInput | None = None,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Create a tile from sweeps and a trajectory.

    Times of sweeps and photos are in the trajectory's clock. Without a file of times, they are taken from file names
    that are seconds (with a decimal point) or nanoseconds; otherwise sweep i belongs to pose i: in order if there are
    as many sweeps as poses, else by the numbers in the file names.

    Args:
        sweeps: folder of sweeps, or one sweep.
        poses: trajectory file (.csv, .tum, .kitti), z up, CRS coordinates.
        out: folder of the tile to create.
        placing: settings.
        extrinsics: (4, 4) T_camera_scanner, scanner axes to camera axes; see `read_extrinsics`.
        times: file with the sweeps' times, seconds, one per line.
        photos: photos that colour the points and become views of the tile; requires `extrinsics`.
        link: symlink photos instead of copying them.
        overwrite: replace an existing tile.
        name: name of the tile; default: that of its folder.
        warn: receives omissions and suspected errors.
        report: receives progress.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file is missing or damaged, or sweeps, photos and poses don't match.
        SettingError: `out` is not empty, or options are contradictory.
        DataError: no points are left.
    """
    _check(placing, extrinsics, photos)
    files = list_files(sweeps, SWEEP_SUFFIXES, "sweeps")
    path, frame = read_poses(poses, placing.crs)
    T_camera_scanner = np.eye(4) if extrinsics is None else extrinsics
    T = path.poses if placing.scanner_poses else path.poses @ T_camera_scanner  # scanner to world
    if T[:, 2, 2].mean() < 0.3:
        warn(
            "the scanner's z axis doesn't point upwards: check that the poses are z-up, and the direction of the "
            "extrinsics (scanner axes to camera axes)"
        )
    scanner_path = _ScannerPath(path, T, placing.keep_unsure)
    seconds = timestamps(files, times, path, sweeps, offset=placing.time_offset)
    half_period = half_scan_period(placing, seconds, path.times)
    usable = scanner_path.usable(seconds, half_period, f"{len(files)} sweeps", poses, warn)
    posed_photos = (
        _pose_photos(photos, scanner_path, path, poses, placing.time_offset, T_camera_scanner, warn)
        if photos is not None
        else _NO_PHOTOS
    )

    merger = _PointMerger(placing.voxel)
    chosen = np.flatnonzero(usable)
    for done, i in enumerate(chosen):
        report(0.8 * done / len(chosen), files[i].name)
        merger.add(_place_sweep(files[i], float(seconds[i]), half_period, scanner_path, posed_photos, photos, placing))
    merged = merger.all()
    if not len(merged["xyz"]):
        raise DataError(sweeps, "has no points within range", "Increase --max-range, or check the files")
    report(0.8, "colours")
    rgb = None
    if merged["seen"].any():
        rgb = fill_colours(merged["xyz"], merged["rgb"], merged["seen"], merged["range"])
    elif photos is not None:
        warn("no point is visible in any photo: check the times of photos and sweeps, and the extrinsics")
    intensity = merged["intensity"] if merged["intensity"].any() else None
    cloud = PointCloud(frame, merged["xyz"], rgb, time=merged["time"], intensity=intensity)
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
            photos=_entries(posed_photos, photos, frame, work, link),
            trajectory="trajectory.csv",
        )
        read_tile(work)  # an invalid tile is an error here, before its folder appears
    report(1.0, "done")
    return Path(out) / "tile.toml"


# --- input


def read_extrinsics(path: Path) -> F64:
    """Read T_camera_scanner (4, 4) from a text file: three or four rows of four numbers, or a calibration of KITTI.

    Supported KITTI files: `calib_velo_to_cam.txt` (R: and T:), and `calib.txt` of the odometry data set (Tr:).

    Raises:
        InputError: another format, or not a rigid transform.
    """
    remedy = "Write T_camera_scanner: three rows of four numbers, scanner axes to camera axes"
    lines = [line.partition("#")[0].strip() for line in files.lines(path)]
    entries = {key.strip(): rest for key, colon, rest in (line.partition(":") for line in lines) if colon}
    try:
        if "Tr" in entries:
            rows = _numbers(entries["Tr"]).reshape(3, 4)
        elif {"R", "T"} <= set(entries):
            rows = np.column_stack([_numbers(entries["R"]).reshape(3, 3), _numbers(entries["T"]).reshape(3)])
        else:
            rows = np.array([_numbers(line) for line in lines if line])
            if rows.shape not in ((3, 4), (4, 4)) or (len(rows) == 4 and not np.allclose(rows[3], [0, 0, 0, 1])):
                raise ValueError(f"{len(rows)} rows")
    except ValueError as error:
        raise InputError(path, f"contains no 3x4 or 4x4 matrix ({error})", remedy) from None
    R = rows[:3, :3]
    if not np.isfinite(rows).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError(path, "its left 3x3 is not a rotation matrix", remedy)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = nearest_rotation(R), rows[:3, 3]
    return T


def photo_extrinsics(path: Path, photos: Path) -> F64 | None:
    """T_camera_scanner (4, 4) of the camera of a photo folder, from `calib.txt` of KITTI odometry.

    `Tr` belongs to camera 0, whose poses that data set gives; the camera of `image_2` is 6 cm beside it (see P2).

    Returns:
        None if the file isn't KITTI's, or the folder isn't named like one of its cameras: the extrinsics of
        `read_extrinsics` then also apply to the photos.

    Raises:
        InputError: as `read_extrinsics`, or the file has no valid P of that camera.
    """
    name = re.fullmatch(r"image_0?(\d)", photos.resolve().name)
    entries = {key.strip(): rest for key, colon, rest in (line.partition(":") for line in files.lines(path)) if colon}
    if name is None or "Tr" not in entries:
        return None
    T, key = read_extrinsics(path), f"P{name[1]}"
    try:
        P = _numbers(entries[key]).reshape(3, 4)
        T[:3, 3] += np.linalg.solve(P[:, :3], P[:, 3])
        if not np.isfinite(T).all():
            raise ValueError("not finite")
    except (KeyError, ValueError, np.linalg.LinAlgError) as error:
        remedy = "Unpack the calibration again, or give T_camera_scanner of the photos' camera"
        raise InputError(path, f"has no valid `{key}` ({error})", remedy) from None
    return T


def read_camera(path: Path, width: int, height: int) -> Camera:
    """The camera for photos of a size, from the `[[cameras]]` of a tile.toml, or of a file with only these.

    Raises:
        InputError: no camera of that size, or it is invalid.
    """
    path = path / "tile.toml" if path.is_dir() else path
    remedy = "Write [[cameras]] with id, model, size, focal, centre as in a tile.toml (docs/reference/formats.md)"
    try:
        cameras = [CameraEntry.model_validate(entry) for entry in toml.table(path).get("cameras", [])]
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(path, f"field `cameras.{where}`: {first['msg']}", remedy) from None
    except TypeError:
        raise InputError(path, "its `cameras` are not tables", remedy) from None
    for c in cameras:
        if c.size == (width, height):
            if c.model != "equirectangular" and not min(c.focal) > 0:
                raise InputError(path, f"camera `{c.id}`: focal {c.focal} is not positive", remedy)
            if len(c.distortion) not in DISTORTION_LENGTHS[c.model]:
                lengths = " or ".join(map(str, DISTORTION_LENGTHS[c.model]))
                raise InputError(path, f"camera `{c.id}`: {len(c.distortion)} coefficients, expected {lengths}", remedy)
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
    """The camera of a folder of photos, from `file` (`read_camera`) or the given parameters.

    Args:
        photos: folder of the photos.
        model: "auto" (a photo with aspect ratio 2:1 and no focal length is equirectangular), "pinhole" or
            "equirectangular".
        focal, centre: pixels; default centre: the middle of the photo.
        file: file with cameras.

    Raises:
        InputError: no photos, or no focal length. SettingError: unknown model.
    """
    if model not in ("auto", "pinhole", "equirectangular"):
        raise SettingError("camera", f"unknown model {model!r}", "Use auto, pinhole, equirectangular, or a file")
    first = list_files(photos, SUFFIXES, "photos")[0]
    width, height = size_of(first)
    if file is not None:
        return read_camera(file, width, height)
    if model == "equirectangular" or (model == "auto" and focal is None and width == 2 * height):
        return Camera("equirectangular", width, height)
    if focal is None or not focal > 0:
        raise InputError(photos, "have no camera", "Give --focal (pixels), or a file with the camera")
    cx, cy = centre or ((width - 1) / 2, (height - 1) / 2)
    return Camera("pinhole", width, height, focal, focal, cx, cy)


def _numbers(text: str) -> F64:
    return np.array(text.replace(",", " ").split(), np.float64)


def _check(placing: PlacementParams, extrinsics: F64 | None, photos: PhotoInput | None) -> None:
    if extrinsics is None and photos is not None:
        raise SettingError("extrinsics", "photos need the extrinsics of their camera", "Give T_camera_scanner")
    near, far = placing.min_range, placing.max_range
    if near >= far:
        raise SettingError("max_range", f"{far:g} m is not more than min_range, {near:g} m", "Widen the range")


def half_scan_period(placing: DeskewParams, sweeps: F64, poses: F64) -> float:
    """Half the duration of a sweep, seconds, 0 without deskewing; from the setting or the times of sweeps or poses."""
    if placing.deskew == "none":
        return 0.0
    if placing.period is not None:
        return placing.period / 2
    spacing = np.diff(np.unique(sweeps)) if len(sweeps) > 1 else np.diff(poses)
    return (float(np.median(spacing)) if len(spacing) else 1 / DEFAULT_RATE_HZ) / 2


def point_time_offsets(sweep: Sweep, time: float, half_period: float, deskew: str, file: Path) -> F64:
    """Time (N,) of each point relative to the sweep's `time`, seconds, according to `DeskewParams.deskew`.

    Times of points are in the clock of `time`, or relative to it (or to the start of the sweep).

    Raises:
        InputError: the points must have times but don't, or these are in another clock.
    """
    if deskew == "none" or not len(sweep.xyz):
        return np.zeros(len(sweep.xyz))
    if deskew == "kitti":
        return (2 * scan_phase(sweep.xyz) - 1) * half_period
    if sweep.time is None:
        raise InputError(file, "has no times for its points", "Use --deskew kitti, or none")
    for offsets in (sweep.time - time, sweep.time):
        if np.abs(offsets).max() < MAX_POSE_GAP_S:
            return offsets
    cause = f"its points have times from {sweep.time.min():.2f} to {sweep.time.max():.2f} s, the sweep has {time:.2f} s"
    raise InputError(file, cause, "Give the sweeps' times in the points' clock, or --deskew none")


def _natural_order(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def list_files(folder: Path, suffixes: Sequence[str] = SWEEP_SUFFIXES, what: str = "sweeps") -> list[Path]:
    """Files with the given suffixes in a folder, in natural order of their names (2 before 10); or the given file.

    Raises:
        InputError: there are none.
    """
    if folder.is_file() and folder.suffix.lower() in suffixes:
        return [folder]
    if not folder.exists():
        raise InputError(folder, "folder not found", files.CHECK_PATH)
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes] if folder.is_dir() else []
    if not found:
        raise InputError(folder, f"contains no {what} ({' '.join(suffixes)})", f"Give the folder of the {what}")
    return sorted(found, key=_natural_order)


def read_poses(poses: Path, crs: str) -> tuple[Trajectory, Frame]:
    """Read a trajectory, local to a frame with its origin near the first pose.

    Raises:
        InputError: it can't be read, has no rotations, or `crs` is not a projected CRS.
    """
    files.check(poses)
    known, unit = crs_io.common(poses, crs, None, (), ())
    path = trajectory_io.read(poses, Frame(known, unit=unit))
    if path.rotations is None:
        raise InputError(poses, "has only positions", "Give a trajectory with rotations: time,x,y,z,qx,qy,qz,qw")
    x, y, z = np.floor(path.positions[0]).tolist()
    frame = Frame(known, (x, y, z), unit)
    return Trajectory(path.times, path.positions - frame.origin, path.rotations, path.unsure), frame


def file_times(paths: Sequence[Path], times: Path | None, what: str = "sweeps") -> F64 | None:
    """Time (N,) of each file in seconds, from a file of times or the file names; None if neither gives them.

    Raises:
        InputError: not a file of times, or their number differs from that of the files.
    """
    if times is not None:
        try:
            seconds = np.loadtxt(times, ndmin=1).astype(np.float64)
        except FileNotFoundError:
            raise InputError(times, files.NOT_FOUND, files.CHECK_PATH) from None
        except (OSError, ValueError) as error:
            raise InputError(times, f"is not a list of times ({error})", "Write seconds, one per line") from None
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


# --- scanner poses


class _ScannerPath:
    """Poses of the scanner, with gaps and unsure sections."""

    def __init__(self, path: Trajectory, T: F64, keep_unsure: bool) -> None:
        self.times, self.T = path.times, T
        steps = np.diff(path.times)
        self.median_step = float(np.median(steps)) if len(steps) else 0.0
        unsure = np.zeros(len(path), bool) if path.unsure is None or keep_unsure else path.unsure
        gaps = steps > max(MAX_POSE_GAP_S, 3 * self.median_step)
        self._unsure = np.concatenate([[0], np.cumsum(unsure)])
        self._gaps = np.concatenate([[0], np.cumsum(gaps)])

    def at(self, times: F64) -> F64:
        """Interpolated poses (N, 4, 4), scanner to local coordinates."""
        low = max(0, int(np.searchsorted(self.times, times.min())) - 2)
        high = int(np.searchsorted(self.times, times.max())) + 2
        return interpolate(self.T[low:high], self.times[low:high], times)

    def usable(self, times: F64, half_period: float, what: str, poses: Path, warn: Callable[[str], None]) -> Bools:
        """Whether there are poses (N,) for all of `times` -+ `half_period`; warns about times without.

        Raises:
            InputError: no time has a pose. DataError: all poses are unsure.
        """
        tolerance = self.median_step / 2 + 1e-6
        within = (times >= self.times[0] - tolerance) & (times <= self.times[-1] + tolerance)
        if not within.any():
            raise InputError(
                poses,
                f"has times from {self.times[0]:.2f} to {self.times[-1]:.2f} s, the {what} from {times.min():.2f} to "
                f"{times.max():.2f} s",
                "Give times in the trajectory's clock, or --time-offset",
            )
        last = len(self.times) - 1
        first = np.clip(np.searchsorted(self.times, times - half_period, "right") - 1, 0, last)
        end = np.clip(np.searchsorted(self.times, times + half_period, "left"), 0, last)
        gap = self._gaps[end] - self._gaps[first] > 0
        unsure = self._unsure[end + 1] - self._unsure[first] > 0
        reasons = (
            (~within, "outside the trajectory's times"),
            (within & gap, "in gaps of the trajectory"),
            (within & ~gap & unsure, "where its poses are unsure (--keep-unsure keeps them)"),
        )
        for bad, reason in reasons:
            if bad.any():
                warn(f"{int(bad.sum())} of {what} are excluded: {reason}")
        good = within & ~gap & ~unsure
        if not good.any():
            remedy = "Check where tracking was lost, or use --keep-unsure"
            raise DataError(poses, f"none of {what} has a reliable pose", remedy)
        return good


@dataclass(frozen=True)
class _PosedPhotos:
    """Photos that have a pose: `files`, `times` (P,), `T` (P, 4, 4) camera to local coordinates."""

    files: list[Path]
    times: F64
    T: F64
    mask: U8 | None = None


_NO_PHOTOS = _PosedPhotos([], np.zeros(0), np.zeros((0, 4, 4)))


def _pose_photos(
    photos: PhotoInput,
    scanner_path: _ScannerPath,
    path: Trajectory,
    poses: Path,
    offset: float,
    T_camera_scanner: F64,
    warn: Callable[[str], None],
) -> _PosedPhotos:
    files = list_files(photos.folder, SUFFIXES, "photos")
    seconds = timestamps(files, photos.times, path, photos.folder, "photos", offset)
    good = np.flatnonzero(scanner_path.usable(seconds, 0.0, f"{len(files)} photos", poses, warn))
    mask = None
    if photos.mask is not None:
        image = read_rgb(photos.mask)
        size = photos.camera.height, photos.camera.width
        if image.shape[:2] != size:
            raise InputError(photos.mask, f"is not {size[1]}x{size[0]} pixels", "Give a mask of the photos' size")
        mask = image[..., 0]
    extrinsics = T_camera_scanner if photos.extrinsics is None else photos.extrinsics
    T = np.concatenate([scanner_path.at(seconds[i : i + 1]) for i in good]) @ np.linalg.inv(extrinsics)
    return _PosedPhotos([files[i] for i in good], seconds[good], T, mask)


def _entries(
    posed_photos: _PosedPhotos, photos: PhotoInput | None, frame: Frame, work: Path, link: bool
) -> list[dict[str, Any]]:
    """Copy or link photos; returns their entries for `write_tile`."""
    mask = None
    if posed_photos.files and photos is not None and photos.mask is not None:
        mask = add_file(photos.mask, work, f"masks/{photos.mask.name}", link)
    return [
        {
            "file": add_file(file, work, f"photos/{file.name}", link),
            "camera": "camera",
            "position": frame.to_crs(T[:3, 3]),
            "rotation": T[:3, :3],
            "time": float(time),
            "mask": mask,
        }
        for file, time, T in zip(posed_photos.files, posed_photos.times, posed_photos.T, strict=True)
    ]


# --- points


def _place_sweep(
    file: Path,
    time: float,
    half_period: float,
    scanner_path: _ScannerPath,
    posed_photos: _PosedPhotos,
    photos: PhotoInput | None,
    placing: PlacementParams,
) -> dict[str, Any]:
    """A sweep's points in local coordinates, coloured by the nearest photo in time."""
    sweep = read_sweep(file).between(placing.min_range, placing.max_range)
    xyz, sweep_rgb = sweep.xyz, sweep.rgb
    pose = scanner_path.at(np.array([time]))[0]
    times = time + point_time_offsets(sweep, time - placing.time_offset, half_period, placing.deskew, file)
    if half_period and len(xyz):
        poses = scanner_path.at(times)
        world = np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3]
    else:
        world = xyz @ pose[:3, :3].T + pose[:3, 3]
    rgb, seen = np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz), bool)
    if photos is None and sweep_rgb is not None:
        rgb, seen = sweep_rgb, np.ones(len(xyz), bool)
    elif photos is not None and posed_photos.files and len(xyz):
        k = int(np.abs(posed_photos.times - time).argmin())
        if np.linalg.norm(posed_photos.T[k, :3, 3] - pose[:3, 3]) < MAX_PHOTO_DISTANCE_M:
            colour_from_photo(
                world, posed_photos.T[k], photos.camera, posed_photos.files[k], rgb, seen, mask=posed_photos.mask
            )
    return {
        "xyz": world.astype(np.float32),
        "rgb": rgb,
        "seen": seen,
        "time": times,
        "intensity": sweep.intensity,
        "range": np.linalg.norm(xyz, axis=1).astype(np.float32),
    }


class Sweep(NamedTuple):
    """`xyz` (N, 3) in scanner axes, `intensity` (N,), 0 if unknown, `rgb` (N, 3) or None, `time` (N,) s or None."""

    xyz: F32
    intensity: npt.NDArray[np.uint16]
    rgb: U8 | None = None
    time: F64 | None = None

    def between(self, near: float, far: float) -> Sweep:
        """The points between `near` and `far` metres from the scanner."""
        distance = np.linalg.norm(self.xyz, axis=1)
        return self.take(np.logical_and(distance >= near, distance <= far))

    def take(self, keep: Bools) -> Sweep:
        """The points selected by a mask (N,)."""
        rgb = None if self.rgb is None else self.rgb[keep]
        return Sweep(self.xyz[keep], self.intensity[keep], rgb, None if self.time is None else self.time[keep])


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


def _intensities(levels: npt.NDArray[Any]) -> npt.NDArray[np.uint16]:
    """Scale intensities of 0..1, 0..255 or more to 0..65535; zeros if there are none."""
    scaled = to_uint16(levels, float(np.nan_to_num(levels).max(initial=0)))
    return np.zeros(len(levels), np.uint16) if scaled is None else scaled


class _PointMerger:
    """Merges the points of many sweeps, and thins them by voxels along the way."""

    def __init__(self, voxel: float | None) -> None:
        self.voxel, self._parts, self._pending = voxel, list[dict[str, Any]](), 0

    def add(self, part: dict[str, Any]) -> None:
        self._parts.append(part)
        self._pending += len(part["xyz"])
        if self.voxel is not None and self._pending > MAX_PENDING_POINTS:
            self._join()

    def all(self) -> dict[str, Any]:
        self._join()
        return self._parts[0]

    def _join(self) -> None:
        merged = {key: np.concatenate([part[key] for part in self._parts]) for key in self._parts[0]}
        if self.voxel is not None and len(merged["xyz"]):
            # points with a colour have priority
            keep = thin_voxels(merged["xyz"], self.voxel, np.where(merged["seen"], 0.0, 1e6) + merged["range"])
            merged = {key: values[np.sort(keep)] for key, values in merged.items()}
        self._parts, self._pending = [merged], 0
