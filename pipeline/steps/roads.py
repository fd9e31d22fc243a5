"""Roads: reference lines, painted lines and kerbs, as data (docs/roads.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.parameters import Coordinate, Name, Place
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Bools, Frame, PointCloud, Trajectory
from scan2sim.pipeline.tiling.voronoi_cell import Cell

DRIVEN_ON = ("road", "bridge_deck")
UNDER = 3.0
"""Metres from the path within which there are points of a road that it was driven on."""


class RoadsParams(Params):
    """Whether roads are told of.

    Attributes:
        when: "auto": where the tile has a scanner's path, or photos from the ground; "never".
        name: of the tile; set by the recipe.
        world_origin: metres in the CRS, of the OpenDRIVE file; default: the tile's own origin; set by the recipe
            (`export.world_origin`).
        seed: the tile's (x, y), world metres, where it meets others: what is beyond its cell is theirs; set by the
            recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
    """

    when: Literal["auto", "never"] = "auto"
    name: Name = "tile"
    world_origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def roads(inputs: Inputs, params: RoadsParams, out: Path, report: Report) -> Done:
    """Tell of the roads that `path` was driven on, by the classified points of the ground (`cloud`) and its texture.

    Files: `geojson`, lines of the roads; `seen`, .npz of what was seen of paint, edges and heights, world metres, of
    which OpenDRIVE is drawn, one road over all tiles of a survey; `opendrive`, a folder with `<name>.xodr`, empty where
    no road has lanes.
    """
    from scan2sim.pipeline.camera import renderer as render
    from scan2sim.pipeline.io.geodata import opendrive
    from scan2sim.pipeline.roads import driven, listed, model, observed

    cloud, path = PointCloud.load(inputs["cloud"]), Trajectory.load(inputs["path"])
    assert cloud.classification is not None
    xyz = cloud.xyz.astype(np.float64)
    own, origin = _own(params), np.asarray(cloud.frame.origin)
    on = np.isin(cloud.classification, [CODE[name] for name in DRIVEN_ON])
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
    drawn = [road for one in seen if (road := model.drawn(one, warnings.append))]
    listed.write(out / "roads.geojson", cloud.frame, drawn)
    observed.save(out / "seen.npz", seen, cloud.frame)
    (out / "opendrive").mkdir()
    world = Frame(cloud.frame.crs, params.world_origin or cloud.frame.origin, cloud.frame.unit)
    network = model.network([one.moved(origin) for one in seen], world.origin)
    opendrive.write(out / "opendrive" / f"{params.name}.xodr", params.name, world, network)
    facts = {"points": int(on.sum()), "driven": len(ways), "roads": [listed.facts(road) for road in drawn]}
    files = {"geojson": out / "roads.geojson", "seen": out / "seen.npz", "opendrive": out / "opendrive"}
    return Done(files, facts | _why_none(ways, on, [*drawn, *warnings]), warnings)


def _own(params: RoadsParams) -> Callable[[F64], Bools]:
    """Which world places (N, 3) are the tile's own."""

    def own(places: F64) -> Bools:
        if params.seed is None:
            return np.ones(len(places), bool)
        return np.asarray(Cell(params.seed, params.neighbours).outside(places[:, :2]) <= 0)

    return own


def _over(positions: F64, road: F64) -> Bools:
    """(N,) positions below which there are points of a road."""
    from scipy.spatial import cKDTree

    if not len(road) or not len(positions):
        return np.zeros(len(positions), bool)
    return np.asarray(cKDTree(road[:, :2]).query(positions[:, :2])[0] < UNDER)


def _why_none(ways: Sequence[F64], on: Bools, drawn: Sequence[object]) -> dict[str, str]:
    """Why no road is told of."""
    if drawn:
        return {}
    if not on.any():
        return {"none": "no point is of a road's class"}
    return {"none": "no line of a road is seen" if ways else "the path runs on no road"}


ROADS = Step("roads", 3, roads, RoadsParams, side_product=True)
