"""Photo coverage step: separates points that no photo shows well and that are far from the scanner's path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import GROUPS, colour_of, group_of
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import ThinnedCloud
from scan2sim.pipeline.core.types import F64, Bools, PointCloud, Trajectory, View
from scan2sim.pipeline.geometry.coarse_surface import coarse_spacing
from scan2sim.pipeline.geometry.voxel_grid import sample, voxel_groups
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.file_checks import link_or_copy

MAX_GSD_VOXELS = 2.0
"""Coarsest ground sample distance of a covered point, in voxels; a coarser texture is blurred even at voxel scale."""
ROADSIDE_M = 3.5
"""Points within this distance of the path are kept: the width of a lane on each side."""
MARGIN_M = {"terrain": 0.2, "building": 1.0, "vegetation": 0.2, "rest": 1.0}
"""Margin around covered points, by group: a wall continues behind its edge, a hedge has depth."""
CLOSING_CELL_M, CLOSING_GAP_M = 0.5, 2.0
"""Uncovered ground between covered ground is kept up to this width (the far side of a car); closing on a grid."""
AERIAL_PATH_HEIGHT_M = 15.0
"""A path higher above the ground is not one of a street vehicle: all points are kept."""
NORMAL_NEIGHBOURS = 12
BORDER_STRIP_M = 0.5
"""Distance from the border of a tile within which there is no coarse surface: sparse points don't define where two
meshes meet."""


class PhotoCoverageParams(Params):
    """Which points get a detailed surface, and what becomes of the others.

    Attributes:
        limit: "auto": points with a ground sample distance of at most two voxels in a photo, and points beside the
            path; a number: points within this distance of the path in metres, seen or not, and no others; "off": all.
        uncovered: with "auto": other points get a coarse surface, which a lidar sees ("coarse"), or none ("remove").
    """

    limit: Literal["auto", "off"] | Annotated[float, Field(ge=1, le=10_000)] = "auto"
    uncovered: Literal["coarse", "remove"] = "coarse"
    context: ThinnedCloud = ThinnedCloud()


def photo_coverage(inputs: Inputs, params: PhotoCoverageParams, out: Path, report: Report) -> Done:
    """Separate points of `cloud` that no photo of `views` covers well enough and that are far from the `path`.

    Held-out photos are ignored. Ground in between and margins of walls and plants count as covered (`CLOSING_GAP_M`,
    `MARGIN_M`), as does the whole cloud of a tile without photos or path, or with an aerial path
    (`AERIAL_PATH_HEIGHT_M`). Files: `cloud`, the covered points; `uncovered`, the others, thinned, with normals.
    Metrics: `points` covered, `left_out` others, their approximate surface `left_out_m2`, points `coarse` that they
    were thinned to, and `far_m`, distance from the path to the farthest covered point.
    """
    file = out / "cloud.npz"
    if "path" not in inputs or (params.limit == "auto" and "views" not in inputs):
        link_or_copy(inputs["cloud"], file)
        _empty(PointCloud.load(inputs["cloud"])).save(out / "uncovered.npz")
        return Done({"cloud": file, "uncovered": out / "uncovered.npz"}, {"left_out": 0, "coarse": 0})
    report(0.0, "reading")
    cloud, path = PointCloud.load(inputs["cloud"]), Trajectory.load(inputs["path"])
    cell_m = MAX_GSD_VOXELS * params.context.voxel
    report(0.1, "thinning")
    order, starts = voxel_groups(cloud.xyz, cell_m)
    thin = sample(replace(cloud, rgb=None), cell_m, (order, starts))
    if _path_height(thin, path.positions) > AERIAL_PATH_HEIGHT_M:
        kept = np.ones(len(thin), bool)
    elif not isinstance(params.limit, str):
        from scan2sim.pipeline.camera.photo_coverage import near_path

        kept = near_path(thin.xyz, path.positions, params.limit)
    else:
        views = views_io.load(inputs["views"])
        held = views_io.load_held_out(inputs["views"])
        used = [v for v, out_ in zip(views, held, strict=True) if v.camera.model != "orthographic" and not out_]
        kept = _covered(thin, used, path, cell_m, report)
    report(0.9, "writing")
    voxel = np.empty(len(cloud), np.int64)
    voxel[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
    covered = kept[voxel]
    is_coarse = ~covered if params.limit == "auto" and params.uncovered == "coarse" else np.zeros(len(cloud), bool)
    coarse = _coarse(cloud, is_coarse, path, coarse_spacing(params.context.voxel))
    if params.context.cell is not None:
        world = coarse.xyz[:, :2] + np.asarray(coarse.frame.origin)[:2]
        coarse = coarse.take(np.abs(params.context.cell.cell.outside(world)) > BORDER_STRIP_M)
    coarse.save(out / "uncovered.npz")
    if covered.all():
        link_or_copy(inputs["cloud"], file)
    else:
        cloud = cloud.take(covered)
        cloud.save(file)
    metrics = {
        "points_in": len(order),
        "points": len(cloud),
        "left_out": len(order) - len(cloud),
        "left_out_m2": round(float((~kept).sum() * cell_m**2)),
        "coarse": len(coarse),
        "far_m": round(_farthest(thin, kept, path.positions), 1),
    }
    return Done({"cloud": file, "uncovered": out / "uncovered.npz"}, metrics)


def _covered(thin: PointCloud, views: Sequence[View], path: Trajectory, cell_m: float, report: Report) -> Bools:
    """(N,) bool, True for points that photos cover well enough, points near the path, and their surroundings."""
    from scan2sim.pipeline.camera.photo_coverage import close_selection, dilate_selection, finest_gsd, near_path
    from scan2sim.pipeline.geometry.normals import oriented_normals

    report(0.2, "normals")
    thin = oriented_normals(thin, 12, path)
    gsd = finest_gsd(thin, views, voxel=cell_m, max_gsd=cell_m, report=lambda f, m="": report(0.3 + 0.5 * f, m))
    seen = gsd < cell_m
    report(0.8, "surroundings")
    kept = near_path(thin.xyz, path.positions, ROADSIDE_M)
    assert thin.classification is not None
    group = group_of()[thin.classification]
    for i, name in enumerate((*GROUPS, "rest")):
        members = np.flatnonzero(group == (i if name != "rest" else -1))
        near = dilate_selection(thin.xyz[members], seen[members], MARGIN_M[name])
        kept[members] |= near
        if name == "terrain":
            kept[members] |= close_selection(thin.xyz[members], near | kept[members], CLOSING_CELL_M, CLOSING_GAP_M)
    return kept


def _coarse(cloud: PointCloud, chosen: Bools, path: Trajectory, size: float) -> PointCloud:
    """One of the `chosen` (N,) points of the cloud per class and voxel of `size` metres, with normals.

    Points that no photo coloured get the colour of their class in this cloud, shaded by intensity.
    """
    from scan2sim.pipeline.geometry.normals import oriented_normals
    from scan2sim.pipeline.lidar.intensity import has_intensity
    from scan2sim.pipeline.lidar.intensity_colours import intensity_colours

    assert cloud.classification is not None
    code = cloud.classification
    parts = [sample(cloud.take(chosen & (code == one)), size) for one in np.unique(code[chosen])]
    thin = PointCloud.join(
        [oriented_normals(part, NORMAL_NEIGHBOURS, path) for part in parts if len(part) > NORMAL_NEIGHBOURS]
        or [_empty(cloud)]
    )
    if cloud.rgb is None or not (coloured := cloud.coloured).any() or thin.coloured.all():
        return thin
    tint = colour_of().copy()
    for one in np.unique(code[chosen]):
        if (own := coloured & (code == one)).any():
            tint[one] = np.median(cloud.rgb[own], axis=0)
    assert thin.rgb is not None and thin.classification is not None
    other = intensity_colours(thin, path, tint) if has_intensity(thin) else tint[thin.classification]
    return replace(thin, rgb=np.where(thin.coloured[:, None], thin.rgb, other))


def _empty(cloud: PointCloud) -> PointCloud:
    """The cloud without its points, with normals."""
    return replace(cloud.take(slice(0)), normal=np.empty((0, 3), np.float32))


def _path_height(thin: PointCloud, path: F64) -> float:
    """Median height of the path above the ground below it, metres."""
    from scipy.spatial import cKDTree

    positions = path[:: max(1, len(path) // 1000)]
    _, near = cKDTree(thin.xyz[:, :2]).query(positions[:, :2], k=min(30, len(thin)), workers=-1)
    low = np.percentile(thin.xyz[near.reshape(len(positions), -1), 2], 20, axis=1)
    return float(np.median(positions[:, 2] - low))


def _farthest(thin: PointCloud, kept: Bools, path: F64) -> float:
    from scipy.spatial import cKDTree

    if not kept.any():
        return 0.0
    distance, _ = cKDTree(path[:, :2]).query(thin.xyz[kept, :2], workers=-1)
    return float(distance.max())


PHOTO_COVERAGE = Step("photo_coverage", 3, photo_coverage, PhotoCoverageParams)
