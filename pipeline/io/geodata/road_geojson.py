"""Roads as GeoJSON: lines with heights in a tile's CRS, and their properties."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io.geodata import geojson
from scan2sim.pipeline.roads.lanes import sections
from scan2sim.pipeline.roads.model import Line, Road, surface
from scan2sim.pipeline.roads.profile import Profile

STEP_M = 1.0
"""Spacing of the points of a line."""


def write(path: Path, frame: Frame, roads: Sequence[Road]) -> None:
    """Write reference lines, markings and edges; a feature for each part of a line that was observed."""
    features: list[tuple[list[list[float]], dict[str, Any]]] = []
    for number, road in enumerate(roads, start=1):
        zero = Profile.constant(road.height.knots, 0.0)
        about = {"kind": "reference", "reference": road.reference, "length_m": round(road.line.length, 2)}
        features.append(
            (_line(frame, road, zero, 0.0, road.line.length), {"road": number, **about, "notes": notes(road)})
        )
        for line in (road.left, *road.markings, road.right):
            for first, last in line.ranges if line else ():
                assert line is not None
                features.append((_line(frame, road, line.offset, first, last), {"road": number, **_properties(line)}))
    geojson.write_lines(path, frame.crs, features)


def _line(frame: Frame, road: Road, offset: Profile, first: float, last: float) -> list[list[float]]:
    s = np.linspace(first, last, max(2, round((last - first) / STEP_M) + 1))
    return [[round(value, 3) for value in place] for place in frame.to_crs(surface(road, s, offset.at(s))).tolist()]


def _properties(line: Line) -> dict[str, Any]:
    """Properties of a line."""
    if line.kind == "marking":
        about = {"kind": "marking", "marking": line.marking, "paint_width_m": line.width}
        if line.dash is not None:
            about |= {"dash_m": line.dash, "gap_m": line.gap}
    else:
        about = {"kind": "edge", "side": line.kind, "border": "other ground" if line.kerb is None else "kerb"}
        if line.kerb is not None:
            about["kerb_m"] = round(line.kerb, 3)
    return {**about, "deviation_p95_m": round(line.deviation, 3)}


def notes(road: Road) -> list[str]:
    """Notes on missing information about a road."""
    found = []
    if not road.markings:
        found.append("no painted line is seen: only its edges are extracted, no lanes")
    elif road.reference != "marking":
        found.append("no painted line is in its middle: the direction of its lanes is unknown")
    for line, side in ((road.left, "left"), (road.right, "right")):
        if line is None:
            found.append(
                f"its {side} edge isn't detected: nothing steps up, and no other ground begins, along one line"
            )
            continue
        gaps = [(a, b) for (_, a), (b, _) in zip(line.ranges, line.ranges[1:], strict=False)]
        if gaps:
            where = ", ".join(f"{a:.0f} to {b:.0f} m" for a, b in gaps)
            found.append(f"its {side} edge isn't detected from {where}: hidden, or other roads and drives begin there")
    if not sections(road):
        found.append("it has no two lines beside each other, and so no lanes in OpenDRIVE")
    return found


def facts(road: Road) -> dict[str, Any]:
    """Metrics of a road for the report."""
    found: dict[str, Any] = {"length_m": round(road.line.length, 1), "reference": road.reference}
    if road.left and road.right:
        s = np.arange(0.5, road.line.length, STEP_M)
        found["width_m"] = round(float(np.median(road.left.offset.at(s) - road.right.offset.at(s))), 2)
    lines = [line for line in (road.left, *road.markings, road.right) if line]
    found["markings"] = len(road.markings)
    found["kerbs"] = sum(line.kerb is not None for line in lines)
    found["deviation_p95_m"] = round(max(line.deviation for line in lines), 3)
    return found | {"notes": notes(road)}
