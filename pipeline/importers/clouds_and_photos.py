"""Plain clouds (of any format of `pipeline.io.clouds`) with a CSV of posed photos as a tile.

The photos' CSV has a heading, one row a photo, columns in any order, commas between them:

| columns | meaning |
| --- | --- |
| `file` | the photo, relative to the CSV's folder (or to `images`) |
| `x`, `y`, `z` | camera centre, in the CRS and units of the clouds |
| `r11` ... `r33` | rotation, camera to world, row by row; camera axes x right, y down, z forward |
| or `qw`, `qx`, `qy`, `qz` | the same rotation as a quaternion |
| or `omega`, `phi`, `kappa` | degrees, photogrammetric: `Rx(omega) Ry(phi) Rz(kappa)` turns camera axes x right, y up, z back to the world |
| `time` | optional: GPS time, seconds |
| `mask` | optional: image that is 0 where the photo must not be used |
| `camera` | name of its camera; may be left out where the rows say all of it |
| `model`, `width`, `height`, `fx`, `fy`, `cx`, `cy`, `k1`, `k2`, `p1`, `p2`, `k3`, `k4`, `k5`, `k6` | the camera |

The camera's columns are either in the photos' CSV or in a second one with a row a camera and the
column `camera`. `model` is pinhole (default), opencv, fisheye or equirectangular; `fy` defaults to
`fx`, `cx` and `cy` to the middle of the photo, coefficients to 0; the centre of the top left pixel
is (0, 0).
"""  # noqa: E501

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, Camera, CameraModel, Frame
from scan2sim.pipeline.importers.tile_folder import place, tile_folder, without_parents
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.geodata import orthophoto as orthophoto_io
from scan2sim.pipeline.io.tile import read_tile, tile_name, write_tile

Row = Mapping[str, str]
MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("omega", "phi", "kappa")
CAMERA = ("model", "width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
PHOTO = ("file", "x", "y", "z", *MATRIX, *QUATERNION, *ANGLES, "time", "mask", "camera", *CAMERA)


def import_las(
    clouds: Sequence[Path],
    out: Path,
    *,
    photos: Path | None = None,
    cameras: Path | None = None,
    images: Path | None = None,
    crs: str | None = None,
    units: str | None = None,
    trajectory: Path | None = None,
    orthophoto: Path | None = None,
    footprints: Path | None = None,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    classes: Mapping[int, int] | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Make a tile of clouds and, optionally, posed photos.

    Args:
        clouds: files in one CRS. LAS, LAZ and PLY files are taken as they are; of others, a LAZ file is made, whose
            coordinates are whole millimetres.
        out: the tile's folder to make.
        photos: CSV of posed photos, as above.
        cameras: CSV of cameras, where the photos' rows don't hold them.
        images: folder of the photos; the CSV's by default.
        crs: code or WKT, "local" without georeference; the clouds' own by default.
        units: "m", "ft" or "us-ft", where the CRS doesn't say it.
        trajectory: CSV of the scanner's path: a heading, then time,x,y,z a line.
        orthophoto: GeoTIFF, or a picture with a world file, in the clouds' CRS.
        footprints: where buildings stand, GeoJSON or GeoPackage.
        link: link to clouds and photos instead of copying them.
        classes: codes of the clouds and what they are here, where they differ (`pipeline.core.classes`).
        warn: receives what was assumed of clouds that don't say it.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file is missing or wrong, or there is no CRS. SettingError: `out` is not empty.
        UnavailableError: a format's library isn't installed.
    """
    headers = [cloud_io.read_header(Path(cloud)) for cloud in clouds]
    if crs is None and any(h.crs is None for h in headers):
        bare = next(cloud for cloud, h in zip(clouds, headers, strict=True) if h.crs is None)
        raise InputError(bare, "has no CRS", "Name it: --crs EPSG:32633, say, or --crs local for no georeference")
    known, unit = crs_io.common(Path("tile.toml"), crs, units, clouds, headers)
    for cloud, header in zip(clouds, headers, strict=True):
        for note in header.notes:
            warn(f"{cloud}: {note}")
    shots, rigs = read_photos(photos, cameras) if photos else ([], {})
    base = images or (photos.parent if photos else Path())
    with tile_folder(out, overwrite) as folder:
        taken = []
        for i, cloud in enumerate(clouds):
            report(0.5 * i / len(clouds), f"cloud {Path(cloud).name}")
            taken.append(_take(Path(cloud), folder, Frame(known, unit=unit), link))
        for i, shot in enumerate(shots):
            report(0.5 + 0.5 * i / len(shots), f"photo {shot['file']}")
            for key, where in (("file", "photos"), ("mask", "masks")):
                if shot.get(key):
                    shot[key] = place(base / shot[key], folder, f"{where}/{without_parents(shot[key])}", link)
        write_tile(
            folder,
            name=tile_name(name or Path(out).name),
            crs=crs_io.short(known),
            clouds=taken,
            cameras=rigs,
            photos=shots,
            trajectory=place(trajectory, folder, "trajectory.csv", link) if trajectory else None,
            ortho=orthophoto_io.take(orthophoto, folder, link) if orthophoto else None,
            footprints=place(footprints, folder, footprints.name, link) if footprints else None,
            units=units,
            classes=classes,
        )
        read_tile(folder)  # what it refuses is refused here, before the tile appears
    report(1.0, "done")
    return Path(out) / "tile.toml"


def _take(cloud: Path, folder: Path, frame: Frame, link: bool) -> str:
    """The name in the tile of a cloud that was copied or linked there, or written anew as LAZ."""
    if cloud.suffix.lower() in cloud_io.AS_THEY_ARE:
        return place(cloud, folder, cloud.name, link)
    name = f"{cloud.resolve().parent.name if cloud.name == 'ept.json' else cloud.stem}.laz"
    if (folder / name).exists():
        raise InputError(cloud, f"is the second cloud to be called {name} in the tile", "Rename one of them")
    las.write_parts(folder / name, cloud_io.chunks(cloud, frame), software="")  # its classes are the survey's still
    return name


def read_photos(photos: Path, cameras: Path | None = None) -> tuple[list[dict[str, Any]], dict[str, Camera]]:
    """Photos (entries of `pipeline.io.tile.write_tile`, file names as in the CSV) and their cameras by name.

    Raises:
        InputError: naming the CSV, the row and the column.
    """
    given = {row["camera"]: row for row in _rows(cameras, ("camera", *CAMERA), ("camera",))} if cameras else {}
    rigs: dict[str, Camera] = {}
    shots: list[dict[str, Any]] = []
    for i, row in enumerate(_rows(photos, PHOTO, ("file", "x", "y", "z")), start=2):
        key = row.get("camera", "")
        if cameras is not None and key not in given:
            raise InputError(
                photos, f"row {i}: camera `{key}` is not in {cameras.name}", f"Cameras are: {', '.join(given)}"
            )
        source = (cameras or photos, f"camera `{key}`" if cameras else f"row {i}")
        camera = _camera(given.get(key) or row, *source)
        key = key or next((k for k, c in rigs.items() if c == camera), f"camera_{len(rigs) + 1}")
        if rigs.setdefault(key, camera) != camera:
            raise InputError(photos, f"row {i}: camera `{key}` differs from an earlier row's", "Give it another name")
        where = (photos, f"row {i}")
        shots.append(
            {
                "file": row["file"],
                "camera": key,
                "position": np.array([_number(row, axis, *where) for axis in "xyz"]),
                "rotation": _rotation(row, *where),
                "time": _number(row, "time", *where) if row.get("time") else None,
                "mask": row.get("mask") or None,
            }
        )
    return shots, rigs


def _rows(path: Path, known: Sequence[str], needed: Sequence[str]) -> list[Row]:
    file_checks.check(path)
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True, restval="")
            names = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = names
            rows: list[Row] = [{k: v.strip() for k, v in row.items() if isinstance(v, str)} for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"is no CSV ({error})", "Export it again, as UTF-8 with commas") from None
    for name in needed:
        if name not in names:
            raise InputError(path, f"has no column `{name}` (it has {', '.join(names)})", "Add it to the heading")
    for name in names:
        if name not in known:
            raise InputError(path, f"has an unknown column `{name}`", f"Known ones are {', '.join(known)}")
    if not rows:
        raise InputError(path, "has no rows", "Add them, or leave the file out")
    return rows


def _number(row: Row, column: str, path: Path, where: str, default: float | None = None) -> float:
    text = row.get(column, "")
    if not text and default is not None:
        return default
    try:
        return float(text)
    except ValueError:
        raise InputError(path, f"{where}: `{column}` is {text!r}, not a number", "Mend that cell") from None


def _camera(row: Row, path: Path, where: str) -> Camera:
    model: Any = row.get("model") or "pinhole"
    if model not in get_args(CameraModel):
        raise InputError(path, f"{where}: unknown model `{model}`", f"Use {', '.join(get_args(CameraModel))}")
    sides = [_number(row, key, path, where) for key in ("width", "height")]
    if not all(1 <= side < 1e6 for side in sides):
        raise InputError(path, f"{where}: {sides[0]:g} x {sides[1]:g} is no size of a photo", "Give it in pixels")
    width, height = map(round, sides)
    if model == "equirectangular":
        return Camera(model, width, height)
    fx = _number(row, "fx", path, where)
    fy = _number(row, "fy", path, where, fx)
    cx = _number(row, "cx", path, where, (width - 1) / 2)
    cy = _number(row, "cy", path, where, (height - 1) / 2)
    names: tuple[str, ...] = {
        "pinhole": (),
        "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
        "fisheye": ("k1", "k2", "k3", "k4"),
        "orthographic": (),
    }[model]
    unused = [k for k in CAMERA[7:] if k not in names and row.get(k) and _number(row, k, path, where) != 0]
    if unused:
        raise InputError(path, f"{where}: a {model} camera has no `{unused[0]}`", "Mend `model`, or empty that cell")
    values = [_number(row, k, path, where, 0.0) for k in names]
    if model == "opencv":
        values = values[:4] if not any(values[4:]) else values[:5] if not any(values[5:]) else values
    return Camera(model, width, height, fx, fy, cx, cy, tuple(values))


def _rotation(row: Row, path: Path, where: str) -> F64:
    """(3, 3) camera to world, camera axes x right, y down, z forward."""
    from scipy.spatial.transform import Rotation

    forms = [form for form in (MATRIX, QUATERNION, ANGLES) if all(row.get(key) for key in form)]
    if len(forms) != 1:
        cause = "no rotation" if not forms else "more than one rotation"
        raise InputError(path, f"{where}: {cause}", "Give r11...r33, or qw,qx,qy,qz, or omega,phi,kappa")
    values = np.array([_number(row, key, path, where) for key in forms[0]])
    if not np.isfinite(values).all():
        raise InputError(path, f"{where}: the rotation holds NaN or infinity", "Mend the pose, or leave the photo out")
    if forms[0] is MATRIX:
        matrix = values.reshape(3, 3)
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
            raise InputError(
                path,
                f"{where}: r11...r33 is no rotation",
                "Give an orthonormal matrix of determinant +1, camera to world",
            )
        return matrix
    if forms[0] is QUATERNION:
        if abs(np.linalg.norm(values) - 1) > 1e-3:
            raise InputError(path, f"{where}: the quaternion's length is not 1", "Give it normalised, qw first")
        return Rotation.from_quat(np.roll(values, -1)).as_matrix()
    return Rotation.from_euler("XYZ", values, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
