"""Facades: walls that go on above the scanner's reach, as photos show, and their gaps closed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE, SHOWN
from scan2sim.pipeline.core.parameters import Place, Voxel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, I64, UNCOLOURED, Bools, PointCloud, Trajectory
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.tiling.voronoi_cell import Cell

if TYPE_CHECKING:
    from scan2sim.pipeline.buildings.facade_completion import Rays, Wall
    from scan2sim.pipeline.buildings.facade_stereo import Photo

MOST = 1_000_000  # pixels at which a photo is sampled: all of a tile are kept in memory
PIXELS = 120_000  # of the range images that tell what hides a wall
APART = 1.5  # cells from any point within which none is made up
FILLING = 4  # points a cell
INLAND = 4.0  # metres from a border of tiles within which walls stay as they were scanned, in both alike


class FacadesParams(Params):
    """How far walls go on beyond what was scanned.

    Attributes:
        when: "auto": where a scanner's path and photos from the ground are known; "never".
        rise: metres above the scan that a wall is looked for in the photos.
        gap: metres; gaps of a wall that are less than twice as wide are closed, where no ray went through; 0: none.
        voxel: size that the cloud was thinned to; set by the recipe.
        seed: the tile's (x, y), world metres, where it meets others; set by the recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
    """

    when: Literal["auto", "never"] = "auto"
    rise: float = Field(8.0, ge=0, le=100)
    gap: float = Field(0.5, ge=0, le=10)
    voxel: Voxel = 0.10
    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def facades(inputs: Inputs, params: FacadesParams, out: Path, report: Report) -> Done:
    """Make up points on the walls of `cloud`: above the scanner's rays, where photos agree, and in gaps.

    `path` is the scanner's; `views` and `labels` (what a network saw in them, which may be nothing) tell how high walls
    are, `other.*` the rest of the cloud: what hides walls, and what rays hit through their openings.
    File: `made`, a `PointCloud` with normals and without colours.
    """
    import numba
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.buildings import facade_completion as kernels
    from scan2sim.pipeline.buildings.facade_stereo import WINDOW
    from scan2sim.pipeline.geometry.planes import detect
    from scan2sim.pipeline.tiling.borders.grid import on_grid

    cloud = PointCloud.load(inputs["cloud"])
    whole = PointCloud.join([cloud, *(PointCloud.load(path) for name, path in inputs.items() if "other." in name)])
    made = PointCloud(cloud.frame, np.zeros((0, 3), np.float32), normal=np.zeros((0, 3), np.float32))
    facts: dict[str, Any] = {"walls": 0, "above_m2": 0.0, "gaps_m2": 0.0}
    if whole.time is None or not len(cloud):
        made.save(out / "made.npz")
        return Done({"made": out / "made.npz"}, facts | {"why": "points without times: rays aren't known"})
    assert cloud.normal is not None
    planes, which, _ = detect(cloud.xyz, cloud.normal, params.voxel)
    rays = kernels.Rays.of(Trajectory.load(inputs["path"]).at(whole.time), whole.xyz)
    photos = cache(lambda: photos_of(inputs, whole))
    numba.set_num_threads(1)  # many small pictures: threads would wait for one another
    tree, parts = cKDTree(cloud.xyz), []
    for wall in kernels.walls(cloud.xyz, which, planes, params.voxel, params.rise + WINDOW / 2):
        report(0.1 + 0.9 * wall.plane / len(planes), "walls")
        through = kernels.passed(wall, rays)
        above = raised(wall, rays, np.flatnonzero(which == wall.plane), through, photos)
        gaps = kernels.closed(wall.known | above, through, round(params.gap / params.voxel))
        facts["walls"] += 1
        for name, cells in (("above_m2", above), ("gaps_m2", gaps)):
            xyz = filled(wall, cells)
            near = np.isfinite(tree.query(xyz, distance_upper_bound=APART * params.voxel)[0])
            xyz = xyz[~near & inland(xyz, cloud.frame.origin, params)]
            facts[name] += len(xyz) * params.voxel**2 / FILLING
            parts.append((xyz, np.tile(wall.normal, (len(xyz), 1))))
    if parts:
        xyz, normal = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        rgb = None if cloud.rgb is None else np.full((len(xyz), 3), UNCOLOURED, np.uint8)
        classification = np.full(len(xyz), CODE["building"], np.uint8)
        made = PointCloud(cloud.frame, on_grid(xyz).astype(np.float32), rgb, normal.astype(np.float32), classification)
    made.save(out / "made.npz")
    rounded = {name: round(value, 1) if isinstance(value, float) else value for name, value in facts.items()}
    return Done({"made": out / "made.npz"}, rounded | {"points": len(made)})


def photos_of(inputs: Inputs, whole: PointCloud) -> list[Photo]:
    """The photos from the ground that aren't held out, with what hides walls from them."""
    import cv2

    from scan2sim.pipeline.buildings.facade_stereo import Photo
    from scan2sim.pipeline.camera.depth_map import depth_map, scene

    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    hides = scene([], whole)
    photos = []
    for i, (view, out) in enumerate(zip(views, held, strict=True)):
        grey = None if out or view.camera.model == "orthographic" else image.usable_levels(view)
        if grey is None:
            continue
        levels, camera = [grey], view.camera
        if grey.size > MOST:
            camera = camera.scaled((MOST / grey.size) ** 0.5)
            levels = [cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)]
        for _ in range(2):
            levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        file = inputs["labels"] / f"{i}.npy"
        sky = np.ascontiguousarray(np.load(file)[..., SHOWN.index("sky")]) if file.is_file() else None
        usable = image.read_mask(view)
        if usable is not None:
            usable = cv2.resize(usable, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        depth = depth_map(camera, view.T_world_cam, hides, time=view.time, pixels=PIXELS)
        photos.append(Photo(replace(view, camera=camera), tuple(map(np.asarray, levels)), usable, sky, depth))
    return photos


def raised(wall: Wall, rays: Rays, own: I64, through: Bools, photos: Callable[[], list[Photo]]) -> Bools:
    """(R, C) cells of a wall above its scan; its points are `own` of the rays' ends, which went `through` its cells.

    Photos are compared for walls that somewhere end where the scanner's rays do.
    """
    from scan2sim.pipeline.buildings.facade_completion import ceiling, highest, solid
    from scan2sim.pipeline.buildings.facade_stereo import BELOW, WINDOW, evidence

    above, margin = np.zeros_like(wall.known), round(WINDOW / 2 / wall.cell)
    most = ceiling(wall, rays, own)
    if not (most == len(wall.known) - 1).any():
        return above
    most = np.where(solid(wall, through), np.minimum(most, len(wall.known) - 1 - margin), wall.ends)
    if len(photos()) < 2 or not (most > wall.ends).any():
        return above
    low, high = max(0, int(wall.tops.min() - BELOW / wall.cell)), int(most.max()) + 1 + margin
    value, edge = evidence(wall.part(low, high), photos())
    value[through[low:high]] = -1
    ends = low + highest(value, edge, wall.ends - low, most - low)
    row = np.arange(low, high)[:, None]
    dips = (row > wall.tops) & (row <= wall.ends) & (value > 0)
    above[low:high] = dips & solid(wall, through) | (row > wall.ends) & (row <= ends)
    return above


def filled(wall: Wall, cells: Bools) -> F64:
    """(N, 3) places that fill cells of a wall: four in each, so that its edges are told from their outermost."""
    row, column = np.nonzero(cells)
    quarters = [wall.places(row + r, column + c) for r in (-0.25, 0.25) for c in (-0.25, 0.25)]
    return np.concatenate(quarters)


def inland(xyz: F64, origin: tuple[float, ...], params: FacadesParams) -> Bools:
    """(N,) which local places (N, 3) aren't near a border of tiles."""
    if params.seed is None or not params.neighbours:
        return np.ones(len(xyz), bool)
    return np.asarray(Cell(params.seed, params.neighbours).outside(xyz[:, :2] + np.asarray(origin[:2])) < -INLAND)


FACADES = Step("facades", 2, facades, FacadesParams)
