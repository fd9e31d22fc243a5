"""Walls: raised from roofs' edges down to what is below, where an airborne scanner saw none."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import F32, F64, PointCloud
from scan2sim.pipeline.steps.ground import FLAT, MadeUpParams, from_above, near_cell, united

if TYPE_CHECKING:
    from scan2sim.pipeline.buildings.roof_outlines import Places
    from scan2sim.pipeline.geometry.height_map import Raster

DENSE = 0.2  # metres between points of a wall
SUNK = 0.3  # metres that walls reach into the ground
OUTSIDE = (1.5, 2.5, 3.5)  # cells beyond a roof's side where another roof is looked for, the nearest first
SEEN = 1.5  # times DENSE: a wall's own points are this close
BESIDE = 1.5  # metres from a footprint within which a roof's own outline isn't used
LIGHT = (0.83, 0.55, 0.0)
PLASTER = (196, 190, 180)  # a wall of whose colour nothing is known


class WallsParams(MadeUpParams):
    """Which walls are made up; the rest as of the ground.

    Attributes:
        least_height: metres of a wall, lower steps are left open.
        least_area: m2 of a roof, smaller ones (chimneys) are of the roof around them.
        step: metres in height between neighbouring places from which on they are of two roofs.
        tolerance: metres by which a straight side may miss the roof's outline (at least a cell of the points' spacing).
    """

    least_height: float = Field(0.5, ge=0.01, le=100)
    least_area: float = Field(4.0, ge=0.01, le=10_000)
    step: float = Field(1.0, ge=0.01, le=100)
    tolerance: float = Field(0.5, ge=0.01, le=10)


def walls(inputs: Inputs, params: WallsParams, out: Path, report: Report) -> Done:
    """Make up points of walls below the edges of roofs in `building`, down to lower roofs or the ground.

    Roofs are told by their heights, their outlines straightened; given `footprints` (GeoJSON or GeoPackage) take an
    outline's place. Where the wall has points of its own, none are made up. The ground is `terrain` with what was made
    up of it (`ground`); neighbours' clouds (`building.NAME` and so on) are looked at as by the step `ground`.
    File: `made`, a `PointCloud` with normals.
    """
    from scan2sim.pipeline.buildings.roof_outlines import Places, rings, roofs
    from scan2sim.pipeline.geometry.height_map import Raster, spacing

    building = united(inputs, params, "building")
    floor = united(inputs, params, "terrain").xyz
    if "ground" in inputs:
        floor = np.concatenate([floor, PointCloud.load(inputs["ground"]).xyz])
    made = PointCloud(building.frame, np.zeros((0, 3), np.float32), normal=np.zeros((0, 3), np.float32))
    active = params.when == "always" or from_above(building)
    facts = {"from_above": active, "roofs": 0, "sides": 0, "footprints": 0, "points": 0, "made_up_m2": 0.0}
    if active and len(building) and len(floor):
        assert building.normal is not None
        flat = building.xyz[np.abs(building.normal[:, 2]) > FLAT]
        raster = Raster.over(spacing(flat), [building.xyz])
        top = raster.highest(flat)
        component = roofs(top, raster.cell, max(params.step, 1.5 * raster.cell), params.least_area)
        report(0.2, f"{component.max()} roofs")
        tolerance = max(params.tolerance, raster.cell)
        heights = Heights(raster, top, component, floor)
        parts: list[tuple[F64, F64]] = []
        given = _given(inputs, building)
        if given:
            places = Places.along(given, DENSE)
            parts.append(heights.columns(places, 0, params.least_height))
        count = 0
        for k in range(1, int(component.max()) + 1):
            report(0.2 + 0.6 * k / component.max(), f"roof {k} of {component.max()}")
            found = rings(component == k, raster, tolerance, params.least_area)
            places = Places.along(found, DENSE)
            if given:
                places = _apart(places, Places.along(given, DENSE).xy)
            count += sum(map(len, found))
            parts.append(heights.columns(places, k, params.least_height))
        xyz = np.concatenate([np.zeros((0, 3)), *(part[0] for part in parts)])
        normal = np.concatenate([np.zeros((0, 3)), *(part[1] for part in parts)])
        made = _cloud(xyz, normal, building, params)
        facts |= {"roofs": int(component.max()), "sides": count, "footprints": len(given)}
        facts |= {"points": len(made), "made_up_m2": round(len(made) * DENSE**2, 1)}
    made.save(out / "made.npz")
    return Done({"made": out / "made.npz"}, facts)


class Heights:
    """What is at the top and at the bottom of a wall.

    Args:
        raster, top: heights of the roofs' points.
        component: which roof a cell belongs to.
        floor: (N, 3) points of the ground.
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

    def columns(self, places: Places, roof: int, least: float) -> tuple[F64, F64]:
        """Points (N, 3) of the walls at `places`, and their normals: below roof number `roof`, 0: below any."""
        from scipy import ndimage
        from scipy.spatial import cKDTree

        none = np.zeros((0, 3))
        mine = np.flatnonzero(self._of == roof) if roof else np.arange(len(self._of))
        if not len(places) or not len(mine):
            return none, none
        cell = self._raster.cell
        tree = cKDTree(self._places[mine])
        _, index = tree.query(places.xy - places.outward * cell, distance_upper_bound=4 * cell + 1.0)
        high = np.append(self._height[mine], np.nan)[index]
        low = self._floor_z[self._floor.query(places.xy + places.outward * OUTSIDE[0] * cell)[1]] - SUNK
        for reach in OUTSIDE[::-1] if roof else ():
            out = places.xy + places.outward * reach * cell
            other = self._component[self._raster.at(out)]
            beside = self._height[self._roof.query(out)[1]] - DENSE
            low = np.where((other > 0) & (other != roof), beside, low)
        for side in np.unique(places.side):
            at = places.side == side
            if at.sum() > 4 and np.isfinite(high[at]).all():
                high[at] = ndimage.median_filter(high[at], size=5, mode="nearest")
        rises = np.flatnonzero(np.isfinite(high) & (high - low >= least + SUNK))
        count = np.ceil((high[rises] - low[rises]) / DENSE).astype(np.int64)
        which = np.repeat(rises, count)
        level = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        share = (level + 0.5) / np.repeat(count, count)
        z = low[which] + share * (high - low)[which]
        normal = np.column_stack([places.outward[which], np.zeros(len(which))])
        return np.column_stack([places.xy[which], z]), normal


def _given(inputs: Inputs, building: PointCloud) -> list[F64]:
    """Rings of the footprints, local metres."""
    if "footprints" not in inputs:
        return []
    from scan2sim.pipeline.io.geodata import footprints

    return footprints.read(inputs["footprints"], building.frame)


def _apart(places: Places, given: F64) -> Places:
    """The places that no given footprint is beside."""
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.buildings.roof_outlines import Places

    far = ~np.isfinite(cKDTree(given).query(places.xy, distance_upper_bound=BESIDE)[0])
    return Places(places.xy[far], places.outward[far], places.side[far])


def _cloud(xyz: F64, normal: F64, building: PointCloud, params: WallsParams) -> PointCloud:
    """The made-up points that no real one of the building is near to, and that are the tile's."""
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.tiling.borders.grid import on_grid

    keep = ~np.isfinite(cKDTree(building.xyz).query(xyz, distance_upper_bound=SEEN * DENSE)[0])
    if params.seed is not None:
        keep &= np.asarray(near_cell(xyz[:, :2], params, building))
    xyz, normal = on_grid(xyz[keep]), normal[keep]
    light = 0.8 + 0.2 * np.clip(normal @ LIGHT, 0, 1)  # so that corners are seen
    rgb = None if building.rgb is None else (light[:, None] * _colour(building)).astype(np.uint8)
    classification = np.full(len(xyz), CODE["building"], np.uint8)
    return PointCloud(building.frame, xyz.astype(np.float32), rgb, normal.astype(np.float32), classification)


def _colour(building: PointCloud) -> F64:
    """(3,) of the walls' own points, where there are some, else a plaster's."""
    assert building.normal is not None and building.rgb is not None
    steep = np.abs(building.normal[:, 2]) < 0.3
    return np.median(building.rgb[steep], axis=0) if steep.sum() >= 100 else np.array(PLASTER, np.float64)


WALLS = Step("walls", 1, walls, WallsParams)
