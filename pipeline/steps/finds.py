"""Finds: the signs, poles, lamps and trunks that a tile sees by itself, before its neighbours are asked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Place
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, Bools, PointCloud, Trajectory
from scan2sim.pipeline.tiling.voronoi_cell import Cell

if TYPE_CHECKING:
    from scan2sim.pipeline.furniture.classify import Thing

    Bools = Bools

CELL = 0.5  # metres, of the ground's heights
LOW, HIGH = 0.2, 14.0  # metres above the ground where things are looked for
BEYOND = 0.5  # metres beyond its cell from which on a tile leaves things to the neighbour, who sees more around them
KINDS = ("pole", "sign", "lamp", "trunk")


class FindsParams(Params):
    """What of the survey is the tile's own.

    Attributes:
        seed: the tile's (x, y), world metres, where it meets others: of what stands further than half a metre beyond
            its cell it tells nothing; set by the recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
    """

    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def finds(inputs: Inputs, params: FindsParams, out: Path, report: Report) -> Done:
    """Find what stands upright and thin in the classified `cloud`, seen from the scanner's `path`.

    Tiles of a survey without a path find nothing.
    File: `finds`, JSON list of `Thing`s in world metres. Facts: how many of each kind.
    """
    things: list[Thing] = []
    if "path" in inputs:
        cloud = PointCloud.load(inputs["cloud"])
        report(0.3, "stems")
        things = seen(cloud, Trajectory.load(inputs["path"]))
        origin = np.asarray(cloud.frame.origin, np.float64)
        things = [thing.moved(origin) for thing in things]
        if params.seed is not None and things:
            outside = Cell(params.seed, params.neighbours).outside(np.array([thing.foot[:2] for thing in things]))
            things = [thing for thing, far in zip(things, outside, strict=True) if far <= BEYOND]
    (out / "finds.json").write_text(json.dumps([thing.to_json() for thing in things]), encoding="utf-8")
    return Done({"finds": out / "finds.json"}, {kind: sum(t.kind == kind for t in things) for kind in KINDS})


def seen(cloud: PointCloud, path: Trajectory) -> list[Thing]:
    """What stands in a cloud, local metres."""
    from scan2sim.pipeline.furniture.classify import eligible, find
    from scan2sim.pipeline.furniture.poles import Columns

    ground, some = eligible(cloud)
    if not ground.any() or not len(some):
        return []
    height = heights(cloud.xyz[ground], cloud.xyz[some])
    within = (height > LOW) & (height < HIGH)
    part = cloud.take(some[within])
    return find(part, Columns(part.xyz), height[within], path) if len(part) else []


def heights(ground: F32, xyz: F32) -> F32:
    """(N,) metres of points (N, 3) above the lowest ground (M, 3) near them."""
    from scipy import ndimage

    from scan2sim.pipeline.geometry.height_map import Raster

    raster = Raster.over(CELL, [ground, xyz])
    low = -raster.highest(np.column_stack([ground[:, :2], -ground[:, 2]]).astype(np.float32))
    nearest = ndimage.distance_transform_edt(np.isnan(low), return_distances=False, return_indices=True)
    smooth = ndimage.median_filter(low[tuple(nearest)], 5)
    return (xyz[:, 2] - smooth[raster.at(xyz)]).astype(np.float32)


FINDS = Step("finds", 1, finds, FindsParams, side_product=True)
