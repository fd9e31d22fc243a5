"""Ground: closed under roofs and crowns, where an airborne scanner saw none; in streets where something hid it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.parameters import Place
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import UNCOLOURED, Bools, Frame, PointCloud
from scan2sim.pipeline.tiling.voronoi_cell import Cell, nearest

if TYPE_CHECKING:
    from scan2sim.pipeline.geometry.height_map import Raster

    Bools = Bools

FLAT = 0.5  # |nz| from which on a surface is a roof's
COVER = 3  # cells of the points' spacing: gaps between points of one roof or crown
BESIDE = 0.5  # metres around a vehicle's box within which its shadow in the scan may reach
HOLE = 25.0  # m2 up to which a hole with ground all around it is closed: a courtyard isn't


class MadeUpParams(Params):
    """Whether what an airborne scanner can't see is made up.

    Attributes:
        when: "auto": where the tile has neither a scanner's path nor photos with poses, and more of its buildings'
            points lie on roofs than on walls; "always", "never".
        seed: the tile's (x, y), world metres, where it meets others; set by the recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
        name: of the tile; set by the recipe.
        buffer: metres beyond its cell up to which a tile's cloud reaches; set by the recipe.
    """

    when: Literal["auto", "always", "never"] = "auto"
    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)
    name: str = ""
    buffer: float = Field(5.0, ge=0, le=1000)


class GroundParams(MadeUpParams):
    """Which holes are closed; the rest as of the walls, but that "auto" closes those of streets as well.

    Attributes:
        reach: metres; gaps between ground, roofs and crowns that are less than twice as wide are closed as well.
        gap: metres; with a scanner's path, gaps of the ground that are less than twice as wide are closed, holes with
            ground all around them up to 25 m2, and where parked vehicles were taken out.
    """

    reach: float = Field(10.0, ge=0, le=50)
    gap: float = Field(1.5, ge=0, le=50)


def ground(inputs: Inputs, params: GroundParams, out: Path, report: Report) -> Done:
    """Make up points of the ground where `terrain` has a hole under `building`, `vegetation` or `rest`.

    With `things` (GeoJSON of vehicles that were taken out) it is a street's ground: what hid it is gone or is a low
    wall, and just its gaps are closed (`gap`). The holes' heights and colours hang from their rims like a membrane;
    a street's made-up points have no colour, as the texture goes on by itself. Where the tile meets others, their
    clouds (`terrain.NAME` and so on) are looked at as well: both tiles fill a hole on their border alike.
    File: `made`, a `PointCloud` with normals, as dense as the ground's own points are.
    """
    from scan2sim.pipeline.geometry.height_map import Raster, closed, grown, membrane, spacing
    from scan2sim.pipeline.tiling.borders.grid import on_grid

    terrain = united(inputs, params, "terrain")
    above = [united(inputs, params, part) for part in ("building", "vegetation", "rest") if part in inputs]
    street = "things" in inputs
    active = street or params.when == "always" or from_above(above[0])
    made = PointCloud(terrain.frame, np.zeros((0, 3), np.float32), normal=np.zeros((0, 3), np.float32))
    area = 0.0
    if active and len(terrain) and (street or any(map(len, above))):
        from scipy import ndimage

        raster = Raster.over(spacing(terrain.xyz), [terrain.xyz, *(cloud.xyz for cloud in above)])
        columns = [terrain.xyz[:, 2:]] + ([] if terrain.rgb is None else [terrain.rgb])
        known = raster.mean(terrain.xyz, np.concatenate(columns, axis=1))
        has = np.isfinite(known[..., 0])
        if street:
            wanted = gaps(has, stood(inputs, raster, terrain.frame), raster.cell, params.gap)
        else:
            cover = np.any([closed(raster.covered(cloud.xyz), COVER) for cloud in above], axis=0)
            wanted = ndimage.binary_fill_holes(closed(has | cover, params.reach / raster.cell))
        report(0.3, "membrane")
        field = membrane(known, np.asarray(wanted))
        new = np.isfinite(field[..., 0]) & ~grown(has, 1.5)
        if params.seed is not None:
            new[new] = near_cell(raster.centres(new), params, terrain)
        xyz = on_grid(np.column_stack([raster.centres(new), field[new][:, 0]])).astype(np.float32)
        slope = np.gradient(np.where(np.isfinite(field[..., 0]), field[..., 0], np.nanmean(field[..., 0])), raster.cell)
        normal = np.column_stack([-slope[1][new], -slope[0][new], np.ones(len(xyz))])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        rgb = None if terrain.rgb is None else np.rint(field[new][:, 1:]).clip(0, 255).astype(np.uint8)
        if rgb is not None and street:
            rgb[:] = UNCOLOURED
        classification = np.full(len(xyz), CODE["terrain"], np.uint8)
        made = PointCloud(terrain.frame, xyz, rgb, normal.astype(np.float32), classification)
        area = len(xyz) * raster.cell**2
    made.save(out / "made.npz")
    return Done({"made": out / "made.npz"}, {"from_above": active, "points": len(made), "made_up_m2": round(area, 1)})


def gaps(has: Bools, stood: Bools, cell: float, gap: float) -> Bools:
    """What of a street's ground is to be there: what is, its gaps, its small holes, and where something stood.

    Args:
        has: (rows, columns) where there are points of it.
        stood: (rows, columns) where things stood that were taken out.
        cell: metres.
        gap: metres; half the width that gaps may have.
    """
    from scipy import ndimage

    from scan2sim.pipeline.geometry.height_map import closed

    whole = closed(has, gap / cell) | stood
    holes, count = ndimage.label(ndimage.binary_fill_holes(whole) & ~whole)
    small = np.bincount(holes.ravel(), minlength=count + 1) * cell**2 <= HOLE
    small[0] = False
    return np.asarray(whole | small[holes], bool)


def stood(inputs: Inputs, raster: Raster, frame: Frame) -> Bools:
    """The cells of a raster on which vehicles stood that were taken out, and a little around them.

    They are of `things`, and of the neighbours' `things.NAME`.
    """
    from scan2sim.pipeline.dynamic_objects.vehicle_residue import outlines
    from scan2sim.pipeline.geometry.height_map import drawn, grown

    listed = [path for name, path in sorted(inputs.items()) if name.partition(".")[0] == "things"]
    rings = [ring / raster.cell - raster.low for path in listed for ring in outlines(path, frame)]
    return np.asarray(grown(drawn(rings, raster.shape), BESIDE / raster.cell), bool)


def from_above(building: PointCloud) -> bool:
    """Whether a scanner saw more of the buildings' roofs than of their walls; so it is without buildings, too."""
    assert building.normal is not None
    return len(building) == 0 or float(np.mean(np.abs(building.normal[:, 2]) > FLAT)) >= 0.5


def near_cell(xy: object, params: MadeUpParams, cloud: PointCloud) -> object:
    """(N,) which local places (N, 2) lie in the tile's cell or within its buffer."""
    assert params.seed is not None
    world = np.asarray(xy) + np.asarray(cloud.frame.origin[:2])
    return Cell(params.seed, params.neighbours).outside(world) <= params.buffer


def united(inputs: Inputs, params: MadeUpParams, part: str) -> PointCloud:
    """The cloud `part` with what the neighbours' clouds `part.NAME` have where they own it, in the tile's own frame."""
    from scan2sim.pipeline.tiling.borders.grid import on_grid

    own = PointCloud.load(inputs[part])
    given = sorted(name for name in params.neighbours if f"{part}.{name}" in inputs)
    if params.seed is None or not given:
        return own
    seeds = dict(sorted({params.name: params.seed, **{name: params.neighbours[name] for name in given}}.items()))
    parts = []
    for i, name in enumerate(seeds):  # by name, in every tile alike
        cloud = own if name == params.name else PointCloud.load(inputs[f"{part}.{name}"])
        world = on_grid(cloud.xyz + np.asarray(cloud.frame.origin))
        mine = nearest(world[:, :2], list(seeds.values())) == i
        xyz = (world - np.asarray(own.frame.origin)).astype(np.float32)
        parts.append(replace(cloud, frame=own.frame, xyz=xyz).take(mine))
    return PointCloud.join(parts)


GROUND = Step("ground", 2, ground, GroundParams)
