"""Wall completion (step `walls`): synthesizes walls below roof edges, which airborne scanners can't see."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import F32, F64, PointCloud
from scan2sim.pipeline.steps.ground import ROOF_MIN_NORMAL_Z, CompletionParams, is_airborne, merge_neighbours, near_cell

if TYPE_CHECKING:
    from scan2sim.pipeline.buildings.roof_outlines import OutlinePoints
    from scan2sim.pipeline.geometry.height_map import Raster

POINT_SPACING_M = 0.2  # of synthesized walls
MIN_HEIGHT_M = 0.5  # of a wall; lower steps are left open
FOUNDATION_M = 0.3  # depth to which walls extend into the ground
NEIGHBOUR_ROOF_CELLS = (1.5, 2.5, 3.5)  # distances from a roof's side at which a lower roof is searched
SCANNED_WALL_SPACINGS = 1.5  # no point is synthesized within this many point spacings of a scanned one
FOOTPRINT_MARGIN_M = 1.5  # within this distance of a footprint, outlines detected from roofs are not used
LIGHT_DIRECTION = (0.83, 0.55, 0.0)
DEFAULT_WALL_RGB = (196, 190, 180)  # if the colour of walls is unknown


class WallsParams(CompletionParams):
    """Which walls are synthesized; other settings as of `ground`.

    Attributes:
        min_area: minimum area of a roof in m2; smaller ones (chimneys) belong to the roof around them.
        step: height difference between neighbouring cells in metres above which they belong to different roofs.
        tolerance: maximum distance in metres between a straight side and the roof's outline (at least one cell of the
            point spacing).
    """

    min_area: float = Field(4.0, ge=0.01, le=10_000)
    step: float = Field(1.0, ge=0.01, le=100)
    tolerance: float = Field(0.5, ge=0.01, le=10)


def walls(inputs: Inputs, params: WallsParams, out: Path, report: Report) -> Done:
    """Synthesize wall points below the roof edges of `building`, down to lower roofs or the ground.

    Roofs are segmented by height, and their outlines straightened; `footprints` (GeoJSON or GeoPackage) replace
    detected outlines. No points are added where the wall was scanned. The ground is `terrain` with its synthesized
    points (`ground`); neighbours' clouds (`building.NAME` and so on) are used as in step `ground`.
    File: `synthesized`, a `PointCloud` with normals.
    """
    from scan2sim.pipeline.buildings.roof_outlines import OutlinePoints, rings, roofs
    from scan2sim.pipeline.geometry.height_map import Raster, point_spacing

    building = merge_neighbours(inputs, params.context, "building")
    floor = merge_neighbours(inputs, params.context, "terrain").xyz
    if "ground" in inputs:
        floor = np.concatenate([floor, PointCloud.load(inputs["ground"]).xyz])
    made = PointCloud(building.frame, np.zeros((0, 3), np.float32), normal=np.zeros((0, 3), np.float32))
    active = params.when == "always" or is_airborne(building)
    metrics = {"from_above": active, "roofs": 0, "sides": 0, "footprints": 0, "points": 0, "synthesized_m2": 0.0}
    if active and len(building) and len(floor):
        assert building.normal is not None
        flat = building.xyz[np.abs(building.normal[:, 2]) > ROOF_MIN_NORMAL_Z]
        raster = Raster.over(point_spacing(flat), [building.xyz])
        top = raster.highest(flat)
        component = roofs(top, raster.cell, max(params.step, 1.5 * raster.cell), params.min_area)
        report(0.2, f"{component.max()} roofs")
        tolerance = max(params.tolerance, raster.cell)
        heights = WallHeights(raster, top, component, floor)
        parts: list[tuple[F64, F64]] = []
        given = _footprints(inputs, building)
        if given:
            places = OutlinePoints.along(given, POINT_SPACING_M)
            parts.append(heights.columns(places, 0))
        count = 0
        for k in range(1, int(component.max()) + 1):
            report(0.2 + 0.6 * k / component.max(), f"roof {k} of {component.max()}")
            found = rings(component == k, raster, tolerance, params.min_area)
            places = OutlinePoints.along(found, POINT_SPACING_M)
            if given:
                places = _without_footprint(places, OutlinePoints.along(given, POINT_SPACING_M).xy)
            count += sum(map(len, found))
            parts.append(heights.columns(places, k))
        xyz = np.concatenate([np.zeros((0, 3)), *(part[0] for part in parts)])
        normal = np.concatenate([np.zeros((0, 3)), *(part[1] for part in parts)])
        made = _cloud(xyz, normal, building, params)
        metrics |= {"roofs": int(component.max()), "sides": count, "footprints": len(given)}
        metrics |= {"points": len(made), "synthesized_m2": round(len(made) * POINT_SPACING_M**2, 1)}
    made.save(out / "synthesized.npz")
    return Done({"synthesized": out / "synthesized.npz"}, metrics)


class WallHeights:
    """Heights of the top and the bottom of walls.

    Args:
        raster, top: raster, and heights of the roof points in it.
        component: number of the roof of each cell.
        floor: (N, 3) ground points.
    """

    def __init__(self, raster: Raster, top: F64, component: object, floor: F32) -> None:
        from scipy.spatial import cKDTree

        self._raster, self._component = raster, np.asarray(component)
        self._known = np.isfinite(top) & (self._component > 0)
        cells = np.nonzero(self._known)
        self._of, self._height = self._component[cells], top[cells]
        self._roof = cKDTree(raster.centres(self._known))
        self._places = raster.centres(self._known)
        self._floor, self._floor_z = cKDTree(floor[:, :2]), floor[:, 2].astype(np.float64)

    def columns(self, places: OutlinePoints, roof: int) -> tuple[F64, F64]:
        """Points (N, 3) and normals of the walls at outline points `places`; `roof`: number of the roof, 0: any."""
        from scipy import ndimage
        from scipy.spatial import cKDTree

        none = np.zeros((0, 3))
        members = np.flatnonzero(self._of == roof) if roof else np.arange(len(self._of))
        if not len(places) or not len(members):
            return none, none
        cell = self._raster.cell
        tree = cKDTree(self._places[members])
        _, index = tree.query(places.xy - places.outward * cell, distance_upper_bound=4 * cell + 1.0)
        high = np.append(self._height[members], np.nan)[index]
        low = (
            self._floor_z[self._floor.query(places.xy + places.outward * NEIGHBOUR_ROOF_CELLS[0] * cell)[1]]
            - FOUNDATION_M
        )
        for distance in NEIGHBOUR_ROOF_CELLS[::-1] if roof else ():
            out = places.xy + places.outward * distance * cell
            other = self._component[self._raster.at(out)]
            beside = self._height[self._roof.query(out)[1]] - POINT_SPACING_M
            low = np.where((other > 0) & (other != roof), beside, low)
        for side in np.unique(places.side):
            at = places.side == side
            if at.sum() > 4 and np.isfinite(high[at]).all():
                high[at] = ndimage.median_filter(high[at], size=5, mode="nearest")
        rises = np.flatnonzero(np.isfinite(high) & (high - low >= MIN_HEIGHT_M + FOUNDATION_M))
        count = np.ceil((high[rises] - low[rises]) / POINT_SPACING_M).astype(np.int64)
        which = np.repeat(rises, count)
        level = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        fraction = (level + 0.5) / np.repeat(count, count)
        z = low[which] + fraction * (high - low)[which]
        normal = np.column_stack([places.outward[which], np.zeros(len(which))])
        return np.column_stack([places.xy[which], z]), normal


def _footprints(inputs: Inputs, building: PointCloud) -> list[F64]:
    """Rings of the building footprints, local metres."""
    if "footprints" not in inputs:
        return []
    from scan2sim.pipeline.io.geodata import footprints

    return footprints.read(inputs["footprints"], building.frame)


def _without_footprint(places: OutlinePoints, given: F64) -> OutlinePoints:
    """Outline points that are not near a given footprint."""
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.buildings.roof_outlines import OutlinePoints

    far = ~np.isfinite(cKDTree(given).query(places.xy, distance_upper_bound=FOOTPRINT_MARGIN_M)[0])
    return OutlinePoints(places.xy[far], places.outward[far], places.side[far])


def _cloud(xyz: F64, normal: F64, building: PointCloud, params: WallsParams) -> PointCloud:
    """Synthesized points that are not near a scanned point of the building and belong to the tile."""
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid

    keep = ~np.isfinite(
        cKDTree(building.xyz).query(xyz, distance_upper_bound=SCANNED_WALL_SPACINGS * POINT_SPACING_M)[0]
    )
    if params.context:
        keep &= np.asarray(near_cell(xyz[:, :2], params.context, building))
    xyz, normal = snap_to_grid(xyz[keep]), normal[keep]
    light = 0.8 + 0.2 * np.clip(normal @ LIGHT_DIRECTION, 0, 1)  # shading makes corners visible
    rgb = None if building.rgb is None else (light[:, None] * _colour(building)).astype(np.uint8)
    classification = np.full(len(xyz), CODE["building"], np.uint8)
    return PointCloud(building.frame, xyz.astype(np.float32), rgb, normal.astype(np.float32), classification)


def _colour(building: PointCloud) -> F64:
    """Median colour (3,) of scanned wall points; `DEFAULT_WALL_RGB` if there are too few."""
    assert building.normal is not None and building.rgb is not None
    steep = np.abs(building.normal[:, 2]) < 0.3
    return np.median(building.rgb[steep], axis=0) if steep.sum() >= 100 else np.array(DEFAULT_WALL_RGB, np.float64)


WALLS = Step("walls", 2, walls, WallsParams)
