"""Map of the driver page: lines of a world's roads from above, in metres of the world."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import FastAPI

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Frame, Trajectory
from scan2sim.pipeline.io.worlds.scene import EXPORT_AGAIN, PATH_FILE, SceneTile, read_scene
from scan2sim.pipeline.roads import driven

ROAD_LINES_FILE = "roads.geojson"
"""Lines of a tile's roads (`pipeline.io.geodata.road_geojson`)."""
ROAD_LINE_KINDS = ("edge", "marking")
STRIDE = 2
"""Every second point of a line is kept: they are a metre apart."""


@dataclass(frozen=True)
class MapLine:
    """A line of the map.

    Attributes:
        kind: "edge" or "marking" of a road; "path" of the recording device, in tiles without roads.
        points: x and y of its points, metres of the world.
    """

    kind: str
    points: tuple[tuple[float, float], ...]


def read(world: Path) -> tuple[MapLine, ...]:
    """Map of a finished world; empty if it has neither roads nor a path.

    Raises:
        InputError: it is no finished world, or a file in it is damaged.
    """
    scene = read_scene(world)
    return tuple(line for tile in scene.tiles for line in _road_lines(tile, scene.frame) or _paths(tile))


def add_route(app: FastAPI, lines: Sequence[MapLine]) -> None:
    """Serve a map at `/api/map`."""
    content = {"lines": [asdict(line) for line in lines]}

    @app.get("/api/map")
    def road_map() -> dict[str, Any]:
        """Lines of the world's roads: `kind` and `points`, metres of the world; empty without a world."""
        return content


def _road_lines(tile: SceneTile, frame: Frame) -> list[MapLine]:
    path = tile.folder / ROAD_LINES_FILE
    if not path.is_file():
        return []
    try:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        found = [(str(one["properties"]["kind"]), one["geometry"]["coordinates"]) for one in features]
        return [_line(kind, frame.to_local(places)[:, :2]) for kind, places in found if kind in ROAD_LINE_KINDS]
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(path, f"not a list of road lines ({error!s:.100})", EXPORT_AGAIN) from None


def _paths(tile: SceneTile) -> list[MapLine]:
    path = tile.folder / PATH_FILE
    if not path.is_file():
        return []
    places = Trajectory.load(path).positions + np.asarray(tile.offset)
    return [_line("path", way) for way in driven.ways(places, np.ones(len(places), bool))]


def _line(kind: str, places: F64) -> MapLine:
    """A line through places (N, 2).

    Raises:
        ValueError: a coordinate isn't finite.
    """
    if not np.isfinite(places).all():
        raise ValueError("a coordinate isn't finite")
    kept = np.concatenate([places[:-1:STRIDE], places[-1:]])
    return MapLine(kind, tuple((round(x, 2), round(y, 2)) for x, y in kept.tolist()))
