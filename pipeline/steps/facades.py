"""Facade completion (step `facades`): extends walls above the scanned part by photos, and closes gaps in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE, PHOTO_CLASSES
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import ThinnedCloud, TileCell
from scan2sim.pipeline.core.types import F64, I64, UNCOLOURED, Bools, PointCloud, Trajectory
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.pipeline.buildings.facade_completion import Rays, Wall
    from scan2sim.pipeline.buildings.facade_stereo import Photo

MAX_PHOTO_PIXELS = 1_000_000  # photos are downsampled to this size: all photos of a tile are kept in memory
MAX_RANGE_IMAGE_PIXELS = 120_000
MIN_DISTANCE_CELLS = 1.5  # distance from scanned points below which no point is added
POINTS_PER_CELL = 4
BORDER_MARGIN_M = 4.0  # walls this near to a tile border are not completed, so that both tiles have the same


class FacadesParams(Params):
    """How far walls are completed beyond the scan.

    Attributes:
        when: "auto": if the scanner's path and photos from the ground are available; "never".
        max_height: height above the scanned part up to which walls are searched in the photos, metres.
        gap: metres; gaps in a wall narrower than twice this are closed unless a ray passed through; 0: off.
    """

    when: Literal["auto", "never"] = "auto"
    max_height: float = Field(8.0, ge=0, le=100)
    gap: float = Field(0.5, ge=0, le=10)
    context: ThinnedCloud = ThinnedCloud()


def facades(inputs: Inputs, params: FacadesParams, out: Path, report: Report) -> Done:
    """Synthesize points on the walls of `cloud`: above the highest rays, where photos are consistent, and in gaps.

    `path` is the scanner's path. The height of walls is estimated from `views` and `labels` (class probabilities of a
    network; may be empty). `other.*` is the rest of the cloud: occluders, and returns through openings of walls.
    File: `synthesized`, a `PointCloud` with normals and without colours.
    """
    import numba
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.buildings import facade_completion as kernels
    from scan2sim.pipeline.buildings.facade_stereo import WINDOW_M
    from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid
    from scan2sim.pipeline.geometry.planes import detect

    cloud = PointCloud.load(inputs["cloud"])
    whole = PointCloud.join([cloud, *(PointCloud.load(path) for name, path in inputs.items() if "other." in name)])
    made = PointCloud(cloud.frame, np.zeros((0, 3), np.float32), normal=np.zeros((0, 3), np.float32))
    metrics: dict[str, Any] = {"walls": 0, "above_m2": 0.0, "gaps_m2": 0.0}
    if whole.time is None or not len(cloud):
        made.save(out / "synthesized.npz")
        return Done(
            {"synthesized": out / "synthesized.npz"}, metrics | {"why": "the points have no times: rays are unknown"}
        )
    assert cloud.normal is not None
    planes, which, _ = detect(cloud.xyz, cloud.normal, params.context.voxel)
    rays = kernels.Rays.of(Trajectory.load(inputs["path"]).at(whole.time), whole.xyz)
    photos = cache(lambda: load_photos(inputs, whole))
    numba.set_num_threads(1)  # many small images: starting threads would dominate
    tree, parts = cKDTree(cloud.xyz), []
    for wall in kernels.walls(cloud.xyz, which, planes, params.context.voxel, params.max_height + WINDOW_M / 2):
        report(0.1 + 0.9 * wall.plane / len(planes), "walls")
        through = kernels.cells_passed_through(wall, rays)
        above = extend_upwards(wall, rays, np.flatnonzero(which == wall.plane), through, photos)
        gaps = kernels.gap_cells(wall.known | above, through, round(params.gap / params.context.voxel))
        metrics["walls"] += 1
        for name, cells in (("above_m2", above), ("gaps_m2", gaps)):
            xyz = points_in_cells(wall, cells)
            near = np.isfinite(tree.query(xyz, distance_upper_bound=MIN_DISTANCE_CELLS * params.context.voxel)[0])
            xyz = xyz[~near & away_from_borders(xyz, cloud.frame.origin, params.context.cell)]
            metrics[name] += len(xyz) * params.context.voxel**2 / POINTS_PER_CELL
            parts.append((xyz, np.tile(wall.normal, (len(xyz), 1))))
    if parts:
        xyz, normal = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        rgb = None if cloud.rgb is None else np.full((len(xyz), 3), UNCOLOURED, np.uint8)
        classification = np.full(len(xyz), CODE["building"], np.uint8)
        made = PointCloud(
            cloud.frame, snap_to_grid(xyz).astype(np.float32), rgb, normal.astype(np.float32), classification
        )
    made.save(out / "synthesized.npz")
    rounded = {name: round(value, 1) if isinstance(value, float) else value for name, value in metrics.items()}
    return Done({"synthesized": out / "synthesized.npz"}, rounded | {"points": len(made)})


def load_photos(inputs: Inputs, whole: PointCloud) -> list[Photo]:
    """Load the photos from the ground that are not held out, each with its range image."""
    import cv2

    from scan2sim.pipeline.buildings.facade_stereo import Photo
    from scan2sim.pipeline.camera.depth_map import depth_map, scene

    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    occluders = scene([], whole)
    photos = []
    for i, (view, out) in enumerate(zip(views, held, strict=True)):
        grey = None if out or view.camera.model == "orthographic" else image.usable_levels(view)
        if grey is None:
            continue
        levels, camera = [grey], view.camera
        if grey.size > MAX_PHOTO_PIXELS:
            camera = camera.scaled((MAX_PHOTO_PIXELS / grey.size) ** 0.5)
            levels = [cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)]
        for _ in range(2):
            levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        file = inputs["labels"] / f"{i}.npy"
        sky = np.ascontiguousarray(np.load(file)[..., PHOTO_CLASSES.index("sky")]) if file.is_file() else None
        usable = image.read_mask(view)
        if usable is not None:
            usable = cv2.resize(usable, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        depth = depth_map(camera, view.T_world_cam, occluders, time=view.time, pixels=MAX_RANGE_IMAGE_PIXELS)
        photos.append(Photo(replace(view, camera=camera), tuple(map(np.asarray, levels)), usable, sky, depth))
    return photos


def extend_upwards(wall: Wall, rays: Rays, members: I64, through: Bools, photos: Callable[[], list[Photo]]) -> Bools:
    """Cells (R, C) of a wall above its scanned part.

    Photos are compared only for walls whose top edge is somewhere limited by the scanner's field of view.

    Args:
        wall: the wall.
        rays: rays of the scanner.
        members: indices of the rays that end on the wall.
        through: (R, C) cells that rays passed through.
        photos: loads the photos, when needed.
    """
    from scan2sim.pipeline.buildings.facade_completion import max_rows, solid, top_rows
    from scan2sim.pipeline.buildings.facade_stereo import REFERENCE_HEIGHT_M, WINDOW_M, evidence

    above, margin = np.zeros_like(wall.known), round(WINDOW_M / 2 / wall.cell)
    max_row = max_rows(wall, rays, members)
    if not (max_row == len(wall.known) - 1).any():
        return above
    max_row = np.where(solid(wall, through), np.minimum(max_row, len(wall.known) - 1 - margin), wall.ends)
    if len(photos()) < 2 or not (max_row > wall.ends).any():
        return above
    low, high = max(0, int(wall.tops.min() - REFERENCE_HEIGHT_M / wall.cell)), int(max_row.max()) + 1 + margin
    value, edge = evidence(wall.part(low, high), photos())
    value[through[low:high]] = -1
    ends = low + top_rows(value, edge, wall.ends - low, max_row - low)
    row = np.arange(low, high)[:, None]
    dips = (row > wall.tops) & (row <= wall.ends) & (value > 0)
    above[low:high] = dips & solid(wall, through) | (row > wall.ends) & (row <= ends)
    return above


def points_in_cells(wall: Wall, cells: Bools) -> F64:
    """Points (N, 3) in cells of a wall, four per cell at its quarter positions, so that edges are located precisely."""
    row, column = np.nonzero(cells)
    quarters = [wall.places(row + r, column + c) for r in (-0.25, 0.25) for c in (-0.25, 0.25)]
    return np.concatenate(quarters)


def away_from_borders(xyz: F64, origin: tuple[float, ...], tile: TileCell | None) -> Bools:
    """(N,) bool, True for local points (N, 3) that are not near a border with another tile."""
    if tile is None or not tile.neighbours:
        return np.ones(len(xyz), bool)
    return np.asarray(tile.cell.outside(xyz[:, :2] + np.asarray(origin[:2])) < -BORDER_MARGIN_M)


FACADES = Step("facades", 3, facades, FacadesParams)
