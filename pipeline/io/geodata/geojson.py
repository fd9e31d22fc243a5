"""GeoJSON: points, lines and polygons with properties, in a tile's CRS."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

Place = Sequence[float]


def write_points(path: Path, crs: str, features: Sequence[tuple[Place, Mapping[str, Any]]]) -> None:
    """Write features, each its (x, y, z) in `crs` and its properties."""
    _write(path, crs, [("Point", list(place), properties) for place, properties in features])


def write_lines(path: Path, crs: str, features: Sequence[tuple[Sequence[Place], Mapping[str, Any]]]) -> None:
    """Write features, each its places along the line in `crs` and its properties."""
    _write(path, crs, [("LineString", [list(place) for place in line], properties) for line, properties in features])


def write_polygons(path: Path, crs: str, features: Sequence[tuple[Sequence[Place], Mapping[str, Any]]]) -> None:
    """Write features, each its ring of places in `crs`, the first again at the end, and its properties."""
    _write(path, crs, [("Polygon", [[list(place) for place in ring]], properties) for ring, properties in features])


def _write(path: Path, crs: str, features: Sequence[tuple[str, Any, Mapping[str, Any]]]) -> None:
    body = {
        "type": "FeatureCollection",
        "crs": member(crs),
        "features": [
            {"type": "Feature", "geometry": {"type": kind, "coordinates": places}, "properties": dict(properties)}
            for kind, places, properties in features
        ],
    }
    path.write_text(json.dumps({k: v for k, v in body.items() if v is not None}, indent=1), encoding="utf-8")


def member(crs: str) -> dict[str, object] | None:
    """The (pre-RFC 7946) member by which GIS programs know a GeoJSON file's CRS; None: they know none."""
    if crs == "local":
        return None
    from pyproj import CRS

    code = CRS.from_user_input(crs).to_epsg()
    return {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{code}"}} if code else None
