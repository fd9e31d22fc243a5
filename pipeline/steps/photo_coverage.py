"""Photo coverage step: removes points that no photo shows well and that are far from the scanner's path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import ThinnedCloud
from scan2sim.pipeline.core.types import F64, Bools, PointCloud, Trajectory, View
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


class PhotoCoverageParams(Params):
    """Which points are kept.

    Attributes:
        limit: "auto": points with a ground sample distance of at most two voxels in a photo, and points beside the
            path; a number: points within this distance of the path in metres, seen or not; "off": all points.
    """

    limit: Literal["auto", "off"] | Annotated[float, Field(ge=1, le=10_000)] = "auto"
    context: ThinnedCloud = ThinnedCloud()


def photo_coverage(inputs: Inputs, params: PhotoCoverageParams, out: Path, report: Report) -> Done:
    """Remove the points of `cloud` that no photo of `views` covers well enough and that are far from the `path`.

    Held-out photos are ignored. Ground in between and margins of walls and plants are kept (`CLOSING_GAP_M`,
    `MARGIN_M`). A tile without photos or path keeps its whole cloud, as does one with an aerial path
    (`AERIAL_PATH_HEIGHT_M`). Metrics: `points` kept, `left_out` points removed, their approximate surface
    `left_out_m2`, and `far_m`, distance from the path to the farthest kept point.
    """
    file = out / "cloud.npz"
    if "path" not in inputs or (params.limit == "auto" and "views" not in inputs):
        link_or_copy(inputs["cloud"], file)
        return Done({"cloud": file}, {"left_out": 0})
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
    if kept.all():
        link_or_copy(inputs["cloud"], file)
    else:
        voxel = np.empty(len(cloud), np.int64)
        voxel[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
        cloud = cloud.take(kept[voxel])
        cloud.save(file)
    metrics = {
        "points_in": len(order),
        "points": len(cloud),
        "left_out": len(order) - len(cloud),
        "left_out_m2": round(float((~kept).sum() * cell_m**2)),
        "far_m": round(_farthest(thin, kept, path.positions), 1),
    }
    return Done({"cloud": file}, metrics)


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


PHOTO_COVERAGE = Step("photo_coverage", 1, photo_coverage, PhotoCoverageParams)
