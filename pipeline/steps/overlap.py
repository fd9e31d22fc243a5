"""Overlap: what two tiles both know of their border's surroundings, made the same for both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import PointCloud
from scan2sim.pipeline.steps.clip import CellParams
from scan2sim.pipeline.tiling.voronoi_cell import nearest


class OverlapParams(CellParams):
    """Which points of its neighbours a tile takes.

    Attributes:
        name: of the tile; set by the recipe, as the cell is.
        buffer: metres beyond its cell from which a tile takes points; set by the recipe.
    """

    name: str
    buffer: float = Field(5.0, ge=0, le=1000)


def overlap(inputs: Inputs, params: OverlapParams, out: Path, report: Report) -> Done:
    """Take what is beyond the borders of `cloud` from the neighbours' clouds, `cloud.NAME`, where given.

    A point belongs to the tile with the nearest seed (of several as near, to the one whose name sorts first), and
    is taken from there with what that tile knows of it, its class above all. So tiles see the same points around
    their border. Where the nearest tile's cloud is not given, the tile's own points stand in. Coordinates are
    rounded to `pipeline.tiling.borders.grid.GRID`: the same in every tile.
    """
    from scan2sim.pipeline.tiling.borders.grid import on_grid

    seeds = dict(sorted({params.name: params.seed, **params.neighbours}.items()))
    given = [name for name in seeds if name == params.name or f"cloud.{name}" in inputs]
    own = PointCloud.load(inputs["cloud"])
    parts = []
    for i, name in enumerate(given):  # by name in every tile: of the points of a voxel the same one comes first
        report(i / len(given), name)
        cloud = own if name == params.name else PointCloud.load(inputs[f"cloud.{name}"])
        world = on_grid(cloud.xyz + np.asarray(cloud.frame.origin))
        owner = np.array(list(seeds))[nearest(world[:, :2], list(seeds.values()))]
        if name == params.name:
            taken = (owner == name) | ~np.isin(owner, given)
        else:
            taken = (owner == name) & (params.cell.outside(world[:, :2]) <= params.buffer)
        index = np.flatnonzero(taken)
        local = (world[index] - np.asarray(own.frame.origin)).astype(np.float32)
        parts.append(replace(cloud.take(index), frame=own.frame, xyz=local))
    cloud = PointCloud.join(parts)
    cloud.save(out / "cloud.npz")
    points = {name: len(part) for name, part in zip(given, parts, strict=True)}
    missing = [name for name in seeds if name not in given]
    return Done({"cloud": out / "cloud.npz"}, {"points_in": len(own), "points": points, "missing": missing})


OVERLAP = Step("overlap", 1, overlap, OverlapParams)
