"""Conventions in which the poses and cameras of photos may be given, and their conversion to those of a tile.

Tiles have camera-to-world poses with OpenCV's axes, positions in the CRS of the clouds, and intrinsics for the size of
the photos. Importers convert what the user's options name; `pose_check.alternatives` tries what no option names.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import F64, Bools, Camera, Frame
from scan2sim.pipeline.io.geodata.crs import UNITS

CameraAxes = Literal["opencv", "opengl", "ros"]
AXES: dict[str, F64] = {
    "opencv": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ros": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
"""(3, 3) rotations from OpenCV's camera axes to others: x right, y up, z back (OpenGL); x ahead, y left, z up (ROS)."""
QUATERNION_SHIFTS = {"as-named": 0, "xyzw": 1, "wxyz": -1}
"""Order of the values in a row of four numbers, relative to the one that the columns' names claim."""
WITHOUT_FOCAL_LENGTH = ("equirectangular", "orthographic")
NORTH_STEP = 1e-5
"""Part of a degree, or of 100 km, over which the direction of north is computed."""


def _size(text: str) -> str:
    if text and not re.fullmatch(r"[1-9]\d{0,5}x[1-9]\d{0,5}", text):
        raise ValueError("must be WIDTHxHEIGHT")
    return text


class PhotoConventions(Params):
    """How posed photos are given where it isn't as documented: the options of `scan2sim import clouds`."""

    rotations: Literal["T_world_cam", "T_cam_world"] = Field(
        "T_world_cam", description="Direction of the photos' rotations: camera to world, or world to camera."
    )
    camera_axes: CameraAxes = Field(
        "opencv",
        description="Camera axes of the photos' rotations: opencv (x right, y down, z ahead), opengl (x right, y up, "
        "z back), or ros (a body's: x ahead, y left, z up).",
    )
    quaternions: Literal["as-named", "xyzw", "wxyz"] = Field(
        "as-named",
        description="Order of the photos' quaternions: as the columns are named; xyzw: columns qw,qx,qy,qz hold "
        "x,y,z,w; wxyz: columns qx,qy,qz,qw hold w,x,y,z.",
    )
    position_axes: Literal["xy", "yx"] = Field(
        "xy", description="Order of the photos' positions: yx if x holds the northing or latitude, and y the other."
    )
    photos_crs: str = Field(
        "", description='CRS of the photos\' positions, if not that of the clouds: "EPSG:32632", "EPSG:4326".'
    )
    photos_units: Literal["", "m", "ft", "us-ft"] = Field(
        "", description="Unit of the photos' positions, if not that of the clouds: m, ft or us-ft."
    )
    intrinsics_size: Annotated[str, AfterValidator(_size)] = Field(
        "", description="Size of the images for which focal lengths and centres are given, WIDTHxHEIGHT."
    )
    pose_shift: int = Field(
        0,
        ge=-1000,
        le=1000,
        description="Give each photo the pose of the row that follows N rows later (or before: -N).",
    )


@dataclass(frozen=True)
class PosedPhotos:
    """Photos in the order in which they were taken or listed.

    Attributes:
        T: (N, 4, 4) camera to world; positions are in the CRS, but in metres.
        cameras: camera of each, the same object for all photos of a camera.
        frame: CRS and unit; its origin isn't used.
    """

    T: F64
    cameras: tuple[Camera, ...]
    frame: Frame

    def rotated(self, R: F64) -> PosedPhotos:
        """With other rotations (N, 3, 3)."""
        T = self.T.copy()
        T[:, :3, :3] = R
        return replace(self, T=T)

    def at(self, positions: F64) -> PosedPhotos:
        """At other positions (N, 3), metres."""
        T = self.T.copy()
        T[:, :3, 3] = positions
        return replace(self, T=T)

    @property
    def R(self) -> F64:
        """(N, 3, 3) rotations, camera to world."""
        return self.T[:, :3, :3]

    @property
    def positions(self) -> F64:
        """(N, 3) camera centres, metres."""
        return self.T[:, :3, 3]


def converted(photos: PosedPhotos, given: PhotoConventions) -> tuple[PosedPhotos, Bools]:
    """Photos in the conventions of a tile, and (N,) bool, False for those that `pose_shift` leaves without a pose.

    Args:
        photos: their poses and cameras as given, positions multiplied by the unit of the clouds.
        given: the conventions that they are given in.

    Raises:
        InputError: an unknown CRS.
    """
    photos, known = shifted(photos, given.pose_shift)
    if given.quaternions != "as-named":
        photos = reordered_quaternions(photos, QUATERNION_SHIFTS[given.quaternions])
    if given.rotations == "T_cam_world":
        photos = transposed(photos)
    photos = photos.rotated(photos.R @ AXES[given.camera_axes])
    if given.photos_units:
        photos = photos.at(photos.positions * UNITS[given.photos_units] / photos.frame.unit)
    if given.position_axes == "yx":
        photos = swapped_axes(photos)
    if given.photos_crs:
        photos = from_crs(photos, given.photos_crs)
    if given.intrinsics_size:
        width, height = map(int, given.intrinsics_size.split("x"))
        photos = replace(photos, cameras=tuple(for_size(camera, width, height) for camera in photos.cameras))
    return photos, known


def transposed(photos: PosedPhotos) -> PosedPhotos:
    """With rotations in the opposite direction."""
    return photos.rotated(photos.R.transpose(0, 2, 1))


def reordered_quaternions(photos: PosedPhotos, shift: int) -> PosedPhotos:
    """With the four numbers of each quaternion, (x, y, z, w), shifted cyclically."""
    from scipy.spatial.transform import Rotation

    return photos.rotated(Rotation.from_quat(np.roll(Rotation.from_matrix(photos.R).as_quat(), shift, 1)).as_matrix())


def swapped_axes(photos: PosedPhotos) -> PosedPhotos:
    """With x and y of the positions exchanged."""
    return photos.at(photos.positions[:, [1, 0, 2]])


def from_crs(photos: PosedPhotos, crs: str) -> PosedPhotos:
    """With positions converted from another CRS, and rotations turned by the angle between both north directions.

    Raises:
        InputError: unknown CRS.
    """
    return _reprojected(photos, crs, photos.frame.crs, photos.frame.unit)


def to_crs(photos: PosedPhotos, crs: str) -> PosedPhotos:
    """The inverse of `from_crs`."""
    return _reprojected(photos, photos.frame.crs, crs, photos.frame.unit)


def _reprojected(photos: PosedPhotos, source: str, target: str, unit: float) -> PosedPhotos:
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    from scan2sim.pipeline.core.errors import SettingError

    try:
        given, wanted = CRS.from_user_input(source), CRS.from_user_input(target)
        transformer = Transformer.from_crs(given, wanted, always_xy=True)
    except CRSError as error:
        raise SettingError("--photos-crs", f"unknown CRS ({error})", "Give a code such as EPSG:32632") from None
    raw = photos.positions / unit
    x, y = transformer.transform(raw[:, 0], raw[:, 1])
    north_x, north_y = transformer.transform(raw[:, 0], raw[:, 1] + NORTH_STEP * (1.0 if given.is_geographic else 1e5))
    with np.errstate(invalid="ignore"):  # infinite outside of the area of a CRS
        east = (north_x - x) * (np.cos(np.radians(y)) if wanted.is_geographic else 1.0)
        angle = np.arctan2(-east, north_y - y)
    cos, sin, zero, one = np.cos(angle), np.sin(angle), np.zeros(len(raw)), np.ones(len(raw))
    turn = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    return photos.at(np.column_stack([x, y, raw[:, 2]]) * unit).rotated(turn @ photos.R)


def for_size(camera: Camera, width: int, height: int) -> Camera:
    """The camera whose intrinsics were given for images of another size; a centre that fits its own size stays."""
    if camera.model in WITHOUT_FOCAL_LENGTH:
        return camera
    sx, sy = camera.width / width, camera.height / height
    cx, cy = (camera.cx + 0.5) * sx - 0.5, (camera.cy + 0.5) * sy - 0.5
    middle = (camera.width - 1) / 2
    if abs(cx - middle) > abs(camera.cx - middle):
        cx, cy = camera.cx, camera.cy
    return replace(camera, fx=camera.fx * sx, fy=camera.fy * sy, cx=cx, cy=cy)


def shifted(photos: PosedPhotos, shift: int) -> tuple[PosedPhotos, Bools]:
    """Each photo with the pose of the one `shift` later, among those of the same camera; and whether there is one."""
    T, known = photos.T.copy(), np.ones(len(photos.T), bool)
    for rows in camera_rows(photos.cameras):
        source = rows_at(len(rows), shift)
        found = source >= 0
        T[rows[found]] = photos.T[rows[source[found]]]
        known[rows[~found]] = False
    return replace(photos, T=T), known


def rows_at(count: int, shift: int) -> np.ndarray:
    """(N,) row numbers `shift` later; -1 where there is none."""
    rows = np.arange(count) + shift
    return np.where((rows >= 0) & (rows < count), rows, -1)


def camera_rows(cameras: Sequence[Camera]) -> list[np.ndarray]:
    """Indices of the photos of each camera, in order; different cameras with the same intrinsics are other objects."""
    keys = np.array([id(camera) for camera in cameras], np.int64)
    return [np.flatnonzero(keys == key) for key in dict.fromkeys(keys.tolist())]
