"""Overlap: makes the points around a tile border identical in both tiles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import PointCloud
from scan2sim.pipeline.core.voronoi_cell import nearest
from scan2sim.pipeline.tiling.cell_params import CellParams


class OverlapParams(CellParams):
    """Which points of its neighbours a tile takes.

    Attributes:
        name: name of the tile; set by the pipeline, as the cell is.
        buffer: distance in metres beyond its cell within which a tile takes points; set by the pipeline.
    """

    name: str
    buffer: float = Field(5.0, ge=0, le=1000)


def overlap(inputs: Inputs, params: OverlapParams, out: Path, report: Report) -> Done:
    """Replace the points of `cloud` beyond its cell by those of the neighbours' clouds, `cloud.NAME`, if given.

    A point belongs to the tile with the nearest seed (of equally near ones, the first by name) and is taken from that
    tile's cloud with its attributes, in particular its class, so that both tiles have the same points around their
    border. If that tile's cloud is not given, the tile's own points are used. Coordinates are rounded to
    `pipeline.geometry.coordinate_grid.GRID_M`, which is the same in every tile.
    """
    from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid

    seeds = dict(sorted({params.name: params.seed, **params.neighbours}.items()))
    given = [name for name in seeds if name == params.name or f"cloud.{name}" in inputs]
    own = PointCloud.load(inputs["cloud"])
    parts = []
    for i, name in enumerate(given):  # same order in every tile: the first point of a voxel is the same
        report(i / len(given), name)
        cloud = own if name == params.name else PointCloud.load(inputs[f"cloud.{name}"])
        world = snap_to_grid(cloud.xyz + np.asarray(cloud.frame.origin))
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
