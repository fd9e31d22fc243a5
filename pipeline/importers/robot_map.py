"""Importer of a robot's map: a cloud (or several) in the axes of the sensor at its start, with photos if it is an E57.

The map becomes level, z up and in metres (`pipeline.geometry.upright`); outliers and reflections below the floor are
removed. A map that is level already keeps its coordinates. `tile.toml` gets the table `[robot_map]` with the transform
from the map to the world, so that poses in the map's frame stay valid.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.step import Params, Report, silent
from scan2sim.pipeline.core.types import F32, F64, Bools, Camera, Frame, PointCloud, Trajectory
from scan2sim.pipeline.geometry.height_map import exact_point_spacing
from scan2sim.pipeline.geometry.upright import Upright, find_up, rotation_to_z
from scan2sim.pipeline.importers import large_maps
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images import e57
from scan2sim.pipeline.io.tile import MIN_POINTS, read_tile, tile_name, write_tile
from scan2sim.pipeline.io.tile_folder import tile_folder
from scan2sim.pipeline.robot_maps.describe import describe, guess_unit
from scan2sim.pipeline.robot_maps.label_colours import (
    are_labels,
    classes_of_colours,
    matching_legend,
    parse_legend,
)
from scan2sim.pipeline.robot_maps.outliers import below_floor, far_outliers

VERSION = 8
"""Version of the importer: raised when the same input and options give another tile."""
UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
MIN_TILT_DEG = 0.5
"""A map that is tilted less is level: its coordinates are kept."""
MAX_SLOPE_DEG = 8.0
"""Without walls, a ground that is tilted less may be a sloping road: coordinates are kept."""
MIN_WIDTH_M = 0.1
"""Standard deviation of the points along their second axis below which they are no surface."""
USUAL_HEIGHT_M = 100.0
"""Height of a map or mesh above which its assumed unit is doubted: centimetres look like that."""
FAR_ORIGIN_M = 10_000.0
"""Coordinates above this need an origin of their own to fit into float32."""
SURVEYED = "the coordinates are those of a survey, more than 10 km from their origin"
AXES: dict[str, tuple[int, int, int]] = {
    "x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1), "-z": (0, 0, -1),
}  # fmt: skip


class MapParams(Params):
    """How a robot's map is read."""

    up: Literal["auto", "z", "-z", "y", "-y", "x", "-x"] = Field(
        "auto",
        description="Axis of the map that points up, corrected by the tilt of its floor and walls; auto: find it. "
        "LOAM, LeGO-LOAM: y; cameras (x right, y down): -y.",
    )
    units: Literal["auto", "m", "cm", "mm", "ft"] = Field(
        "auto",
        description="Unit of the map's coordinates; auto: metres, or millimetres if the points are so far apart.",
    )
    scene: Literal["auto", "indoor", "outdoor"] = Field(
        "auto", description="indoor: floor, walls, ceiling and furniture; outdoor: ground, buildings and vegetation."
    )
    images: bool = Field(True, description="Whether the posed images inside E57 files become photos.")
    classes_from_colours: str = Field(
        "",
        description="The map's colours are semantic labels: use them as classes. A legend: semantickitti, or a file "
        "with lines r,g,b=class.",
    )


def map_files(path: Path) -> list[Path]:
    """Cloud files of a map: the file itself, or those in a folder.

    Raises:
        InputError: the folder contains no cloud.
    """
    if not path.is_dir():
        return [path]
    found = [file for file in file_checks.files(path) if cloud_io.is_cloud(file)]
    if not found:
        raise InputError(path, "contains neither a tile.toml nor point clouds", f"Use {cloud_io.SUPPORTED_FORMATS}")
    return found


def import_map(
    clouds: Sequence[Path],
    out: Path,
    params: MapParams,
    *,
    trajectory: Path | None = None,
    name: str | None = None,
    overwrite: bool = False,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Create a tile from a robot's map.

    Args:
        clouds: files in one frame; of a map with a CRS the axes are not changed.
        out: folder of the tile to create.
        params: settings.
        trajectory: path of the sensor in the map's frame and unit (.csv or .tum, with times), or None.
        name: name of the tile; default: that of its folder.
        overwrite: replace an existing tile.
        warn: receives what was assumed, found and removed.
        report: receives progress.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file is missing or damaged. SettingError: `out` is not empty.
        DataError: fewer than 1000 points, or all of them on a line.
    """
    report(0.0, "reading")
    cloud, crs = _read(clouds, warn, report)
    spacing = exact_point_spacing(cloud.xyz)
    unit = 1.0 if crs else unit_of(cloud.xyz, spacing, params, warn)
    origin = np.asarray(cloud.frame.origin) * unit
    x, y, z = origin.tolist()
    cloud = replace(cloud, xyz=cloud.xyz * np.float32(unit), frame=replace(cloud.frame, origin=(x, y, z)))
    cloud = _with_classes(cloud, params, warn)
    report(0.2, "outliers")
    cloud = _without(cloud, far_outliers(cloud.xyz, unit * spacing), "isolated or far points", warn)
    if np.sqrt(max(0.0, float(np.linalg.eigvalsh(np.cov(cloud.xyz.T))[1]))) < MIN_WIDTH_M:
        raise DataError(clouds[0], "its points lie on a line", "A map needs surfaces: check the file, and --units")
    report(0.5, "up axis")
    R = np.eye(3) if crs else level_rotation(cloud.xyz, params, origin, warn)
    T_world_map = np.eye(4)
    T_world_map[:3, :3] = R
    if not np.array_equal(R, np.eye(3)):
        cloud = replace(cloud, xyz=(cloud.xyz @ R.T.astype(np.float32)), normal=None)
        cloud = replace(cloud, frame=Frame(origin=tuple((R @ origin).tolist())))
    if crs is None and params.units == "auto":
        check_height(cloud.xyz, warn)
    report(0.7, "description")
    found = describe(cloud.xyz, -np.asarray(cloud.frame.origin))
    scene = found.scene if params.scene == "auto" else params.scene
    if scene == "indoor":
        cloud = _without(cloud, below_floor(cloud.xyz), "points below the floor (reflections)", warn)
    if params.scene == "auto":
        warn(f"the map is assumed to be {scene} (--scene)")
    report(0.9, "writing")
    about = {"scene": scene, "spacing": round(found.spacing, 4), "unit": unit}
    with tile_folder(out, overwrite) as folder:
        photos, cameras = e57.extract_all(clouds if params.images else (), folder, warn)
        for photo in photos:
            photo["position"] = R @ photo["position"] * unit
            photo["rotation"] = R @ photo["rotation"]
        write_map(folder, name or Path(out).name, cloud, crs, about, T_world_map, trajectory, cameras, photos)
    report(1.0, "done")
    return Path(out) / "tile.toml"


def write_map(
    folder: Path,
    name: str,
    cloud: PointCloud,
    crs: str | None,
    about: dict[str, Any],
    T_world_map: F64,
    trajectory: Path | None,
    cameras: Mapping[str, Camera] | None = None,
    photos: Sequence[dict[str, Any]] = (),
) -> None:
    """Write the tile of a levelled map into `folder`, and check it.

    Args:
        folder: of the tile.
        name: of the tile.
        cloud: level, in metres.
        crs: of the cloud, or None.
        about: entries of `[robot_map]` other than `T_world_map`.
        T_world_map: the map's frame to the world.
        trajectory: file in the map's frame and unit, or None.
        cameras, photos: of the world, as `pipeline.io.tile.write_tile` takes them.
    """
    las.write(folder / "cloud.laz", replace(cloud, normal=None))
    if trajectory is not None:
        _add_trajectory(trajectory, folder / "trajectory.csv", T_world_map, about["unit"])
    write_tile(
        folder,
        name=tile_name(name),
        crs=crs_io.short(crs) if crs else "local",
        clouds=["cloud.laz"],
        cameras=dict(cameras or {}),
        photos=photos,
        trajectory="trajectory.csv" if trajectory is not None else None,
        robot_map={**about, "T_world_map": T_world_map.round(9).tolist()},
    )
    read_tile(folder)  # an invalid tile is an error here, before its folder appears


def unit_of(xyz: F32, spacing: float, params: MapParams, warn: Callable[[str], None]) -> float:
    """Metres per unit of a map's points (N, 3) with a spacing in this unit; reports it unless it is 1."""
    name = guess_unit(xyz, spacing) if params.units == "auto" else params.units
    if name != "m":
        warn(f"coordinates are in {name}: converted to metres (--units)")
    return UNIT_M[name]


def check_height(xyz: F32, warn: Callable[[str], None]) -> None:
    """Warn if levelled points (N, 3), in metres by assumption, are so high that they may be in a smaller unit."""
    height = float(np.ptp(np.percentile(xyz[:, 2], (1, 99))))
    if height > USUAL_HEIGHT_M:
        warn(f"it is {height:,.0f} m high: if it isn't, name the unit of its coordinates (--units cm, for example)")


def _read(clouds: Sequence[Path], warn: Callable[[str], None], report: Report) -> tuple[PointCloud, str | None]:
    """The points with finite coordinates, once each, in the unit of the map (with a CRS in metres); and the CRS."""
    headers = [cloud_io.read_header(path) for path in clouds]
    for path, header in zip(clouds, headers, strict=True):
        for note in (*header.notes, *cloud_io.flag_notes(path)):
            warn(f"{path.name}: {note}")
    ends = np.array([(header.low, header.high) for header in headers])
    ends = np.where(np.isfinite(ends), ends, 0.0)
    middle = (ends.min(axis=(0, 1)) + ends.max(axis=(0, 1))) / 2
    if np.ptp(ends, axis=(0, 1)).max() > FAR_ORIGIN_M:  # a stray point would make it the map of a survey
        middle = np.median(cloud_io.read(clouds[0], Frame()).xyz, axis=0).astype(np.float64)
    far = np.abs(middle).max() > FAR_ORIGIN_M
    x, y, z = (np.floor(middle) if far else np.zeros(3)).tolist()
    crs: str | None = None
    unit = 1.0
    if any(header.crs for header in headers):
        crs, unit = crs_io.common(clouds[0], None, None, clouds, headers)
    frame = Frame(crs or "local", (x * unit, y * unit, z * unit), unit)
    count = sum(header.count for header in headers)
    if count > large_maps.MAX_POINTS:
        cloud, side = large_maps.read_thinned(clouds, frame, count, report)
        if side:
            warn(f"{count:,} points were thinned to {len(cloud):,}: one per cube of {side:.2g} (unit of the map)")
    else:
        cloud = PointCloud.join([cloud_io.read(path, frame) for path in clouds])
    finite = np.asarray(np.isfinite(cloud.xyz).all(axis=1))
    cloud = _without(cloud, ~finite, "points with NaN coordinates", warn)
    if len(cloud):
        cloud = _without(cloud, _repeated(cloud.xyz), "duplicates", warn)
    if len(cloud) < MIN_POINTS:
        cause = f"has only {len(cloud):,} usable points"
        raise DataError(clouds[0], cause, f"A map needs at least {MIN_POINTS:,} points")
    return cloud, crs


def _repeated(xyz: F32) -> Bools:
    """Whether each point (N, 3) equals an earlier one."""
    x, y, z = (np.ascontiguousarray(column + np.float32(0)).view(np.uint32).astype(np.uint64) for column in xyz.T)
    mixed = (x << np.uint64(32) | y) * np.uint64(0x9E3779B97F4A7C15)  # equal points have equal hashes
    order = np.argsort((mixed ^ mixed >> np.uint64(29)) + z * np.uint64(0xBF58476D1CE4E5B9), kind="stable")
    same = np.zeros(len(xyz), bool)
    same[order[1:]] = (xyz[order[1:]] == xyz[order[:-1]]).all(axis=1)
    return same


def _with_classes(cloud: PointCloud, params: MapParams, warn: Callable[[str], None]) -> PointCloud:
    """The cloud with its colours converted to classes by the legend; without one, warns if they look like labels."""
    rgb = cloud.rgb
    if rgb is None:
        if params.classes_from_colours:
            warn("the map has no colours: --classes-from-colours has no effect")
        return cloud
    if not params.classes_from_colours:
        if are_labels(rgb):
            legend = matching_legend(rgb) or "LEGEND"
            of = "" if legend == "LEGEND" else f" (those of {legend})"
            warn(
                f"the map's colours look like semantic labels{of}: use them as classes with "
                f"--classes-from-colours {legend}"
            )
        return cloud
    code, share = classes_of_colours(cloud.xyz, rgb, parse_legend(params.classes_from_colours))
    if share == 0:
        warn("no point has a colour of the legend: --classes-from-colours has no effect")
        return cloud
    warn(f"classes from colours: {share:.0%} of the points have a colour of the legend, others take their neighbours'")
    return replace(cloud, classification=code, rgb=None)


def _without(cloud: PointCloud, bad: Bools, what: str, warn: Callable[[str], None]) -> PointCloud:
    """The cloud without some points; `warn` receives their number."""
    if not bad.any():
        return cloud
    warn(f"{int(bad.sum()):,} {what} removed ({bad.mean():.1%})")
    return cloud.take(~bad)


def level_rotation(
    xyz: F32, params: MapParams, origin: F64, warn: Callable[[str], None], usual: F64 | None = None
) -> F64:
    """(3, 3) rotation from a map's axes to a level world.

    Args:
        xyz: (N, 3) metres in the map's axes, relative to `origin`.
        params: settings.
        origin: (3,) metres.
        warn: receives the tilt, and whether it is ambiguous.
        usual: (3, 3) rotation to z up by the format's specification, from which only surfaces lead away; None: z is up.
    """
    coarse = np.eye(3) if usual is None else usual
    if params.up != "auto":
        coarse = rotation_to_z(np.array(AXES[params.up], np.float64))
    elif is_surveyed(coarse @ origin):
        warn(f"{axis_name(coarse[2])} is up: {SURVEYED}")
        return coarse
    found = find_up(xyz @ coarse.T.astype(np.float32), -(coarse @ origin))
    if found is None:
        if params.up == "auto":
            warn(f"no flat surfaces: {axis_name(coarse[2])} is assumed to point up; --up names another axis")
        return coarse
    if params.up != "auto" and found.up[2] < np.cos(np.radians(45)):
        return coarse  # the user knows better
    if params.up == "auto" and found.ambiguous:
        warn(
            "the up axis is ambiguous: check the world, and if it lies on its side or its head, name the axis with --up"
        )
    nearest = rotation_to_z(_nearest_axis(found.up)) if params.up == "auto" else np.eye(3)
    tilt = np.degrees(np.arccos(np.clip(nearest[2] @ found.up, -1, 1)))
    if tilt < MIN_TILT_DEG or (not found.has_walls and tilt < MAX_SLOPE_DEG):
        if not np.array_equal(nearest, np.eye(3)):
            warn(f"up is the map's {axis_name((nearest @ coarse)[2])} axis")
        return nearest @ coarse
    R = rotation_to_z(found.up) @ coarse
    warn(_tilt_text(found, R))
    return R


def is_surveyed(origin: F64) -> bool:
    """Whether a map at `origin` (3,), metres, has the eastings, northings and heights of a survey: z is up."""
    far = np.abs(origin) > FAR_ORIGIN_M
    return bool(far[:2].all() and not far[2])


def _nearest_axis(up: F64) -> F64:
    """(3,) signed coordinate axis that is nearest to a direction."""
    axis = np.zeros(3)
    largest = np.abs(up).argmax()
    axis[largest] = np.sign(up[largest])
    return axis


def axis_name(up: F64) -> str:
    """Signed axis of a map that is nearest to a direction (3,): "z", "-y"."""
    largest = int(np.abs(up).argmax())
    return f"{'-' if up[largest] < 0 else ''}{'xyz'[largest]}"


def _tilt_text(found: Upright, R: F64) -> str:
    up = R[2]  # the world's z axis in the map's axes
    tilt = np.degrees(np.arccos(np.clip(np.abs(up).max(), -1, 1)))
    by = "walls" if found.has_walls else "ground"
    return f"up is the map's {axis_name(up)} axis, tilted by {tilt:.1f} degrees (from its {by}): levelled"


def _add_trajectory(source: Path, out: Path, T_world_map: F64, unit: float) -> None:
    """Write a trajectory in world coordinates."""
    path = trajectory_io.read(source, Frame(unit=unit), ordered=False, timed=True)
    R = T_world_map[:3, :3]
    rotations = None if path.rotations is None else R @ path.rotations
    moved: Any = Trajectory(path.times, path.positions @ R.T, rotations, path.unsure)
    trajectory_io.write(out, moved, Frame())
