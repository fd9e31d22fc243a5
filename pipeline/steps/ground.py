"""Ground completion (step `ground`): fills ground under roofs and crowns (airborne scans) and occlusions in streets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import UNCOLOURED, Bools, Frame, PointCloud
from scan2sim.pipeline.core.voronoi_cell import nearest

if TYPE_CHECKING:
    from scan2sim.pipeline.geometry.height_map import Raster

ROOF_MIN_NORMAL_Z = 0.5  # |nz| of a roof
COVER_GAP_CELLS = 3  # largest gap between points of one roof or crown, in cells of the point spacing
COVER_GAP_M = 10.0  # gaps between ground, roofs and crowns narrower than twice this are closed as well
VEHICLE_MARGIN_M = 0.5  # around a vehicle's box, for its shadow in the scan
MAX_HOLE_M2 = 25.0  # larger holes surrounded by ground, such as courtyards, are not closed


class CompletionParams(Params):
    """Completion of surfaces that an airborne scanner can't see.

    Attributes:
        when: "auto": if the tile has neither a scanner's path nor photos with poses, and more points of its buildings
            are on roofs than on walls; "always"; "never".
        context: the tile's cell, if it has neighbours.
    """

    when: Literal["auto", "always", "never"] = "auto"
    context: TileCell | None = None


class GroundParams(CompletionParams):
    """Which holes are closed; other settings as of `walls`, but "auto" also closes the holes of streets.

    Attributes:
        gap: metres; with a scanner's path, gaps in the ground narrower than twice this are closed, as are holes up to
            25 m2 that are surrounded by ground, and the ground under removed vehicles.
    """

    gap: float = Field(1.5, ge=0, le=50)


def ground(inputs: Inputs, params: GroundParams, out: Path, report: Report) -> Done:
    """Synthesize ground points where `terrain` has holes under `building`, `vegetation` or `rest`.

    With `instances` (GeoJSON of removed vehicles), the tile is a street: only gaps (`gap`) and the ground under
    vehicles are filled. Heights and colours are interpolated from the edges of a hole by a membrane (Laplace
    equation); points synthesized in a street have no colour, because the texture is inpainted. If the tile has
    neighbours, their clouds (`terrain.NAME` and so on) are used too: both tiles fill a hole on their border
    identically. File: `synthesized`, a `PointCloud` with normals, as dense as the ground's points.
    """
    from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid
    from scan2sim.pipeline.geometry.height_map import Raster, close_gaps, dilate, fill_membrane, point_spacing

    terrain = merge_neighbours(inputs, params.context, "terrain")
    above = [
        merge_neighbours(inputs, params.context, part) for part in ("building", "vegetation", "rest") if part in inputs
    ]
    street = "instances" in inputs
    active = street or params.when == "always" or is_airborne(above[0])
    made = PointCloud(terrain.frame, np.zeros((0, 3), np.float32), normal=np.zeros((0, 3), np.float32))
    area = 0.0
    if active and len(terrain) and (street or any(map(len, above))):
        from scipy import ndimage

        raster = Raster.over(point_spacing(terrain.xyz), [terrain.xyz, *(cloud.xyz for cloud in above)])
        columns = [terrain.xyz[:, 2:]] + ([] if terrain.rgb is None else [terrain.rgb])
        known = raster.mean(terrain.xyz, np.concatenate(columns, axis=1))
        has = np.isfinite(known[..., 0])
        if street:
            wanted = street_ground(has, vehicle_cells(inputs, raster, terrain.frame), raster.cell, params.gap)
        else:
            cover = np.any([close_gaps(raster.covered(cloud.xyz), COVER_GAP_CELLS) for cloud in above], axis=0)
            wanted = ndimage.binary_fill_holes(close_gaps(has | cover, COVER_GAP_M / raster.cell))
        report(0.3, "membrane")
        field = fill_membrane(known, np.asarray(wanted))
        new = np.isfinite(field[..., 0]) & ~dilate(has, 1.5)
        if params.context:
            new[new] = near_cell(raster.centres(new), params.context, terrain)
        xyz = snap_to_grid(np.column_stack([raster.centres(new), field[new][:, 0]])).astype(np.float32)
        slope = np.gradient(np.where(np.isfinite(field[..., 0]), field[..., 0], np.nanmean(field[..., 0])), raster.cell)
        normal = np.column_stack([-slope[1][new], -slope[0][new], np.ones(len(xyz))])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        rgb = None if terrain.rgb is None else np.rint(field[new][:, 1:]).clip(0, 255).astype(np.uint8)
        if rgb is not None and street:
            rgb[:] = UNCOLOURED
        classification = np.full(len(xyz), CODE["terrain"], np.uint8)
        made = PointCloud(terrain.frame, xyz, rgb, normal.astype(np.float32), classification)
        area = len(xyz) * raster.cell**2
    made.save(out / "synthesized.npz")
    return Done(
        {"synthesized": out / "synthesized.npz"},
        {"from_above": active, "points": len(made), "synthesized_m2": round(area, 1)},
    )


def street_ground(has: Bools, vehicles: Bools, cell: float, gap: float) -> Bools:
    """Cells of a street's ground after completion: scanned cells, gaps, small holes, and cells under vehicles.

    Args:
        has: (rows, columns) cells with ground points.
        vehicles: (rows, columns) cells under removed vehicles.
        cell: cell size, metres.
        gap: half the maximum width of gaps, metres.
    """
    from scipy import ndimage

    from scan2sim.pipeline.geometry.height_map import close_gaps

    whole = close_gaps(has, gap / cell) | vehicles
    holes, count = ndimage.label(ndimage.binary_fill_holes(whole) & ~whole)
    small = np.bincount(holes.ravel(), minlength=count + 1) * cell**2 <= MAX_HOLE_M2
    small[0] = False
    return np.asarray(whole | small[holes], bool)


def vehicle_cells(inputs: Inputs, raster: Raster, frame: Frame) -> Bools:
    """Raster cells under removed vehicles with a margin, from `instances` and the neighbours' `instances.NAME`."""
    from scan2sim.pipeline.dynamic_objects.vehicle_residue import parked_vehicle_outlines
    from scan2sim.pipeline.geometry.height_map import dilate, rasterize_polygons

    listed = [path for name, path in sorted(inputs.items()) if name.partition(".")[0] == "instances"]
    rings = [ring / raster.cell - raster.low for path in listed for ring in parked_vehicle_outlines(path, frame)]
    return np.asarray(dilate(rasterize_polygons(rings, raster.shape), VEHICLE_MARGIN_M / raster.cell), bool)


def is_airborne(building: PointCloud) -> bool:
    """Whether the scan is airborne: more points on roofs than on walls; also True without buildings."""
    assert building.normal is not None
    return len(building) == 0 or float(np.mean(np.abs(building.normal[:, 2]) > ROOF_MIN_NORMAL_Z)) >= 0.5


def near_cell(xy: object, tile: TileCell, cloud: PointCloud) -> object:
    """(N,) bool, True for local points (N, 2) in the tile's cell or within its buffer."""
    world = np.asarray(xy) + np.asarray(cloud.frame.origin[:2])
    return tile.cell.outside(world) <= tile.buffer


def merge_neighbours(inputs: Inputs, tile: TileCell | None, part: str) -> PointCloud:
    """The cloud `part` merged with the neighbours' clouds `part.NAME` inside their own cells, in the tile's frame."""
    from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid

    own = PointCloud.load(inputs[part])
    given = sorted(name for name in (tile.neighbours if tile else ()) if f"{part}.{name}" in inputs)
    if tile is None or not given:
        return own
    seeds = dict(sorted({tile.name: tile.seed, **{name: tile.neighbours[name] for name in given}}.items()))
    parts = []
    for i, name in enumerate(seeds):  # in order of names, which is the same in every tile
        cloud = own if name == tile.name else PointCloud.load(inputs[f"{part}.{name}"])
        world = snap_to_grid(cloud.xyz + np.asarray(cloud.frame.origin))
        mine = nearest(world[:, :2], list(seeds.values())) == i
        xyz = (world - np.asarray(own.frame.origin)).astype(np.float32)
        parts.append(replace(cloud, frame=own.frame, xyz=xyz).take(mine))
    return PointCloud.join(parts)


GROUND = Step("ground", 2, ground, GroundParams)
