"""Roads: reference lines, lane markings and kerbs as vector data (docs/roads.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.parameters import Coordinate, Name
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F64, Bools, Frame, PointCloud, Trajectory
from scan2sim.pipeline.simulation import ground_origin

ROAD_CLASSES = ("road", "bridge_deck")
MAX_ROAD_DISTANCE_M = 3.0
"""Largest distance in plan of road points from a path that was driven on a road."""


class RoadsContext(Context):
    """The tile.

    Attributes:
        name: name of the tile.
        world_origin: origin of the OpenDRIVE file in the CRS, metres (`export.world_origin`); None: that of the input
            `origin`, or else the tile's own.
        cell: the tile's cell, if it has neighbours; observations outside it belong to them.
    """

    name: Name = "tile"
    world_origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    cell: TileCell | None = None


class RoadsParams(Params):
    """Extraction of roads.

    Attributes:
        when: "auto": if the tile has a scanner's path, or photos from the ground; "never".
    """

    when: Literal["auto", "never"] = "auto"
    context: RoadsContext = RoadsContext()


def roads(inputs: Inputs, params: RoadsParams, out: Path, report: Report) -> Done:
    """Extract the roads along the driven `path` from the classified ground points (`cloud`) and the ground's texture.

    Files: `geojson`, lines of the roads; `seen`, .npz of the observations (paint, edges, heights) in world metres, from
    which the OpenDRIVE roads of a whole survey are built; `opendrive`, a folder with `<name>.xodr`, empty if no road
    has lanes.
    """
    from scan2sim.pipeline.camera import renderer as render
    from scan2sim.pipeline.io.geodata import opendrive, road_geojson
    from scan2sim.pipeline.roads import driven, model, observed

    cloud, path = PointCloud.load(inputs["cloud"]), Trajectory.load(inputs["path"])
    assert cloud.classification is not None
    xyz = cloud.xyz.astype(np.float64)
    own, origin = _own(params.context.cell), np.asarray(cloud.frame.origin)
    on = np.isin(cloud.classification, [CODE[name] for name in ROAD_CLASSES])
    ways = driven.ways(path.positions, _over(path.positions, xyz[on]) & own(path.positions + origin))
    renderer = None
    if (inputs["textured"] / "mesh.npz").is_file():
        body = render.textured(inputs["textured"])
        renderer = render.Renderer([body]) if body.pages and len(body.mesh) else None
    seen = []
    for i, way in enumerate(ways):
        report(i / len(ways), f"road {i + 1} of {len(ways)}")
        one = observed.observe(way, xyz, on, renderer)
        parts = (np.column_stack([part[:, :2], np.zeros(len(part))]) for part in (one.paint, one.edge, one.ground))
        seen.append(one.kept(*(own(part + origin) for part in parts)))
    warnings: list[str] = []
    drawn = [road for one in seen if (road := model.build_road(one, warnings.append))]
    road_geojson.write(out / "roads.geojson", cloud.frame, drawn)
    observed.save(out / "seen.npz", seen, cloud.frame)
    (out / "opendrive").mkdir()
    origin_of_world = params.context.world_origin or ground_origin.read(inputs) or cloud.frame.origin
    world = Frame(cloud.frame.crs, origin_of_world, cloud.frame.unit)
    network = model.network([one.moved(origin) for one in seen], world.origin)
    opendrive.write(out / "opendrive" / f"{params.context.name}.xodr", params.context.name, world, network)
    metrics = {"points": int(on.sum()), "driven": len(ways), "roads": [road_geojson.facts(road) for road in drawn]}
    files = {"geojson": out / "roads.geojson", "seen": out / "seen.npz", "opendrive": out / "opendrive"}
    return Done(files, metrics | _why_none(ways, on, [*drawn, *warnings]), warnings)


def _own(tile: TileCell | None) -> Callable[[F64], Bools]:
    """Function that selects world positions (N, 3) inside the tile's cell."""

    def own(places: F64) -> Bools:
        if tile is None:
            return np.ones(len(places), bool)
        return np.asarray(tile.cell.outside(places[:, :2]) <= 0)

    return own


def _over(positions: F64, road: F64) -> Bools:
    """(N,) bool, True for positions above points of a road."""
    from scipy.spatial import cKDTree

    if not len(road) or not len(positions):
        return np.zeros(len(positions), bool)
    return np.asarray(cKDTree(road[:, :2]).query(positions[:, :2])[0] < MAX_ROAD_DISTANCE_M)


def _why_none(ways: Sequence[F64], on: Bools, drawn: Sequence[object]) -> dict[str, str]:
    """Reason why no road was extracted; empty if one was."""
    if drawn:
        return {}
    if not on.any():
        return {"none": "no point has a road class"}
    return {"none": "no road line was detected" if ways else "the path is not on a road"}


ROADS = Step("roads", 3, roads, RoadsParams)
