"""GeoJSON writer: points, lines and polygons with properties, in a tile's CRS."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

Position = Sequence[float]
Feature = tuple[str, Any, Mapping[str, Any]]
"""Type of geometry, its coordinates in the file's CRS, and properties."""


def write_points(path: Path, crs: str, features: Sequence[tuple[Position, Mapping[str, Any]]]) -> None:
    """Write points; a feature is its (x, y, z) in `crs` and its properties."""
    write(path, crs, [("Point", list(position), properties) for position, properties in features])


def write_lines(path: Path, crs: str, features: Sequence[tuple[Sequence[Position], Mapping[str, Any]]]) -> None:
    """Write lines; a feature is its positions along the line in `crs` and its properties."""
    lines = [("LineString", [list(position) for position in line], properties) for line, properties in features]
    write(path, crs, lines)


def write_polygons(path: Path, crs: str, features: Sequence[tuple[Sequence[Position], Mapping[str, Any]]]) -> None:
    """Write polygons; a feature is a closed ring of positions in `crs` (the first repeated last) and its properties."""
    polygons = [("Polygon", [[list(position) for position in ring]], properties) for ring, properties in features]
    write(path, crs, polygons)


def write(path: Path, crs: str, features: Sequence[Feature]) -> None:
    """Write features of any types."""
    body = {
        "type": "FeatureCollection",
        "crs": crs_member(crs),
        "features": [
            {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": dict(properties)}
            for kind, coordinates, properties in features
        ],
    }
    path.write_text(json.dumps({k: v for k, v in body.items() if v is not None}, indent=1), encoding="utf-8")


def crs_member(crs: str) -> dict[str, object] | None:
    """The `crs` member (GeoJSON before RFC 7946) that GIS programs understand; None for a CRS without EPSG code."""
    if crs == "local":
        return None
    from pyproj import CRS

    code = CRS.from_user_input(crs).to_epsg()
    return {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{code}"}} if code else None
