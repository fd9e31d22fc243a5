"""Reach: what lies so far from photos and path that it is worth no triangle is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.parameters import Voxel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Bools, PointCloud, Trajectory, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.file_checks import pass_on
from scan2sim.pipeline.steps.voxel import sample, voxel_groups

PATCH = 2.0
"""Voxels: a photo is asked for a pixel on every square of this side. Coarser, all that a voxel can show is a blur."""
LANES = 3.5
"""Metres to each side of the path: a lane's width."""
RIM = {"terrain": 0.2, "building": 1.0, "vegetation": 0.2, "rest": 1.0}
"""Metres around what photos see that belong to it: behind the edge of a wall goes on, a hedge is as deep as it is."""
CELL, GAP = 0.5, 2.0
"""Metres, of ground that nothing is seen of: gaps so wide between what is kept are closed (the far side of a car)."""
HIGH = 15.0
"""Metres of a path above the ground from which on it is none along a street: all is kept."""


class ReachParams(Params):
    """What is near enough.

    Attributes:
        limit: "auto", what a photo shows at a pixel or more to every square of two voxels, and what is beside the path;
            metres, what is within so many of the path, seen or not; "off", everything.
        voxel: metres, of the mesh's samples; set by the recipe.
    """

    limit: Literal["auto", "off"] | Annotated[float, Field(ge=1, le=10_000)] = "auto"
    voxel: Voxel = 0.10


def reach(inputs: Inputs, params: ReachParams, out: Path, report: Report) -> Done:
    """Drop the points of `cloud` that no photo of `views` shows well enough and that lie far from the scanner's `path`.

    Photos that are held out don't count. Ground in between, and the rims of walls and plants, are kept (`GAP`, `RIM`).
    A tile of a survey that has neither photos nor path keeps its cloud, and so does one whose path is in the air
    (`HIGH`). Facts: `points` kept, `left_out` points, about `left_out_m2` of surface, and `far_m`, how far from the
    path the farthest point is that is kept.
    """
    file = out / "cloud.npz"
    if "path" not in inputs or (params.limit == "auto" and "views" not in inputs):
        pass_on(inputs["cloud"], file)
        return Done({"cloud": file}, {"left_out": 0})
    report(0.0, "reading")
    cloud, path = PointCloud.load(inputs["cloud"]), Trajectory.load(inputs["path"])
    size = PATCH * params.voxel
    report(0.1, "thinning")
    order, starts = voxel_groups(cloud.xyz, size)
    thin = sample(replace(cloud, rgb=None), size, (order, starts))
    if _above(thin, path.positions) > HIGH:
        kept = np.ones(len(thin), bool)
    elif not isinstance(params.limit, str):
        from scan2sim.pipeline.camera.photo_coverage import along

        kept = along(thin.xyz, path.positions, params.limit)
    else:
        views = views_io.load(inputs["views"])
        held = views_io.load_held_out(inputs["views"])
        shown = [v for v, out_ in zip(views, held, strict=True) if v.camera.model != "orthographic" and not out_]
        kept = _worth(thin, shown, path, size, report)
    report(0.9, "writing")
    if kept.all():
        pass_on(inputs["cloud"], file)
    else:
        voxel = np.empty(len(cloud), np.int64)
        voxel[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
        cloud = cloud.take(kept[voxel])
        cloud.save(file)
    facts = {
        "points_in": len(order),
        "points": len(cloud),
        "left_out": len(order) - len(cloud),
        "left_out_m2": round(float((~kept).sum() * size**2)),
        "far_m": round(_farthest(thin, kept, path.positions), 1),
    }
    return Done({"cloud": file}, facts)


def _worth(thin: PointCloud, views: Sequence[View], path: Trajectory, size: float, report: Report) -> Bools:
    """(N,) which points photos show well enough, or lie by the path, or belong to what does."""
    from scan2sim.pipeline.camera.photo_coverage import along, around, closed, finest
    from scan2sim.pipeline.geometry.normals import oriented_normals

    report(0.2, "normals")
    thin = oriented_normals(thin, 12, path)
    seen = finest(thin, views, size=size, coarsest=size, report=lambda f, m="": report(0.3 + 0.5 * f, m)) < size
    report(0.8, "surroundings")
    kept = along(thin.xyz, path.positions, LANES)
    assert thin.classification is not None
    group = group_of()[thin.classification]
    for i, name in enumerate((*GROUPS, "rest")):
        of = np.flatnonzero(group == (i if name != "rest" else -1))
        near = around(thin.xyz[of], seen[of], RIM[name])
        kept[of] |= near
        if name == "terrain":
            kept[of] |= closed(thin.xyz[of], near | kept[of], CELL, GAP)
    return kept


def _above(thin: PointCloud, path: F64) -> float:
    """Metres of the path above the ground beneath, in the middle."""
    from scipy.spatial import cKDTree

    some = path[:: max(1, len(path) // 1000)]
    _, near = cKDTree(thin.xyz[:, :2]).query(some[:, :2], k=min(30, len(thin)), workers=-1)
    low = np.percentile(thin.xyz[near.reshape(len(some), -1), 2], 20, axis=1)
    return float(np.median(some[:, 2] - low))


def _farthest(thin: PointCloud, kept: Bools, path: F64) -> float:
    from scipy.spatial import cKDTree

    if not kept.any():
        return 0.0
    distance, _ = cKDTree(path[:, :2]).query(thin.xyz[kept, :2], workers=-1)
    return float(distance.max())


REACH = Step("reach", 1, reach, ReachParams)
