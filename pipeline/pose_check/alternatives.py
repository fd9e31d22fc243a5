"""Plausible alternatives to the poses and cameras of a tile's photos, each of which undoes a usual mistake."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools, Camera, Tile, View
from scan2sim.pipeline.io.geodata.crs import LOCAL, UNITS
from scan2sim.pipeline.pose_check import conventions
from scan2sim.pipeline.pose_check.conventions import AXES, PosedPhotos

FOCAL_RATIOS = (2.0, 4.0, 1.5, 0.5, 0.25, 2 / 3)
"""Usual ratios of the image size of a calibration to that of the photos."""
MIN_CENTRE_RATIO = 0.2
"""Relative deviation of the principal point from the middle of the photos from which it shows the images' size."""
UTM_CODES = ((32601, 32660), (32701, 32760), (25828, 25838))
"""First and last EPSG codes of families of neighbouring UTM zones."""
RIGID_M, RIGID_RAD = 0.05, 0.01
"""Largest deviations of a camera's pose relative to the scanner, if photos were posed by the scanner's path."""
CAMERA_AXES = (("opengl", "y up, z back, as in OpenGL"), ("ros", "x ahead, z up, as in ROS"))
"""Camera axes other than OpenCV's, and their description."""
MAX_FRAMES = 2
"""Largest error in the times or the order of photos that is tried, frames."""


@dataclass(frozen=True)
class Alternative:
    """Other poses or cameras of all photos.

    Attributes:
        what: the mistake, as a sentence without its end: "rotations look transposed".
        option: the option of the import that undoes it.
        T: (V, 4, 4) camera to local coordinates, NaN: no pose, or not concerned.
        cameras: camera of each view.
    """

    what: str
    option: str
    T: F64
    cameras: tuple[Camera, ...]


def alternatives(tile: Tile, views: Sequence[View]) -> Iterator[Alternative]:
    """Alternatives to the given poses, each with the option of its importer."""
    origin = np.asarray(tile.frame.origin)
    T = np.array([view.T_world_cam for view in views])
    T[:, :3, 3] += origin
    photos = PosedPhotos(T, tuple(view.camera for view in views), tile.frame)

    def made(what: str, option: str, changed: PosedPhotos, known: Bools | None = None) -> Alternative:
        T = changed.T.copy()
        T[:, :3, 3] -= origin
        if known is not None:
            T[~known] = np.nan
        return Alternative(what, option, T, changed.cameras)

    if on_path := _posed_by_path(tile, views):
        yield from (made(what, option, replace(photos, T=T), known) for what, option, T, known in on_path(photos.T))
        return
    yield made("rotations look transposed", "--rotations T_cam_world", conventions.transposed(photos))
    for axes, name in CAMERA_AXES:
        turned = photos.rotated(photos.R @ AXES[axes])
        yield made(f"camera axes look like {name}", f"--camera-axes {axes}", turned)
    for order, shift in conventions.QUATERNION_SHIFTS.items():
        if shift:
            reordered = conventions.reordered_quaternions(photos, shift)
            yield made(f"quaternions look like {order}", f"--quaternions {order}", reordered)
    yield made("x and y of the positions look swapped", "--position-axes yx", conventions.swapped_axes(photos))
    for what, option, change in (*_georeferenced(tile), *_units(tile)):
        yield made(what, option, change(photos))
    for width, height, cameras in _calibrations(photos.cameras):
        what = f"focal lengths look like those of images of {width} x {height} pixels"
        perspective = np.array([camera.model not in conventions.WITHOUT_FOCAL_LENGTH for camera in cameras])
        yield made(what, f"--intrinsics-size {width}x{height}", replace(photos, cameras=cameras), perspective)
    for shift in (-1, 1):
        what = f"photos look paired with the pose of the {'next' if shift < 0 else 'previous'} one"
        yield made(what, f"--pose-shift {shift}", *conventions.shifted(photos, shift))


Change = Callable[[PosedPhotos], PosedPhotos]


def _georeferenced(tile: Tile) -> Iterator[tuple[str, str, Change]]:
    """Alternatives of positions in a projected CRS: latitude and longitude, UTM zone."""
    if tile.frame.crs == LOCAL:
        return

    def swapped_degrees(photos: PosedPhotos) -> PosedPhotos:
        return conventions.from_crs(conventions.swapped_axes(conventions.to_crs(photos, "EPSG:4326")), "EPSG:4326")

    yield "latitude and longitude look swapped", "--position-axes yx", swapped_degrees
    code = tile.frame.crs.removeprefix("EPSG:")
    for first, last in UTM_CODES:
        if code.isdigit() and first <= int(code) <= last:
            for other in (int(code) - 1, int(code) + 1):
                if first <= other <= last:
                    crs = f"EPSG:{other}"
                    yield f"positions look like {crs}", f"--photos-crs {crs}", _from(crs)


def _from(crs: str) -> Change:
    return lambda photos: conventions.from_crs(photos, crs)


def _units(tile: Tile) -> Iterator[tuple[str, str, Change]]:
    """Alternatives of positions in another unit."""
    for unit, name in (("ft", "feet"), ("m", "metres")):
        factor = UNITS[unit] / tile.frame.unit
        if abs(factor - 1) > 1e-3:
            yield f"positions look like {name}", f"--photos-units {unit}", _scaled(factor)


def _scaled(factor: float) -> Change:
    return lambda photos: photos.at(photos.positions * factor)


def _calibrations(cameras: tuple[Camera, ...]) -> Iterator[tuple[int, int, tuple[Camera, ...]]]:
    """Cameras whose intrinsics are taken for those of images of another size, and that size.

    The size follows from the principal point, unless it is in the middle of the photos.
    """
    perspective = {camera for camera in cameras if camera.model not in conventions.WITHOUT_FOCAL_LENGTH}
    sizes = {(camera.width, camera.height) for camera in perspective}
    if len(sizes) != 1:
        return
    centre_ratio = float(np.median([(2 * camera.cx + 1) / camera.width for camera in perspective]))
    ratios: Sequence[float] = FOCAL_RATIOS
    if abs(centre_ratio - 1) > MIN_CENTRE_RATIO:
        ratios = [ratio for ratio in FOCAL_RATIOS if abs(ratio / centre_ratio - 1) < MIN_CENTRE_RATIO] or [centre_ratio]
    for ratio in ratios:
        width, height = (round(side * ratio) for side in next(iter(sizes)))
        yield width, height, tuple(conventions.for_size(camera, width, height) for camera in cameras)


OnPath = Callable[[F64], Iterator[tuple[str, str, F64, Bools | None]]]


def _posed_by_path(tile: Tile, views: Sequence[View]) -> OnPath | None:
    """Function that makes alternatives if photos were posed by the scanner's path and their times; None otherwise."""
    path, times = tile.trajectory, [view.time for view in views]
    if path is None or path.rotations is None or len(path) < 2 or any(time is None for time in times):
        return None
    seconds = np.array(times, np.float64)
    T_world_scanner = path.pose_at(seconds)
    T_world_scanner[:, :3, 3] += np.asarray(tile.frame.origin)
    T_world_cam = np.array([view.T_world_cam for view in views])
    T_world_cam[:, :3, 3] += np.asarray(tile.frame.origin)
    T_scanner_cam = np.linalg.inv(T_world_scanner) @ T_world_cam
    cameras = conventions.camera_rows([view.camera for view in views])
    for rows in cameras:
        middle = T_scanner_cam[rows[len(rows) // 2]]
        apart = np.linalg.inv(middle) @ T_scanner_cam[rows]
        turn = np.arccos(np.clip((np.trace(apart[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
        if np.median(np.linalg.norm(apart[:, :3, 3], axis=1)) > RIGID_M or np.median(turn) > RIGID_RAD:
            return None

    def on_path(T: F64) -> Iterator[tuple[str, str, F64, Bools | None]]:
        yield "extrinsics look inverted", "--invert-extrinsics", T_world_scanner @ np.linalg.inv(T_scanner_cam), None
        for axes, name in CAMERA_AXES:
            turn = np.eye(4)
            turn[:3, :3] = AXES[axes]
            yield f"camera axes look like {name}", f"--camera-axes {axes}", T_world_cam @ turn, None
        steps = [np.diff(np.unique(seconds[rows])) for rows in cameras]
        frame = float(np.median(np.concatenate(steps))) if any(map(len, steps)) else 0.0
        if not frame:
            return
        for frames in (frames for k in range(1, MAX_FRAMES + 1) for frames in (-k, k)):
            moved = seconds + frames * frame
            known = (moved >= path.times[0] - 1e-6) & (moved <= path.times[-1] + 1e-6)
            at = path.pose_at(moved)
            at[:, :3, 3] += np.asarray(tile.frame.origin)
            what = f"times of the photos look {abs(frames) * frame:.3g} s too {'early' if frames > 0 else 'late'}"
            yield what, f"--photo-time-offset {frames * frame:.3g}", at @ T_scanner_cam, known

    return on_path
