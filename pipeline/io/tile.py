"""The tile: `tile.toml` lists clouds, photos, cameras and poses, CRS and units.

```toml
name = "my_street"
crs = "EPSG:32633"          # code or WKT; "local" without georeference; default: the clouds' own
units = "m"                 # "ft", "us-ft"; default: the unit of the CRS, else metres
clouds = ["cloud.laz"]      # LAS, LAZ, COPC, PLY, E57, PCD, PTX, XYZ, CSV; coordinates in that CRS and unit
trajectory = "path.csv"     # optional: the scanner's path, time,x,y,z or with rotations (.csv, .tum)
orthophoto = "ortho.tif"    # optional: GeoTIFF, or JPEG, PNG, TIFF with a world file; in the CRS
footprints = "houses.gpkg"  # optional: building footprints, GeoJSON or GeoPackage

[classes]                   # optional: meaning of class codes of the clouds that differ from docs/reference/formats.md
65 = "noise"

[[cameras]]
id = "front"
model = "opencv"            # pinhole, opencv (Brown-Conrady), fisheye, equirectangular, orthographic
size = [1920, 1080]         # pixels
focal = [1000.0, 1000.0]    # fx, fy in pixels (not for equirectangular)
centre = [959.5, 539.5]     # cx, cy in pixels; the centre of the top left pixel is (0, 0)
distortion = [-0.1, 0.01, 0.0, 0.0]

[[photos]]
file = "photos/0001.jpg"
camera = "front"
position = [500010.2, 5400020.1, 210.5]               # camera centre, CRS coordinates
rotation = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]        # camera to world; x right, y down, z forward
time = 1234.5               # optional: GPS time, seconds
mask = "masks/0001.png"     # optional: 0 where the photo must not be used
name = "photos/0001"        # optional: name of the view; default: the file without its suffix
```
Paths are relative to the `tile.toml`. A tile that was cut from a survey also has its Voronoi cell:
`[cell]` with `seed` (x, y in the CRS) and `[cell.neighbours]`, names of tiles to their seeds
(`pipeline.core.voronoi_cell`). A generated tile also has its ground truth:
`[truth]` with `mesh` and `points`. A tile of a robot's map has `[robot_map]` with `scene` (indoor or outdoor),
`spacing` of its points (m), the map's `unit` (m), and `T_world_map`, from the map's frame to the level world; of a
textured mesh, `source_mesh` is its file in the world's axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scan2sim.pipeline.core.classes import mapping, name_of
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import MAX_NAME, WorldName, is_reserved
from scan2sim.pipeline.core.poses import nearest_rotation
from scan2sim.pipeline.core.types import Camera, CameraModel, Frame, RobotMap, Tile, Trajectory, View
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import file_checks, toml
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.geodata import orthophoto

Vector = tuple[float, float, float]
MAX_PIXELS, MAX_DISTORTION = 1e6, 1e6
"""Limits of a camera's focal lengths and centre (pixels) and of its distortion coefficients."""
DISTORTION_LENGTHS = {
    "pinhole": (0,), "opencv": (0, 4, 5, 8), "fisheye": (0, 4), "equirectangular": (0,), "orthographic": (0,),
}  # fmt: skip


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CameraEntry(_Strict):
    """A `[[cameras]]` entry of `tile.toml`."""

    id: str
    model: CameraModel
    size: tuple[int, int]
    focal: tuple[float, float] = (0.0, 0.0)
    centre: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, ...] = ()


class PhotoEntry(_Strict):
    """A `[[photos]]` entry of `tile.toml`."""

    file: str
    camera: str
    position: Vector
    rotation: tuple[Vector, Vector, Vector]
    time: float | None = None
    mask: str | None = None
    name: str | None = None


class TruthEntry(_Strict):
    """The `[truth]` entry of a generated tile."""

    mesh: str
    points: str


class CellEntry(_Strict):
    """The `[cell]` entry of a tile that was cut from a survey; seeds in CRS coordinates, the buffer in metres."""

    seed: tuple[float, float]
    neighbours: dict[str, tuple[float, float]] = {}
    buffer: float = Field(5.0, ge=0)


class RobotMapEntry(_Strict):
    """The `[robot_map]` entry of a tile that was made from a robot's map; lengths in metres."""

    scene: Literal["indoor", "outdoor"]
    spacing: float = Field(gt=0, le=100)
    unit: float = Field(1.0, gt=0, le=1000)
    T_world_map: tuple[tuple[float, float, float, float], ...] = Field(min_length=4, max_length=4)
    source_mesh: str | None = None


class TileFile(_Strict):
    """Schema of `tile.toml`."""

    name: WorldName
    crs: str | None = None
    units: Literal["m", "ft", "us-ft"] | None = None
    clouds: tuple[str, ...] = Field(min_length=1)
    trajectory: str | None = None
    classes: dict[str, str | int] = {}
    orthophoto: str | None = None
    footprints: str | None = None
    cameras: tuple[CameraEntry, ...] = ()
    photos: tuple[PhotoEntry, ...] = ()
    cell: CellEntry | None = None
    truth: TruthEntry | None = None
    robot_map: RobotMapEntry | None = None


def read_tile(path: Path) -> Tile:
    """Read and validate a tile: a `tile.toml`, or a folder that contains one.

    The frame's origin is the middle of the clouds' bounding box in x and y and its bottom in z,
    in whole metres.

    Raises:
        InputError: names the file, the field and what was expected.
    """
    path = path / "tile.toml" if path.is_dir() else path
    spec = read_spec(path)
    clouds = tuple(_cloud(path, name) for name in spec.clouds)
    headers = [cloud_io.read_header(cloud) for cloud in clouds]
    crs, unit = crs_io.common(path, spec.crs, spec.units, clouds, headers)
    low = np.min([h.low for h in headers], axis=0) * unit
    high = np.max([h.high for h in headers], axis=0) * unit
    x, y, z = np.floor([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]).tolist()
    frame = Frame(crs, (x, y, z), unit)
    cameras = {entry.id: camera_of(path, entry) for entry in spec.cameras}
    if len(cameras) < len(spec.cameras):
        duplicate = next(c.id for i, c in enumerate(spec.cameras) if c.id in {other.id for other in spec.cameras[:i]})
        raise InputError(path, f"has two cameras `{duplicate}`", "Give each camera a unique id")
    views = [_view(path, i, entry, cameras, frame) for i, entry in enumerate(spec.photos)]
    if spec.orthophoto:
        views.append(orthophoto.read_view(_existing(path, spec.orthophoto, "orthophoto"), frame, float(high[2])))
    return Tile(
        path=path,
        name=spec.name,
        frame=frame,
        clouds=clouds,
        views=tuple(views),
        trajectory=_trajectory(path, spec, frame),
        classes=_classes(path, spec),
        cell=_cell(spec.cell, unit),
        footprints=_existing(path, spec.footprints, "footprints") if spec.footprints else None,
        truth_mesh=_existing(path, spec.truth.mesh, "truth.mesh") if spec.truth else None,
        truth_points=_existing(path, spec.truth.points, "truth.points") if spec.truth else None,
        robot_map=_robot_map(path, spec.robot_map),
    )


def write_tile(
    folder: Path,
    *,
    name: str,
    crs: str,
    clouds: Sequence[str],
    cameras: dict[str, Camera],
    photos: Sequence[dict[str, Any]] = (),
    trajectory: str | None = None,
    ortho: str | None = None,
    footprints: str | None = None,
    units: str | None = None,
    cell: dict[str, Any] | None = None,
    truth: dict[str, str] | None = None,
    classes: Mapping[int, int] | None = None,
    robot_map: Mapping[str, Any] | None = None,
) -> Path:
    """Write `folder/tile.toml` and return its path.

    Args:
        folder: created if it doesn't exist; file names are relative to it.
        photos: dicts with the keys of a `[[photos]]` entry; `position` and `rotation` may be arrays.
        name, crs, clouds, cameras, trajectory, ortho, footprints, units, cell, truth, classes, robot_map: as in
            `tile.toml` (`ortho` is its `orthophoto`).
    """
    import tomli_w

    body: dict[str, Any] = {"name": name, "crs": crs, "clouds": list(clouds)}
    if units:
        body["units"] = units
    if trajectory:
        body["trajectory"] = trajectory
    if ortho:
        body["orthophoto"] = ortho
    if footprints:
        body["footprints"] = footprints
    if truth:
        body["truth"] = truth
    if cell:
        body["cell"] = cell
    if classes:
        body["classes"] = {str(code): name_of(meant) for code, meant in classes.items()}
    if robot_map:
        body["robot_map"] = dict(robot_map)
    body["cameras"] = [camera_entry(key, camera) for key, camera in cameras.items()]
    body["photos"] = [
        {k: (v.tolist() if isinstance(v, np.ndarray) else v) for k, v in photo.items() if v is not None}
        for photo in photos
    ]
    body = {key: value for key, value in body.items() if value != []}
    TileFile.model_validate(body)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "tile.toml"
    path.write_text(tomli_w.dumps(body), encoding="utf-8")
    return path


def source_files(path: Path) -> list[Path]:
    """Files of a tile without its photos: the `tile.toml`, clouds, trajectory, orthophoto, footprints.

    Raises:
        InputError: the `tile.toml` can't be read.
    """
    spec = read_spec(path)
    others = (spec.trajectory, spec.orthophoto, spec.footprints)
    return [path, *(path.parent / name for name in (*spec.clouds, *filter(None, others)))]


def tile_name(text: str) -> str:
    """Turn `text` into a valid tile name: letters, digits and underscores, at most `MAX_NAME`; "world" is reserved."""
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in text).strip("_")[:MAX_NAME] or "tile"
    return f"{name}_tile" if is_reserved(name) else name


def read_spec(path: Path) -> TileFile:
    """Content of a `tile.toml`, validated; the files that it names are not checked.

    Raises:
        InputError: it doesn't exist or is invalid.
    """
    absent = ("no tile found", "Give a tile.toml or its folder; `scan2sim import` creates one from your files")
    return toml.read(path, TileFile, absent=absent, fields="docs/reference/formats.md lists the fields of a tile")


def _existing(tile: Path, name: str, field: str) -> Path:
    path = tile.parent / name
    cause = file_checks.problem(path)
    if cause is not None:
        raise InputError(path, f"{cause} (named under `{field}` of {tile.name})", file_checks.CHECK_PATH)
    return path


def _cloud(tile: Path, name: str) -> Path:
    path = _existing(tile, name, "clouds")
    if path.name == "ept.json":  # its points are in other files, whose changes the result cache would not detect
        raise InputError(path, "is an index of many files", "Convert it to LAZ with `scan2sim import clouds`")
    return path


def camera_of(tile: Path, entry: CameraEntry) -> Camera:
    """The camera of an entry in the file `tile`.

    Raises:
        InputError: a number is out of range.
    """
    where = f"camera `{entry.id}`"
    if min(entry.size) < 1:
        raise InputError(
            tile, f"{where}: size {entry.size} is not positive", "Give the photo's width and height in pixels"
        )
    if entry.model != "equirectangular" and not (
        np.isfinite(entry.focal).all() and min(entry.focal) > 0 and max(entry.focal) <= MAX_PIXELS
    ):
        raise InputError(
            tile,
            f"{where}: focal {entry.focal} is not positive, or exceeds {MAX_PIXELS:,.0f}",
            "Give fx and fy in pixels",
        )
    if not (np.isfinite(entry.centre).all() and np.abs(entry.centre).max() <= MAX_PIXELS):
        raise InputError(tile, f"{where}: centre {entry.centre} is out of range", "Give cx and cy in pixels")
    if not (np.isfinite(entry.distortion).all() and np.abs(entry.distortion).max(initial=0) <= MAX_DISTORTION):
        raise InputError(
            tile,
            f"{where}: distortion {entry.distortion} is out of range",
            f"Give coefficients of at most {MAX_DISTORTION:,.0f}",
        )
    if len(entry.distortion) not in DISTORTION_LENGTHS[entry.model]:
        lengths = " or ".join(map(str, DISTORTION_LENGTHS[entry.model]))
        raise InputError(
            tile, f"{where}: {len(entry.distortion)} distortion coefficients", f"A {entry.model} camera takes {lengths}"
        )
    return Camera(entry.model, *entry.size, *entry.focal, *entry.centre, entry.distortion)


def camera_entry(key: str, camera: Camera) -> dict[str, Any]:
    """The table of a camera in a `tile.toml`."""
    entry: dict[str, Any] = {"id": key, "model": camera.model, "size": [camera.width, camera.height]}
    if camera.model != "equirectangular":
        entry |= {"focal": [camera.fx, camera.fy], "centre": [camera.cx, camera.cy]}
    if camera.distortion:
        entry["distortion"] = list(camera.distortion)
    return entry


def _view(tile: Path, index: int, entry: PhotoEntry, cameras: dict[str, Camera], frame: Frame) -> View:
    where = f"photo {index} ({entry.file})"
    if entry.camera not in cameras:
        raise InputError(tile, f"{where}: unknown camera `{entry.camera}`", f"Cameras are: {', '.join(cameras)}")
    rotation, position = np.array(entry.rotation), np.array(entry.position)
    if not (np.isfinite(rotation).all() and np.isfinite(position).all()):
        raise InputError(tile, f"{where}: its pose contains NaN or infinity", "Fix the pose, or remove the photo")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise InputError(
            tile,
            f"{where}: `rotation` is not a rotation matrix (rows must be orthonormal, determinant +1)",
            "Give the 3x3 camera-to-world rotation, camera axes x right, y down, z forward",
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = nearest_rotation(rotation), frame.to_local(position)
    return View(
        name=entry.name or Path(entry.file).with_suffix("").as_posix(),
        camera=cameras[entry.camera],
        T_world_cam=pose,
        photo=tile.parent / entry.file,
        mask=tile.parent / entry.mask if entry.mask else None,
        time=entry.time,
    )


def _classes(tile: Path, spec: TileFile) -> dict[int, int]:
    try:
        return mapping(spec.classes)
    except SettingError as error:
        raise InputError(tile, f"field `classes`: {error.cause}", error.remedy) from None


def _cell(entry: CellEntry | None, unit: float) -> Cell | None:
    if entry is None:
        return None

    def metres(seed: tuple[float, float]) -> tuple[float, float]:
        return seed[0] * unit, seed[1] * unit

    neighbours = {name: metres(seed) for name, seed in entry.neighbours.items()}
    return Cell(metres(entry.seed), neighbours, entry.buffer)


def _robot_map(tile: Path, entry: RobotMapEntry | None) -> RobotMap | None:
    if entry is None:
        return None
    T = np.array(entry.T_world_map)
    R = T[:3, :3]
    if not np.isfinite(T).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError(tile, "field `robot_map.T_world_map`: not a rigid transform", "Import the map again")
    source = None if entry.source_mesh is None else _existing(tile, entry.source_mesh, "robot_map.source_mesh")
    return RobotMap(entry.scene, entry.spacing, entry.unit, T, source)


def _trajectory(tile: Path, spec: TileFile, frame: Frame) -> Trajectory | None:
    if spec.trajectory is None:
        return None
    return trajectory_io.read(_existing(tile, spec.trajectory, "trajectory"), frame, ordered=False, timed=True)


MIN_POINTS = 1000
