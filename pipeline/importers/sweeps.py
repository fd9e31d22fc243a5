"""Importer of lidar sweeps of a moving scanner, with a trajectory (for example from visual SLAM).

A sweep is a file of points in the scanner's axes: .bin (float32 x, y, z, reflectance, as in KITTI), .pcd, .ply, .las or
.laz. It is transformed by the pose at its time; without a trajectory, the package `slam` estimates one from the sweeps.
Poses are those of the scanner, or of a camera with known extrinsics (`T_camera_scanner`). Photos become posed views,
and colour the points of sweeps that were recorded nearby.

Sweeps and photos on sections with dead-reckoned poses (`unsure`) are excluded: they would blur walls that other sweeps
have captured sharply.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import Coordinate, Metres, Range, Shift, Voxel
from scan2sim.pipeline.core.step import Params, Report, silent
from scan2sim.pipeline.core.types import F64, U8, Camera, Trajectory, View
from scan2sim.pipeline.importers.deskew import DeskewParams, half_scan_period, point_time_offsets
from scan2sim.pipeline.importers.place_sweeps import PLACED, PlacedPoints, merge, place, write_placed
from scan2sim.pipeline.importers.scanner_path import ScannerPath
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.images.image import SUFFIXES, read_rgb
from scan2sim.pipeline.io.sweep_files import SWEEP_SUFFIXES, Sweep, list_files, read_sweep, reading, timestamps
from scan2sim.pipeline.io.trajectory import QUATERNIONS_HELP, QuaternionOrder
from scan2sim.pipeline.pose_check.conventions import AXES, CameraAxes

VERSION = 3
"""Version of the importer: raised when the same input and options give another tile."""
MAX_PHOTO_DISTANCE_M = 2.0
"""Distance between a sweep and the photo that colours it, so that their views of the scene hardly differ."""
MIN_UP = 0.3
"""Mean vertical component of the scanner's z axis below which the poses are suspicious."""
MIN_UPRIGHT = 0.9
"""Mean z component of the scanner's z axis by another convention of the poses, from which that is suggested."""
PHOTO_CAMERA = "camera"
"""Id of the photos' camera in the tile, if there is only one."""
Box = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]


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
        id: id of the camera in the tile.
        subfolder: whether the tile has a folder with that id for the photos, to separate those of several cameras.
    """

    folder: Path
    camera: Camera
    times: Path | None = None
    mask: Path | None = None
    extrinsics: F64 | None = None
    id: str = PHOTO_CAMERA
    subfolder: bool = False


class PointSelection(Params):
    """Selection of a sweep's points.

    Attributes:
        max_range, min_range: distance limits from the scanner, metres; others are removed (too far, or the vehicle).
        vehicle_box: box that contains the vehicle, scanner axes: low and high corner, metres; points in it are removed.
        voxel: voxel size in metres for thinning (keeps the point measured from nearest); None: no thinning.
    """

    max_range: Range = Field(50.0, description="Maximum range in metres; farther returns are removed.")
    min_range: Metres = Field(1.0, description="Minimum range in metres; nearer returns (the vehicle) are removed.")
    vehicle_box: Box | None = Field(
        None,
        description="Box that contains the vehicle, in scanner axes: x y z of its low and its high corner, metres.",
    )
    voxel: Voxel | None = Field(None, description="Voxel size in metres: keep one point per voxel.")

    def selected(self, sweep: Sweep) -> Sweep:
        """The points within range and outside the vehicle."""
        near = sweep.between(self.min_range, self.max_range)
        if self.vehicle_box is None:
            return near
        low, high = np.array(self.vehicle_box, np.float32).reshape(2, 3)
        inside = np.logical_and(near.xyz > low, near.xyz < high).all(axis=1)
        return near.take(np.logical_not(np.asarray(inside, bool)))


class SelectionParams(PointSelection, DeskewParams):
    """Selection of points and poses.

    Attributes:
        keep_unsure: keep sweeps and photos on unsure sections of the trajectory.
        crs: projected CRS of the trajectory; "local" without georeference.
    """

    keep_unsure: bool = Field(False, description="Keep sweeps and photos on unsure sections of the trajectory.")
    crs: str = Field("local", description='CRS of the poses: "EPSG:32633", or "local".')


class PhotoPlacementParams(Params):
    """Conventions of the photos' times and extrinsics, where they differ from the documented ones.

    Attributes:
        photo_time_offset: seconds that are added to the times of photos, besides `time_offset`.
        invert_extrinsics: the extrinsics are T_scanner_camera.
        camera_axes: axes of the cameras in the extrinsics, as in `pose_check.conventions`.
    """

    photo_time_offset: Shift = Field(0.0, description="Seconds to add to the times of photos only.")
    invert_extrinsics: bool = Field(
        False, description="The extrinsics are T_scanner_camera: from camera axes to scanner axes."
    )
    camera_axes: CameraAxes = Field(
        "opencv",
        description="Camera axes of the extrinsics: opencv (x right, y down, z ahead; ROS: optical frame), opengl "
        "(x right, y up, z back), or ros (a body's: x ahead, y left, z up).",
    )


class PlacementParams(PhotoPlacementParams, SelectionParams):
    """Registration of sweeps by a trajectory.

    Attributes:
        scanner_poses: the poses are the scanner's; default: with extrinsics, they are the camera's.
        time_offset: seconds that are added to the times of sweeps and photos.
        quaternions: order of the trajectory's quaternions.
    """

    scanner_poses: bool = Field(False, description="Treat the poses as scanner poses even if extrinsics are given.")
    time_offset: Shift = Field(0.0, description="Seconds to add to the times of sweeps and photos.")
    quaternions: QuaternionOrder = Field("xyzw", description=QUATERNIONS_HELP)


def import_sweeps(
    sweeps: Path,
    poses: Path,
    out: Path,
    placing: PlacementParams,
    *,
    extrinsics: F64 | None = None,
    times: Path | None = None,
    photos: Sequence[PhotoInput] = (),
    checked: bool = False,
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
        photos: photos that colour the points and become views of the tile, for each camera; the extrinsics are
            required.
        checked: whether the poses were checked before: their conventions aren't doubted again.
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
    path, frame = trajectory_io.read_local(poses, placing.crs, placing.quaternions)
    T_camera_scanner = np.eye(4) if extrinsics is None else extrinsics
    if placing.invert_extrinsics:
        T_camera_scanner = np.asarray(np.linalg.inv(T_camera_scanner), np.float64)
    T = path.poses if placing.scanner_poses else path.poses @ T_camera_scanner  # scanner to world
    if (layout := reading(files[0])) is not None:
        warn(f"{files[0].name}: {layout}")
    if not checked and (tilt := tilt_warning(path, T_camera_scanner, placing)):
        warn(tilt)
    scanner_path = ScannerPath(path.times, T, None if placing.keep_unsure else path.unsure)
    seconds = timestamps(files, times, path, sweeps, offset=placing.time_offset)
    half_period = half_scan_period(placing, seconds, path.times)
    usable = np.flatnonzero(scanner_path.usable(seconds, half_period, f"{len(files)} sweeps", poses, warn))
    shift = placing.time_offset + placing.photo_time_offset
    T_optical = np.eye(4)
    T_optical[:3, :3] = AXES[placing.camera_axes]
    albums = [_album(one, scanner_path, path, poses, shift, T_camera_scanner, T_optical, warn) for one in photos]
    any_seen = False

    def placed() -> Iterator[PlacedPoints]:
        nonlocal any_seen
        for done, i in enumerate(usable):
            report(PLACED * done / len(usable), files[i].name)
            time = float(seconds[i])
            sweep = placing.selected(read_sweep(files[i]))
            if photos:
                sweep = sweep._replace(rgb=None)
            ages = point_time_offsets(sweep, time - placing.time_offset, half_period, placing.deskew, files[i])
            centre = scanner_path.at(seconds[i : i + 1])[0, :3, 3]
            beside = [(album.nearest(time, centre), album.mask) for album in albums]
            points = place(sweep, time + ages, scanner_path, [(view, mask) for view, mask in beside if view])
            any_seen = any_seen or bool(points.seen.any())
            yield points

    tile = write_placed(
        out, merge(placed(), placing.voxel), frame, Trajectory(path.times, T[:, :3, 3], T[:, :3, :3], path.unsure),
        {album.camera: album.views for album in albums}, {one.id: one.camera for one in photos}, sweeps=sweeps,
        name=name or Path(out).name, crs=placing.crs, link=link, overwrite=overwrite, report=report,
    )  # fmt: skip
    if photos and not any_seen:
        warn("no point is visible in any photo: check the times of photos and sweeps, and the extrinsics")
    return tile


def _check(placing: PlacementParams, extrinsics: F64 | None, photos: Sequence[PhotoInput]) -> None:
    if extrinsics is None and any(one.extrinsics is None for one in photos):
        raise SettingError("extrinsics", "photos need the extrinsics of their camera", "Give T_camera_scanner")
    near, far = placing.min_range, placing.max_range
    if near >= far:
        raise SettingError("max_range", f"{far:g} m is not more than min_range, {near:g} m", "Widen the range")


def tilt_warning(path: Trajectory, T_camera_scanner: F64, placing: PlacementParams) -> str | None:
    """Warning about a scanner whose z axis doesn't point upwards; names the option that fixes it, if there is one.

    Args:
        path: the given poses.
        T_camera_scanner: (4, 4) the extrinsics as they are used.
        placing: settings.
    """
    mount = np.eye(4) if placing.scanner_poses else T_camera_scanner
    up = mean_up(path.poses @ mount)
    if up >= MIN_UP:
        return None
    if not placing.scanner_poses and mean_up(path.poses) > MIN_UPRIGHT:
        return "the poses look like the scanner's: with `--scanner-poses` its z axis points upwards"
    if not placing.scanner_poses and mean_up(path.poses @ np.linalg.inv(mount)) > MIN_UPRIGHT:
        option = "without" if placing.invert_extrinsics else "with"
        return f"extrinsics look inverted: {option} `--invert-extrinsics` the scanner's z axis points upwards"
    other = other_order(placing.quaternions)
    if up < -MIN_UPRIGHT and mean_up(trajectory_io.reordered(path, other).poses @ mount) > MIN_UPRIGHT:
        return f"{order_text(other)} the scanner's z axis points upwards"
    return (
        "the scanner's z axis doesn't point upwards: check that the poses are z-up, and the direction of the "
        "extrinsics (scanner axes to camera axes)"
    )


def mean_up(T: F64) -> float:
    """Mean z component of the z axes of poses (N, 4, 4)."""
    return float(T[:, 2, 2].mean())


def other_order(order: QuaternionOrder) -> QuaternionOrder:
    """The other order of quaternions."""
    return "wxyz" if order == "xyzw" else "xyzw"


def order_text(order: QuaternionOrder) -> str:
    """Beginning of a warning about the order of a trajectory's quaternions."""
    return f"quaternions of the trajectory look like {','.join(order)}: with `--quaternions {order}`"


def _read_mask(photos: PhotoInput) -> U8 | None:
    """Mask (H, W) of the photos.

    Raises:
        InputError: it can't be read, or hasn't the size of the photos.
    """
    if photos.mask is None:
        return None
    mask, size = read_rgb(photos.mask), (photos.camera.height, photos.camera.width)
    if mask.shape[:2] != size:
        raise InputError(photos.mask, f"is not {size[1]}x{size[0]} pixels", "Give a mask of the photos' size")
    return mask[..., 0]


@dataclass(frozen=True)
class _Album:
    """Posed photos of a camera: id of the camera, views, their times (P,), and the ego-vehicle mask (H, W) or None."""

    camera: str
    views: list[View]
    times: F64
    mask: U8 | None

    def nearest(self, time: float, centre: F64) -> View | None:
        """The photo nearest in time, if it was taken near a position (3,)."""
        if not self.views:
            return None
        view = self.views[int(np.abs(self.times - time).argmin())]
        return view if np.linalg.norm(view.centre - centre) < MAX_PHOTO_DISTANCE_M else None


def _album(
    photos: PhotoInput,
    scanner_path: ScannerPath,
    path: Trajectory,
    poses: Path,
    offset: float,
    T_camera_scanner: F64,
    T_camera_optical: F64,
    warn: Callable[[str], None],
) -> _Album:
    """Photos of a camera that have a reliable pose."""
    mask = _read_mask(photos)
    files = list_files(photos.folder, SUFFIXES, "photos")
    seconds = timestamps(files, photos.times, path, photos.folder, "photos", offset)
    good = np.flatnonzero(scanner_path.usable(seconds, 0.0, f"{len(files)} photos", poses, warn))
    extrinsics = T_camera_scanner if photos.extrinsics is None else photos.extrinsics
    T = np.concatenate([scanner_path.at(seconds[i : i + 1]) for i in good])
    T = T @ np.linalg.inv(extrinsics) @ T_camera_optical
    prefix = f"{photos.id}/" if photos.subfolder else ""
    views = [
        View(f"{prefix}{files[i].name}", photos.camera, T_world_cam, files[i], photos.mask, float(seconds[i]))
        for i, T_world_cam in zip(good, T, strict=True)
    ]
    return _Album(photos.id, views, seconds[good], mask)
