"""Value types passed between steps: frozen dataclasses, spatial ones with their CRS and origin.

Conventions, everywhere inside: metres; world z-up; camera axes of OpenCV (x right, y down,
z forward); poses are `T_world_cam` (camera to world). World coordinates are float64; a `Frame`'s
origin is subtracted before anything becomes float32 ("local" coordinates below).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.voronoi_cell import Cell

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Colour = tuple[int, int, int]
"""sRGB, 0 to 255."""

CameraModel = Literal["pinhole", "opencv", "fisheye", "equirectangular", "orthographic"]


@dataclass(frozen=True)
class Frame:
    """Frame of local coordinates: `crs = (local + origin) / unit`.

    Attributes:
        crs: WKT or authority code of the CRS; "local" where there is none.
        origin: (3,) metres, subtracted from world coordinates.
        unit: metres per unit of the CRS's axes (0.3048 for international feet).

    NumPy scalars are converted to Python floats, whose text form and comparison don't depend on NumPy's version.
    """

    crs: str = "local"
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: float = 1.0

    def __post_init__(self) -> None:
        x, y, z = (float(value) for value in self.origin)
        object.__setattr__(self, "origin", (x, y, z))
        object.__setattr__(self, "unit", float(self.unit))

    def to_local(self, xyz: npt.ArrayLike) -> F64:
        """CRS coordinates (..., 3) to local metres, float64."""
        return np.asarray(xyz, np.float64) * self.unit - np.asarray(self.origin)

    def to_crs(self, xyz: npt.ArrayLike) -> F64:
        """Local metres (..., 3) to CRS coordinates, float64."""
        return (np.asarray(xyz, np.float64) + np.asarray(self.origin)) / self.unit


@dataclass(frozen=True)
class Camera:
    """A camera's intrinsics.

    Attributes:
        model: "pinhole"; "opencv" (Brown-Conrady, k1 k2 p1 p2 [k3 [k4 k5 k6]]); "fisheye" (OpenCV's
            equidistant model, k1 k2 k3 k4); "equirectangular" (full sphere; column 0 looks back,
            the centre looks along +z, the right half along +x; fx, fy, cx, cy unused); "orthographic" (all rays
            along +z; fx, fy in pixels per metre).
        width, height: pixels.
        fx, fy, cx, cy: pixels; the centre of the top left pixel is (0, 0), as in OpenCV.
        distortion: coefficients in the order given under `model`.
    """

    model: CameraModel
    width: int
    height: int
    fx: float = 0.0
    fy: float = 0.0
    cx: float = 0.0
    cy: float = 0.0
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Take coefficients as lists, and as arrays, which OpenCV's functions return, too: caches need to hash them."""
        if not isinstance(self.distortion, tuple):
            object.__setattr__(self, "distortion", tuple(np.ravel(self.distortion).tolist()))

    def scaled(self, factor: float) -> Camera:
        """The camera of the photo resized by `factor` (pixel centres kept aligned)."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the photo resized to `width` x `height` pixels (pixel centres kept aligned)."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5, cy=(self.cy + 0.5) * sy - 0.5,
        )  # fmt: skip


@dataclass(frozen=True)
class View:
    """A posed photo.

    Attributes:
        name: unique within the tile.
        camera: its intrinsics.
        T_world_cam: (4, 4) float64, camera to local coordinates.
        photo: path of the image file.
        mask: path of a single-channel image, 0 where the photo must not be used, or None.
        time: GPS time in seconds, or None.
    """

    name: str
    camera: Camera
    T_world_cam: F64
    photo: Path
    mask: Path | None = None
    time: float | None = None

    @property
    def centre(self) -> F64:
        """(3,) camera centre, local coordinates."""
        return self.T_world_cam[:3, 3]


@dataclass(frozen=True)
class _Stored:
    """Arrays and a frame that are stored as an uncompressed .npz."""

    def save(self, path: Path) -> None:
        """Write as .npz."""
        arrays: dict[str, Any] = {}
        for f in fields(self):
            part = getattr(self, f.name)
            if isinstance(part, Frame):
                arrays["frame"] = np.array([part.crs, repr(part.origin), repr(part.unit)])
            elif part is not None:
                arrays[STORED.get(f.name, f.name)] = part
        with open(path, "wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote."""
        with np.load(path) as data:
            attribute = {stored: name for name, stored in STORED.items()}
            arrays = {attribute.get(name, name): data[name] for name in data.files}
        if "frame" in arrays:
            crs, origin, unit = arrays.pop("frame").tolist()
            x, y, z = (float(part) for part in origin.strip("()").split(","))
            arrays["frame"] = Frame(crs, (x, y, z), float(unit))
        return cls(**arrays)


@dataclass(frozen=True)
class Trajectory(_Stored):
    """The path of a scanner or a camera.

    Attributes:
        times: (T,) seconds, ascending.
        positions: (T, 3) local metres, float64.
        rotations: (T, 3, 3), sensor axes to local coordinates, or None if only positions are known.
        unsure: (T,) bool, True where the pose is dead-reckoned (interpolated or extrapolated), not measured; or None.
        covariance: (T, 6, 6) of position (m) and rotation (rad, about the local axes), or None.
    """

    times: F64
    positions: F64
    rotations: F64 | None = None
    unsure: npt.NDArray[np.bool_] | None = None
    covariance: F64 | None = None

    def __len__(self) -> int:
        return len(self.times)

    @property
    def poses(self) -> F64:
        """(T, 4, 4) sensor to local coordinates; requires rotations."""
        assert self.rotations is not None
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.rotations, self.positions
        return poses

    def at(self, times: F64) -> F64:
        """(N, 3) positions at `times`, linearly interpolated, constant beyond both ends."""
        return np.stack([np.interp(times, self.times, self.positions[:, k]) for k in range(3)], axis=-1)

    def pose_at(self, times: npt.ArrayLike) -> F64:
        """(N, 4, 4) sensor to local coordinates at `times` (N,), constant beyond both ends; requires rotations.

        Interpolated by `pipeline.core.poses.interpolate`.
        """
        moments = np.clip(np.asarray(times, np.float64), self.times[0], self.times[-1])
        return interpolate(self.poses, self.times, moments)


@dataclass(frozen=True)
class GpsTrack:
    """Positions of a GPS receiver.

    Attributes:
        times: (N,) seconds, ascending: UNIX time, or the video's own clock for telemetry inside a video.
        positions: (N, 3) metres east, north, up, local to `frame`; heights as reported by the receiver.
        sigma: (N,) metres, standard deviation per horizontal axis, derived from the receiver's DOP, or None.
        frame: UTM zone of the track, origin near its first fix; "local" for a file of local metres.
        epoch: UNIX time at which `times` are 0, if a video's telemetry contains it, or None.
        scatter: metres, standard deviation per horizontal axis of the noise that remains after smoothing.
    """

    times: F64
    positions: F64
    sigma: F64 | None = None
    frame: Frame = field(default_factory=Frame)
    epoch: float | None = None
    scatter: float = 0.0

    def __len__(self) -> int:
        return len(self.times)

    def shifted(self, seconds: float) -> GpsTrack:
        """The track with `seconds` added to its times: a video that began at UNIX time t0 needs -t0."""
        return replace(self, times=self.times + seconds, epoch=None if self.epoch is None else self.epoch - seconds)

    def at(self, times: npt.ArrayLike, max_gap: float = 3.0) -> F64:
        """(M, 3) positions at `times` (M,), linearly interpolated; NaN outside and within gaps over `max_gap` s."""
        moments = np.asarray(times, np.float64)
        after = np.minimum(np.searchsorted(self.times, moments), len(self) - 1)
        before = np.maximum(after - 1, 0)
        near = self.times[after] - self.times[before] <= max_gap
        inside = (moments >= self.times[0]) & (moments <= self.times[-1]) & (near | (moments == self.times[after]))
        positions = np.stack([np.interp(moments, self.times, self.positions[:, k]) for k in range(3)], axis=-1)
        return np.where(inside[..., None], positions, np.nan)

    def distance(self, start: npt.ArrayLike, end: npt.ArrayLike, max_gap: float = 3.0) -> F64:
        """Straight-line distance in metres between the positions at times `start` and `end` (M,); NaN as in `at`.

        Short distances on a track that wasn't smoothed are mostly noise: use at least 1 s or 50 m.
        """
        return np.linalg.norm(self.at(end, max_gap) - self.at(start, max_gap), axis=-1)


STORED = {"classification": "label"}
"""Attribute name: array name in a .npz, where they differ (compatibility with older files)."""


UNCOLOURED = 128
"""Grey level (all channels) of points of unknown colour in a cloud that has colours."""


@dataclass(frozen=True)
class PointCloud(_Stored):
    """Points in local coordinates with their attributes; absent attributes are None.

    Attributes:
        frame: CRS and origin.
        xyz: (N, 3) float32, local metres.
        rgb: (N, 3) uint8; `UNCOLOURED` where unknown.
        normal: (N, 3) float32, unit.
        classification: (N,) uint8, LAS class codes (`pipeline.core.classes`).
        time: (N,) float64, GPS time in seconds.
        intensity: (N,) uint16.
    """

    frame: Frame
    xyz: F32
    rgb: U8 | None = None
    normal: F32 | None = None
    classification: U8 | None = None
    time: F64 | None = None
    intensity: npt.NDArray[np.uint16] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def coloured(self) -> npt.NDArray[np.bool_]:
        """(N,) bool, True for points with a known colour."""
        return np.zeros(len(self), bool) if self.rgb is None else (self.rgb != UNCOLOURED).any(axis=1)

    def take(self, index: npt.NDArray[Any] | slice) -> Self:
        """The points that `index` (integers, mask or slice) selects."""
        parts = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "frame"}
        return replace(self, **{k: v[index] for k, v in parts.items() if v is not None})

    @staticmethod
    def join(clouds: Sequence[PointCloud]) -> PointCloud:
        """Concatenate clouds that share a frame.

        If only some clouds have colours or classes, the other points become grey or class 1 (unclassified); other
        attributes are dropped unless all clouds have them.
        """
        if len(clouds) == 1:
            return clouds[0]

        def column(name: str, filler: tuple[Any, Any] | None = None) -> Any:
            values = [getattr(c, name) for c in clouds]
            if filler is not None and any(v is not None for v in values):
                value, kind = filler
                shape = {"rgb": (3,)}.get(name, ())
                values = [
                    np.full((len(c), *shape), value, kind) if v is None else v
                    for c, v in zip(clouds, values, strict=True)
                ]
            return None if any(v is None for v in values) else np.concatenate(values)

        return PointCloud(
            clouds[0].frame,
            column("xyz"),
            column("rgb", (UNCOLOURED, np.uint8)),
            column("normal"),
            column("classification", (1, np.uint8)),
            column("time"),
            column("intensity"),
        )


@dataclass(frozen=True)
class Mesh(_Stored):
    """Triangles in local coordinates, oriented counter-clockwise seen from outside.

    Attributes:
        frame: CRS and origin.
        vertices: (V, 3) float32, local metres.
        faces: (F, 3) int32, into `vertices`.
        density: (V,) float32, octree depth of the Poisson samples near the vertex, or None.
        uv: (F, 3, 2) float32, per corner in [0, 1], origin at the lower left (as in OBJ), or None.
        page: (F,) int16, index of the face's texture page, or None.
        classification: (F,) uint8, LAS class codes, or None.
    """

    frame: Frame
    vertices: F32
    faces: I32
    density: F32 | None = None
    uv: F32 | None = None
    page: npt.NDArray[np.int16] | None = None
    classification: U8 | None = None

    def __len__(self) -> int:
        return len(self.faces)

    @property
    def corners(self) -> F32:
        """(F, 3, 3) the three corners of every face."""
        return self.vertices[self.faces]

    @property
    def face_area(self) -> F32:
        """(F,) m2."""
        return np.linalg.norm(self._cross, axis=1) / 2

    @property
    def face_normal(self) -> F32:
        """(F, 3) unit, zero for degenerate faces."""
        cross = self._cross
        return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-20)

    @property
    def _cross(self) -> F32:
        c = self.corners
        return np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])

    def moved_to(self, frame: Frame) -> Mesh:
        """The same mesh in local coordinates of another frame (of the same CRS)."""
        shift = np.asarray(self.frame.origin) - np.asarray(frame.origin)
        return replace(self, frame=frame, vertices=(self.vertices + shift).astype(np.float32))

    def keep(self, mask: npt.NDArray[np.bool_]) -> Mesh:
        """The faces selected by `mask` (F,), without unused vertices."""
        faces = self.faces[mask]
        used = np.zeros(len(self.vertices), bool)
        used[faces] = True
        renumber = np.cumsum(used, dtype=np.int32) - 1
        return replace(
            self,
            vertices=self.vertices[used],
            faces=renumber[faces],
            density=None if self.density is None else self.density[used],
            uv=None if self.uv is None else self.uv[mask],
            page=None if self.page is None else self.page[mask],
            classification=None if self.classification is None else self.classification[mask],
        )


@dataclass(frozen=True)
class RobotMap:
    """What a tile keeps of the robot's map that it was made from (`pipeline.importers.robot_map`).

    Attributes:
        scene: whether it shows rooms or streets.
        spacing: typical distance of neighbouring points, metres.
        unit: metres per unit of the map's coordinates.
        T_world_map: (4, 4) float64, the map's frame (in metres) to the level world.
        source_mesh: textured mesh that the map was made from (`pipeline.io.source_mesh`), or None.
    """

    scene: Literal["indoor", "outdoor"]
    spacing: float
    unit: float
    T_world_map: F64
    source_mesh: Path | None = None


@dataclass(frozen=True)
class Tile:
    """Validated contents of a `tile.toml` (`pipeline.io.tile`).

    Attributes:
        path: the `tile.toml`.
        name: name of the tile and its world.
        frame: CRS, unit and origin (near the tile's data) that the clouds are converted to.
        clouds: point cloud files.
        views: posed photos, poses in the frame's local coordinates.
        trajectory: the scanner's path, or None.
        classes: the user's mapping of codes in the clouds to ours (`pipeline.core.classes`).
        cell: the tile's cell within the survey that it was cut from, or None: everything belongs to the tile.
        footprints: file of building footprint polygons (GeoJSON, GeoPackage), or None.
        truth_mesh: ground-truth surface (.npz `Mesh` with its classes), for generated tiles, or None.
        truth_points: ground-truth coloured surface samples (LAZ), for generated tiles, or None.
        robot_map: properties of the robot's map that the tile was made from, or None.
    """

    path: Path
    name: str
    frame: Frame
    clouds: tuple[Path, ...]
    views: tuple[View, ...] = ()
    trajectory: Trajectory | None = None
    classes: Mapping[int, int] = field(default_factory=dict)
    cell: Cell | None = None
    footprints: Path | None = None
    truth_mesh: Path | None = None
    truth_points: Path | None = None
    robot_map: RobotMap | None = None
