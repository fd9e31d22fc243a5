"""Placement of lidar sweeps, shared by the importers: points at their poses, coloured by photos, merged into a tile."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Camera, Frame, PointCloud, Trajectory, View
from scan2sim.pipeline.geometry.voxel_grid import thin_voxels
from scan2sim.pipeline.importers.point_colours import colour_from_photo, fill_colours
from scan2sim.pipeline.importers.scanner_path import ScannerPath
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.sweep_files import Sweep
from scan2sim.pipeline.io.tile import read_tile, tile_name, write_tile
from scan2sim.pipeline.io.tile_folder import add_file, tile_folder

MAX_PENDING_POINTS = 8_000_000
"""Points that are gathered before they are thinned, coloured and written: a block takes about 1 GB of memory."""
PLACED, WRITTEN = 0.8, 0.9
"""Progress of an import when all sweeps are placed, and when their points are written."""


@dataclass(frozen=True)
class PlacedPoints:
    """Points of sweeps.

    Attributes:
        xyz: (N, 3) local coordinates, metres.
        rgb: (N, 3) colours.
        seen: (N,) whether a point has a colour.
        time: (N,) seconds at which it was measured.
        intensity: (N,) 0 if unknown.
        distance: (N,) metres from the scanner.
        classification: (N,) class codes; 0 if unknown.
    """

    xyz: F32
    rgb: U8
    seen: Bools
    time: F64
    intensity: npt.NDArray[np.uint16]
    distance: F32
    classification: U8


def place(
    sweep: Sweep,
    times: F64,
    path: ScannerPath,
    views: Iterable[tuple[View, U8 | None]] = (),
    *,
    remedy: str = "Give the camera that took it",
) -> PlacedPoints:
    """Transform a sweep's points by the scanner's pose at their times (N,), and colour those without a colour.

    Args:
        sweep: points in scanner axes.
        times: (N,) seconds; different ones for deskewing.
        path: path of the scanner.
        views: photos taken beside the sweep with their masks; the first that sees a point colours it.
        remedy: see `colour_from_photo`.

    Raises:
        InputError: a photo can't be read, or its size differs from its camera's.
    """
    world = path.to_local(sweep.xyz, times)
    rgb, seen = np.zeros((len(world), 3), np.uint8), np.zeros(len(world), bool)
    if sweep.rgb is not None:
        rgb, seen = sweep.rgb, np.ones(len(world), bool)
    if len(world):
        for view, mask in views:
            colour_from_photo(world, view, rgb, seen, mask=mask, remedy=remedy)
    distance = np.linalg.norm(sweep.xyz, axis=1).astype(np.float32)
    classes = np.zeros(len(world), np.uint8) if sweep.classification is None else sweep.classification
    return PlacedPoints(world.astype(np.float32), rgb, seen, times, sweep.intensity, distance, classes)


def merge(parts: Iterable[PlacedPoints], voxel: float | None = None) -> Iterator[PlacedPoints]:
    """The points of sweeps in blocks, whose size doesn't depend on the number of sweeps.

    With `voxel`, they are thinned to one per voxel of that many metres within a block; coloured ones have priority,
    then the one measured from nearest.
    """
    gathered, pending = list[PlacedPoints](), 0
    for part in parts:
        gathered.append(part)
        pending += len(part.xyz)
        if pending > MAX_PENDING_POINTS:
            gathered = [_joined(gathered, voxel)]
            pending = len(gathered[0].xyz)
            if pending > MAX_PENDING_POINTS / 2:
                yield gathered.pop()
                pending = 0
    if pending:
        yield _joined(gathered, voxel)


def _joined(parts: Sequence[PlacedPoints], voxel: float | None) -> PlacedPoints:
    merged = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(PlacedPoints)}
    if voxel is not None and len(merged["xyz"]):
        keep = np.sort(thin_voxels(merged["xyz"], voxel, np.where(merged["seen"], 0.0, 1e6) + merged["distance"]))
        merged = {key: values[keep] for key, values in merged.items()}
    return PlacedPoints(**merged)


def write_placed(
    out: Path,
    blocks: Iterable[PlacedPoints],
    frame: Frame,
    trajectory: Trajectory,
    views: Mapping[str, Sequence[View]],
    cameras: dict[str, Camera],
    *,
    sweeps: Path,
    name: str,
    crs: str,
    link: bool,
    overwrite: bool,
    report: Report,
) -> Path:
    """Create a tile of placed sweeps, with a cloud for each block of points.

    Points without a colour get that of the nearest coloured point nearby, or grey. If no point has a colour, the cloud
    has none.

    Args:
        out: folder of the tile to create.
        blocks: the points (`merge`); their coordinates, and those of `trajectory` and `views`, are in `frame`.
        frame: origin and CRS.
        trajectory: path of the scanner.
        views: photos by key of their camera, named by their files below photos/.
        cameras: cameras by key.
        sweeps: source of the points, for errors.
        name: name of the tile.
        crs: the CRS as it is written to the tile.
        link: symlink photos instead of copying them.
        overwrite: replace an existing tile.
        report: receives progress.

    Returns:
        Path of the `tile.toml`.

    Raises:
        DataError: there are no points. SettingError: `out` is not empty.
    """
    with tile_folder(out, overwrite) as work:
        clouds = list[str]()
        for points in blocks:
            clouds.append(f"cloud_{len(clouds) + 1}.laz" if clouds else "cloud.laz")
            _write_cloud(work / clouds[-1], points, frame)
            del points  # before the next block is gathered
        if not clouds:
            raise DataError(sweeps, "has no points within range", "Increase --max-range, or check the files")
        report(WRITTEN, "photos")
        trajectory_io.write(work / "trajectory.csv", trajectory, frame)
        write_tile(
            work,
            name=tile_name(name),
            crs=crs,
            clouds=clouds,
            cameras=cameras,
            photos=_photo_entries(views, frame, work, link),
            trajectory="trajectory.csv",
        )
        read_tile(work)  # an invalid tile is an error here, before its folder appears
    report(1.0, "done")
    return Path(out) / "tile.toml"


def _write_cloud(path: Path, points: PlacedPoints, frame: Frame) -> None:
    rgb = fill_colours(points.xyz, points.rgb, points.seen, points.distance) if points.seen.any() else None
    intensity = points.intensity if points.intensity.any() else None
    classes = points.classification if points.classification.any() else None
    las.write(path, PointCloud(frame, points.xyz, rgb, classification=classes, time=points.time, intensity=intensity))


def _photo_entries(views: Mapping[str, Sequence[View]], frame: Frame, work: Path, link: bool) -> list[dict[str, Any]]:
    """Copy or link photos and masks; returns their entries for `write_tile`."""
    masks = {view.mask for own in views.values() for view in own}
    names = {mask: mask and add_file(mask, work, f"masks/{mask.name}", link) for mask in masks}
    return [
        {
            "file": add_file(view.photo, work, f"photos/{view.name}", link),
            "camera": key,
            "position": frame.to_crs(view.centre),
            "rotation": view.T_world_cam[:3, :3],
            "time": view.time,
            "mask": names[view.mask],
        }
        for key, own in views.items()
        for view in own
    ]
