"""Importer of point clouds (in any format of `pipeline.io.clouds`) with a CSV of posed photos, or those inside an E57.

The photos' CSV has a header line, one row per photo, columns in any order and case, separated by commas, semicolons or
tabs (`pipeline.io.tables`); columns that aren't listed here are ignored with a note. Files are found by path or, if
another computer wrote it, by the end of the path, in any case:

| columns | meaning |
| --- | --- |
| `file` | the photo, relative to the CSV's folder (or to `images`) |
| `x`, `y`, `z` | camera centre, in the CRS and units of the clouds |
| `r11` ... `r33` | rotation, camera to world, row-major; camera axes x right, y down, z forward |
| or `qw`, `qx`, `qy`, `qz` | the same rotation as a quaternion |
| or `omega`, `phi`, `kappa` | photogrammetric angles in degrees: `Rx(omega) Ry(phi) Rz(kappa)` rotates camera axes x right, y up, z back to the world |
| `time` | optional: GPS time, seconds |
| `mask` | optional: image that is 0 where the photo must not be used |
| `camera` | name of its camera; optional if the row has the camera's columns |
| `model`, `width`, `height`, `fx`, `fy`, `cx`, `cy`, `k1`, `k2`, `p1`, `p2`, `k3`, `k4`, `k5`, `k6` | the camera |

The camera's columns are either in the photos' CSV or in a second one with one row per camera and
the column `camera`. `model` is pinhole (default), opencv, fisheye or equirectangular; `fy` defaults
to `fx`, `cx` and `cy` to the middle of the photo, coefficients to 0; the centre of the top left
pixel is (0, 0). Other conventions are converted as named (`pipeline.pose_check.conventions`).
"""  # noqa: E501

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, Camera, CameraModel, Frame, PointCloud, Trajectory
from scan2sim.pipeline.importers import foreign_tables
from scan2sim.pipeline.importers.path_correction import PathCorrection, read_correction, write_corrected
from scan2sim.pipeline.importers.photo_fit import fitted_cameras
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import sbet, tables
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io import trajectory_check as check_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import area_of_use
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.geodata import orthophoto as orthophoto_io
from scan2sim.pipeline.io.images import e57 as e57_images
from scan2sim.pipeline.io.photogrammetry import Photos
from scan2sim.pipeline.io.tile import read_tile, tile_name, write_tile
from scan2sim.pipeline.io.tile_folder import add_file, names_in, tile_folder
from scan2sim.pipeline.pose_check.conventions import PhotoConventions, PosedPhotos, converted

Row = Mapping[str, str]
ALIKE = 0.8
"""Similarity of names (`difflib`) from which one is a mistake for the other."""
ALIASES = {
    "file": ("filename", "file name", "image", "photo", "label", "datei", "dateiname", "bild", "foto"),
    "x": ("easting", "east", "rechtswert", "ostwert", "x[m]", "x (m)"),
    "y": ("northing", "north", "hochwert", "nordwert", "y[m]", "y (m)"),
    "z": ("altitude", "höhe", "hoehe", "z[m]", "z (m)"),
    "camera": ("kamera",),
}
"""Column names of other programs and languages."""
FULL_CIRCLE_DEG = 360.0
MATRIX_COLUMNS = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
ANGLE_COLUMNS = ("omega", "phi", "kappa")
CAMERA_COLUMNS = ("model", "width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
PHOTO_COLUMNS = (
    "file",
    "x",
    "y",
    "z",
    *MATRIX_COLUMNS,
    *QUATERNION_COLUMNS,
    *ANGLE_COLUMNS,
    "time",
    "mask",
    "camera",
    *CAMERA_COLUMNS,
)


def import_las(
    clouds: Sequence[Path],
    out: Path,
    *,
    photos: Path | None = None,
    cameras: Path | None = None,
    images: Path | None = None,
    embedded_images: bool = True,
    crs: str | None = None,
    units: str | None = None,
    axes: str | None = None,
    trajectory: Path | None = None,
    trajectory_check: Path | None = None,
    orthophoto: Path | None = None,
    footprints: Path | None = None,
    conventions: PhotoConventions | None = None,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    classes: Mapping[int, int] | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Create a tile from clouds and, optionally, posed photos.

    Args:
        clouds: files in one CRS. LAS, LAZ and PLY files are copied unchanged; others are converted to LAZ, with
            coordinates rounded to millimetres.
        out: folder of the tile to create.
        photos: CSV of posed photos, see the module's docstring.
        cameras: CSV of cameras, if the photos' rows don't contain them.
        images: folder of the photos; default: that of the CSV.
        embedded_images: whether images with poses inside E57 files become photos of the tile.
        crs: code or WKT, "local" without georeference; takes precedence over the clouds' own, the default.
        units: "m", "ft" or "us-ft"; takes precedence over the unit of the CRS, the default.
        axes: order of the clouds' coordinates, a permutation of "enh" (easting, northing, height), the default; clouds
            in another order are converted.
        trajectory: the scanner's path: .csv (a header line, then time,x,y,z per line) or .tum.
        trajectory_check: folder of a check of the trajectory (`pipeline.io.trajectory_check`); if it has a correction,
            points, photos and trajectory are corrected.
        orthophoto: GeoTIFF, or an image with a world file, in the clouds' CRS.
        footprints: building footprints, GeoJSON or GeoPackage.
        conventions: in which the CSV gives poses and cameras; default: as documented.
        link: symlink clouds and photos instead of copying them.
        overwrite: replace an existing tile.
        name: name of the tile; default: that of its folder.
        classes: mapping of class codes of the clouds to those of `pipeline.core.classes`, where they differ.
        warn: receives assumptions made about the clouds, and images of E57 files that are left out.
        report: receives progress.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file is missing or wrong, there is no CRS, or the coordinates contradict it.
        SettingError: `out` is not empty, or `axes` can't be used. UnavailableError: a format's library isn't installed.
    """
    order = axes_order(axes)
    if axes is not None and trajectory_check is not None:
        raise SettingError("axes", "a trajectory can't be checked against clouds with other axes", "Convert them first")
    headers = [cloud_io.read_header(Path(cloud)) for cloud in clouds]
    known, unit = _common_crs(clouds, headers, crs, units, axes, warn)
    for cloud, header in zip(clouds, headers, strict=True):
        for note in (*header.notes, *cloud_io.flag_notes(Path(cloud))):
            warn(f"{cloud}: {note}")
    shots, rigs = read_photos(photos, cameras, warn) if photos else ([], {})
    if shots and conventions is not None:
        shots, rigs = _converted(shots, rigs, conventions, Frame(known, unit=unit), warn)
    base = images or (photos.parent if photos else Path())
    path, correction = _corrected_path(trajectory, trajectory_check, Frame(known, unit=unit))
    with tile_folder(out, overwrite) as folder:
        cloud_names = []
        for i, cloud in enumerate(clouds):
            report(0.5 * i / len(clouds), f"cloud {Path(cloud).name}")
            cloud_names.append(_add_cloud(Path(cloud), folder, Frame(known, unit=unit), order, link, correction))
        files = _files(shots, base)
        sources = [source for photo in files for source, _, key in photo if key == "file"]
        names, rigs = fitted_cameras(sources, [shot["camera"] for shot in shots], rigs, warn)
        shots = [shot | {"camera": name} for shot, name in zip(shots, names, strict=True)]
        for i, shot in enumerate(shots):
            report(0.5 + 0.5 * i / len(shots), f"photo {shot['file']}")
            for source, stored, key in files[i]:
                shot[key] = add_file(source, folder, stored, link)
        if embedded_images and order == axes_order(None):
            embedded, lenses = e57_images.extract_all(map(Path, clouds), folder, warn, report)
            shots, rigs = shots + embedded, rigs | lenses
        elif embedded_images and any(Path(cloud).suffix.lower() == ".e57" for cloud in clouds):
            warn("images inside E57 files aren't used with other axes: their poses have those of the file")
        if correction is not None:
            shots = _corrected_photos(shots, correction, unit, warn)
        write_tile(
            folder,
            name=tile_name(name or Path(out).name),
            crs=crs_io.short(known),
            clouds=cloud_names,
            cameras=rigs,
            photos=shots,
            trajectory=_add_trajectory(trajectory, path, folder, Frame(known, unit=unit), link) if trajectory else None,
            ortho=orthophoto_io.copy_to_tile(orthophoto, folder, link) if orthophoto else None,
            footprints=add_file(footprints, folder, footprints.name, link) if footprints else None,
            units=units,
            classes=classes,
        )
        if trajectory_check is not None:
            check_io.copy(trajectory_check, folder)
        read_tile(folder)  # an invalid tile is an error here, before its folder appears
    report(1.0, "done")
    return Path(out) / "tile.toml"


def common_crs(clouds: Sequence[Path], crs: str | None, units: str | None) -> tuple[str, float]:
    """CRS of clouds and metres per unit; arguments and errors as `import_las`."""
    headers = [cloud_io.read_header(Path(cloud)) for cloud in clouds]
    return _common_crs(clouds, headers, crs, units, None, lambda _: None)


def axes_order(axes: str | None) -> tuple[int, int, int]:
    """Columns of easting, northing and height in coordinates whose order is `axes`, such as "neh"; default: "enh".

    Raises:
        SettingError: it isn't an order of these three.
    """
    text = (axes or "enh").lower()
    if sorted(text) != sorted("enh"):
        remedy = "Give the letters e (easting), n (northing) and h (height) in the order of the columns: neh"
        raise SettingError("axes", f"{text[:20]!r} is no order of axes", remedy)
    return text.index("e"), text.index("n"), text.index("h")


def _common_crs(
    clouds: Sequence[Path],
    headers: Sequence[cloud_io.Header],
    crs: str | None,
    units: str | None,
    axes: str | None,
    warn: Callable[[str], None],
) -> tuple[str, float]:
    """CRS and metres per unit; coordinates that don't fit them are an error, or a warning if unit or axes are given."""
    order = list(axes_order(axes))
    for cloud, header in zip(clouds, headers, strict=True):
        named = crs or header.crs
        if named is None:
            cause = next((note for note in header.notes if note.startswith(cloud_io.UNREADABLE_CRS)), "has no CRS")
            remedy = "Give it, for example --crs EPSG:32633, or --crs local without georeference"
            raise InputError(cloud, cause, remedy)
        named = named if named == crs_io.LOCAL or units is None else crs_io.with_units(named, units)
        wrong = area_of_use.misfit(named, header.low[order], header.high[order])
        if wrong is not None and wrong.severe and axes is None and units is None:
            raise InputError(cloud, wrong.cause, wrong.remedy)
        if wrong is not None:
            warn(f"{cloud}: {wrong}")
    return crs_io.common(Path(clouds[0]), crs, units, clouds, headers, warn)


def _converted(
    shots: list[dict[str, Any]],
    rigs: dict[str, Camera],
    conventions: PhotoConventions,
    frame: Frame,
    warn: Callable[[str], None],
) -> tuple[list[dict[str, Any]], dict[str, Camera]]:
    """Photos and cameras by name in the conventions of a tile; photos without a pose are left out."""
    T = np.tile(np.eye(4), (len(shots), 1, 1))
    T[:, :3, :3] = [shot["rotation"] for shot in shots]
    T[:, :3, 3] = np.array([shot["position"] for shot in shots]) * frame.unit
    given = PosedPhotos(T, tuple(rigs[shot["camera"]] for shot in shots), frame)
    photos, known = converted(given, conventions)
    if not known.all():
        warn(f"{int((~known).sum())} photos are left out: there is no row with their pose (--pose-shift)")
    moved = [
        shot | {"position": pose[:3, 3] / frame.unit, "rotation": pose[:3, :3]}
        for shot, pose, found in zip(shots, photos.T, known, strict=True)
        if found
    ]
    return moved, {shot["camera"]: camera for shot, camera in zip(shots, photos.cameras, strict=True)}


def _corrected_path(
    trajectory: Path | None, check: Path | None, frame: Frame
) -> tuple[Trajectory | None, PathCorrection | None]:
    """The trajectory (metres), if it differs from its file: in the clouds' clock, corrected; and its correction."""
    if trajectory is None or (check is None and not sbet.is_sbet(trajectory)):
        return None, None
    found = (None if check is None else check_io.read(check)) or {}
    offset = float(found.get("clock_offset_s", 0.0))
    path = trajectory_io.read(trajectory, frame, ordered=False, timed=True)
    path = replace(path, times=path.times + offset)
    correction = None if check is None else read_correction(check, path)
    if correction is not None:
        return correction.trajectory(), correction
    return (path if offset or sbet.is_sbet(trajectory) else None), None


def _add_trajectory(trajectory: Path, path: Trajectory | None, folder: Path, frame: Frame, link: bool) -> str:
    """Copy or link a trajectory into the tile's folder, or write `path` instead; returns its name there."""
    if path is None:
        return add_file(trajectory, folder, "trajectory.tum" if trajectory.suffix == ".tum" else "trajectory.csv", link)
    trajectory_io.write(folder / "trajectory.csv", path, frame)
    return "trajectory.csv"


def _corrected_photos(
    shots: list[dict[str, Any]], correction: PathCorrection, unit: float, warn: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Photos with the poses of the corrected path: at their times or, without any, where the path is nearest."""
    if not shots:
        return shots
    T = np.tile(np.eye(4), (len(shots), 1, 1))
    T[:, :3, :3] = [shot["rotation"] for shot in shots]
    T[:, :3, 3] = np.array([shot["position"] for shot in shots]) * unit
    times = np.array([np.nan if shot.get("time") is None else shot["time"] for shot in shots], np.float64)
    timed = correction.covers(times)
    times[~timed] = correction.nearest_times(T[~timed, :3, 3])
    if not timed.all():
        warn(
            f"{int((~timed).sum())} photos have no time within the trajectory's: their poses are corrected as the "
            "nearest position of the trajectory"
        )
    return [
        shot | {"position": pose[:3, 3] / unit, "rotation": pose[:3, :3]}
        for shot, pose in zip(shots, correction.poses(T, times), strict=True)
    ]


def _add_cloud(
    cloud: Path,
    folder: Path,
    frame: Frame,
    order: tuple[int, int, int],
    link: bool,
    correction: PathCorrection | None,
) -> str:
    """Copy, link, correct or convert (to LAZ) a cloud into the tile's folder; returns its name there."""
    if correction is not None:
        name = cloud.name if cloud.suffix.lower() in las.SUFFIXES else f"{cloud.stem}.laz"
        name = name.replace(".copc.", ".")
        if (folder / name).exists():
            raise InputError(cloud, f"is the second cloud with the name {name} in the tile", "Rename one of them")
        write_corrected(cloud, folder / name, correction, frame)
        return name
    if cloud.suffix.lower() in cloud_io.COPIED_SUFFIXES and order == axes_order(None):
        return add_file(cloud, folder, cloud.name, link)
    name = f"{cloud.resolve().parent.name if cloud.name == 'ept.json' else cloud.stem}.laz"
    if (folder / name).exists():
        raise InputError(cloud, f"is the second cloud with the name {name} in the tile", "Rename one of them")
    parts = (_reordered(part, order) for part in cloud_io.chunks(cloud, frame))
    las.write_parts(folder / name, parts, software="")  # class codes stay those of the survey
    return name


def _reordered(cloud: PointCloud, order: tuple[int, int, int]) -> PointCloud:
    """The cloud with the coordinates at the columns `order` as easting, northing and height."""
    x, y, z = (cloud.frame.origin[column] for column in order)
    return replace(cloud, frame=replace(cloud.frame, origin=(x, y, z)), xyz=cloud.xyz[:, list(order)], normal=None)


def _files(shots: Sequence[Mapping[str, Any]], base: Path) -> list[list[tuple[Path, str, str]]]:
    """Files of each photo: where it is, its name in the tile, and its key in the photo's entry.

    Raises:
        InputError: one isn't there.
    """
    found: list[list[tuple[Path, str, str]]] = [[] for _ in shots]
    files = Photos(base)
    for key, subfolder in (("file", "photos"), ("mask", "masks")):
        given = [(i, str(shot[key])) for i, shot in enumerate(shots) if shot.get(key)]
        sources = [base / name if (base / name).is_file() else files.find(name) for _, name in given]
        for (i, _), source, name in zip(given, sources, names_in(subfolder, sources, base), strict=True):
            found[i].append((source, name, key))
    return found


def read_photos(
    photos: Path, cameras: Path | None = None, warn: Callable[[str], None] = lambda _: None
) -> tuple[list[dict[str, Any]], dict[str, Camera]]:
    """Photos (entries of `pipeline.io.tile.write_tile`, file names as in the CSV) and their cameras by name.

    Args:
        photos, cameras: tables, see the module's docstring.
        warn: receives the names of columns that are ignored.

    Raises:
        InputError: names the CSV, the row and the column.
    """
    foreign_tables.check(photos)
    given = {}
    if cameras:
        given = {row["camera"]: row for _, row in _rows(cameras, ("camera", *CAMERA_COLUMNS), ("camera",), warn)}
    rigs: dict[str, Camera] = {}
    shots: list[dict[str, Any]] = []
    for i, row in _rows(photos, PHOTO_COLUMNS, ("file", "x", "y", "z"), warn):
        key = row.get("camera", "")
        if cameras is not None and key not in given:
            raise InputError(
                photos, f"row {i}: camera `{key}` is not in {cameras.name}", f"Cameras are: {', '.join(given)}"
            )
        source = (cameras or photos, f"camera `{key}`" if cameras else f"row {i}")
        camera = _camera(given.get(key) or row, *source)
        key = key or next((k for k, c in rigs.items() if c == camera), f"camera_{len(rigs) + 1}")
        if rigs.setdefault(key, camera) != camera:
            raise InputError(
                photos, f"row {i}: camera `{key}` differs from that of an earlier row", "Rename one of them"
            )
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


def _rows(
    path: Path, known: Sequence[str], needed: Sequence[str], warn: Callable[[str], None]
) -> list[tuple[int, Row]]:
    """Line numbers and rows of a table, with decimal points."""
    table = tables.read(path, ALIASES)
    table.require(needed)
    for name in set(table.columns) - set(known):
        if alike := difflib.get_close_matches(name, known, 1, ALIKE):
            remedy = f"Name it `{alike[0]}`; if it is something else, give it a different name"
            raise InputError(path, f"has an unknown column `{name}`", remedy)
    if ignored := [name for name in table.columns if name not in known]:
        warn(f"{path}: columns that aren't known are ignored: {', '.join(ignored)}; known are {', '.join(known)}")
    if not table.decimal_comma:
        return list(table.rows)
    texts = ("file", "mask", "camera", "model")
    return [
        (number, {name: cell if name in texts else cell.replace(",", ".") for name, cell in row.items()})
        for number, row in table.rows
    ]


def _number(row: Row, column: str, path: Path, where: str, default: float | None = None) -> float:
    text = row.get(column, "")
    if not text and default is not None:
        return default
    try:
        return float(text)
    except ValueError:
        raise InputError(path, f"{where}: `{column}` is {text!r}, not a number", "Fix that cell") from None


def _camera(row: Row, path: Path, where: str) -> Camera:
    model: Any = row.get("model") or "pinhole"
    if model not in get_args(CameraModel):
        raise InputError(path, f"{where}: unknown model `{model}`", f"Use {', '.join(get_args(CameraModel))}")
    sides = [_number(row, key, path, where) for key in ("width", "height")]
    if not all(1 <= side < 1e6 for side in sides):
        cause = f"{where}: invalid photo size {sides[0]:g} x {sides[1]:g}"
        raise InputError(path, cause, "Give width and height in pixels")
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
    unused = [k for k in CAMERA_COLUMNS[7:] if k not in names and row.get(k) and _number(row, k, path, where) != 0]
    if unused:
        raise InputError(path, f"{where}: a {model} camera has no `{unused[0]}`", "Fix `model`, or clear that cell")
    values = [_number(row, k, path, where, 0.0) for k in names]
    if model == "opencv":
        values = values[:4] if not any(values[4:]) else values[:5] if not any(values[5:]) else values
    return Camera(model, width, height, fx, fy, cx, cy, tuple(values))


def _rotation(row: Row, path: Path, where: str) -> F64:
    """Rotation (3, 3) camera to world, camera axes x right, y down, z forward."""
    from scipy.spatial.transform import Rotation

    forms = [form for form in (MATRIX_COLUMNS, QUATERNION_COLUMNS, ANGLE_COLUMNS) if all(row.get(key) for key in form)]
    if len(forms) != 1:
        cause = "no rotation" if not forms else "more than one rotation"
        raise InputError(path, f"{where}: {cause}", "Give r11...r33, or qw,qx,qy,qz, or omega,phi,kappa")
    values = np.array([_number(row, key, path, where) for key in forms[0]])
    if not np.isfinite(values).all():
        cause = f"{where}: the rotation contains NaN or infinity"
        raise InputError(path, cause, "Fix the pose, or remove the photo")
    if forms[0] is MATRIX_COLUMNS:
        matrix = values.reshape(3, 3)
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
            raise InputError(
                path,
                f"{where}: r11...r33 is not a rotation matrix",
                "Give an orthonormal matrix of determinant +1, camera to world",
            )
        return matrix
    if forms[0] is QUATERNION_COLUMNS:
        if abs(np.linalg.norm(values) - 1) > 1e-3:
            raise InputError(path, f"{where}: the quaternion is not normalized", "Give a unit quaternion, qw first")
        return Rotation.from_quat(np.roll(values, -1)).as_matrix()
    if np.abs(values).max() > FULL_CIRCLE_DEG:
        cause = f"{where}: an angle of {np.abs(values).max():g} is more than a full circle in degrees"
        raise InputError(path, cause, "Convert omega, phi and kappa to degrees; gon (BINGO): times 0.9")
    return Rotation.from_euler("XYZ", values, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
