"""Building footprints: polygons of a GeoJSON or GeoPackage (OGC 12-128r19), read with Python's standard library."""

from __future__ import annotations

import json
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Frame
from scan2sim.pipeline.geometry.height_map import signed_area
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.geodata.crs import LOCAL

WGS84 = "OGC:CRS84"
SUFFIXES = (".geojson", ".json", ".gpkg")
MAX_ROWS = 1_000_000  # of a table; a view could return rows endlessly
ENVELOPE_BYTES = (0, 32, 48, 48, 64)  # by the envelope flag of a GeoPackage geometry
WKB_POLYGON, WKB_MULTIPOLYGON = 3, 6
UNREADABLE = (
    OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError, struct.error,
    sqlite3.Error,
)  # fmt: skip

Ring = F64


def read(path: Path, frame: Frame) -> list[F64]:
    """Rings (K, 2) of building footprints in the frame's local metres, with the interior to the left.

    Geometries other than polygons are skipped. GeoJSON without a `crs` member is assumed to be in WGS 84, as RFC 7946
    requires, or in the tile's CRS if its coordinates can't be degrees.

    Raises:
        InputError: unreadable, no polygon in it, or its CRS can't be transformed to the tile's.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(path, "is not GeoJSON or a GeoPackage", f"Footprints are {', '.join(SUFFIXES)} files")
    file_checks.check(path, "Check the path, or leave the footprints out")
    try:
        found = list(_geopackage(path) if path.suffix.lower() == ".gpkg" else _geojson(path))
    except UNREADABLE as error:
        raise InputError(path, f"can't be read as footprints ({error})", "Export it again") from None
    rings = []
    for crs, polygon in found:
        for hole, xy in enumerate(polygon):
            if xy.ndim != 2 or len(xy) < 4 or xy.shape[1] < 2 or not np.isfinite(xy).all():
                continue
            local = _local(path, xy[:-1, :2], crs, frame)
            rings.append(local if (signed_area(local) > 0) == (hole == 0) else local[::-1])
    if not rings:
        raise InputError(path, "contains no polygon", "Footprints are polygons, one per building")
    return rings


def _geojson(path: Path) -> Iterator[tuple[str | None, list[Ring]]]:
    """CRS (None: not given) and rings of each polygon."""
    body = json.loads(path.read_text(encoding="utf-8-sig"))
    crs = ((body.get("crs") or {}).get("properties") or {}).get("name")
    for geometry in _geometries(body):
        if geometry["type"] == "Polygon":
            yield crs, [np.asarray(ring, np.float64) for ring in geometry["coordinates"]]
        elif geometry["type"] == "MultiPolygon":
            for polygon in geometry["coordinates"]:
                yield crs, [np.asarray(ring, np.float64) for ring in polygon]


def _geometries(body: Any) -> Iterator[Any]:
    if body is None:
        return
    inner = {"FeatureCollection": "features", "GeometryCollection": "geometries"}.get(body["type"])
    if inner:
        for part in body[inner]:
            yield from _geometries(part)
    elif body["type"] == "Feature":
        yield from _geometries(body["geometry"])
    else:
        yield body


def _geopackage(path: Path) -> Iterator[tuple[str | None, list[Ring]]]:
    """CRS and rings of each polygon of all feature tables."""
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
        tables = database.execute(
            "SELECT g.table_name, g.column_name, s.organization, s.organization_coordsys_id, s.definition "
            "FROM gpkg_geometry_columns g JOIN gpkg_spatial_ref_sys s ON g.srs_id = s.srs_id"
        ).fetchall()
        for table, column, organization, code, definition in tables:
            known = str(organization).upper() in ("EPSG", "ESRI", "OGC") and int(code) > 0
            crs = f"{organization}:{code}" if known else None if definition in (None, "undefined") else definition
            table_sql, column_sql = (str(text).replace('"', '""') for text in (table, column))
            for i, (blob,) in enumerate(
                database.execute(f'SELECT "{column_sql}" FROM "{table_sql}" LIMIT {MAX_ROWS + 1}')
            ):
                if i == MAX_ROWS:
                    raise ValueError(f"{table} has more than {MAX_ROWS:,} rows")
                for polygon in _polygons_of_blob(blob):
                    yield crs, polygon


def _polygons_of_blob(blob: bytes | None) -> Iterator[list[Ring]]:
    """The polygons of a GeoPackage geometry: a header, then well-known binary (WKB)."""
    if not blob:
        return
    if blob[:2] != b"GP":
        raise ValueError("a geometry has no GeoPackage header")
    yield from _parse_wkb(blob, 8 + ENVELOPE_BYTES[(blob[3] >> 1) & 7])[0]


def _parse_wkb(data: bytes, at: int) -> tuple[list[list[Ring]], int]:
    """Polygons of the well-known binary at offset `at`, and the offset after it."""
    order = "<" if data[at] == 1 else ">"
    kind = struct.unpack_from(f"{order}I", data, at + 1)[0]
    width = 2 + {0: 0, 1: 1, 2: 1, 3: 2}[kind % 10_000 // 1000] + bool(kind & 0x8000_0000) + bool(kind & 0x4000_0000)
    kind, at = (kind & 0xFFFF) % 1000, at + 5
    if kind not in (WKB_POLYGON, WKB_MULTIPOLYGON):
        return [], len(data)
    count, at = struct.unpack_from(f"{order}I", data, at)[0], at + 4
    if kind == WKB_MULTIPOLYGON:
        polygons: list[list[Ring]] = []
        for _ in range(count):
            inner, at = _parse_wkb(data, at)
            polygons += inner
        return polygons, at
    rings: list[Ring] = []
    for _ in range(count):
        n, at = struct.unpack_from(f"{order}I", data, at)[0], at + 4
        if at + 8 * width * n > len(data):
            raise ValueError("a geometry is truncated")
        values = np.frombuffer(data, f"{order}f8", width * n, at).reshape(n, width)
        rings.append(values[:, :2].astype(np.float64))
        at += 8 * width * n
    return [rings], at


def _local(path: Path, xy: F64, crs: str | None, frame: Frame) -> F64:
    """Local metres (N, 2) of positions in a CRS; None: the tile's CRS, or degrees."""
    if crs is None and frame.crs != LOCAL and (np.abs(xy) <= (180, 90)).all():
        crs = WGS84
    if crs is not None and frame.crs != LOCAL:
        from pyproj import CRS, Transformer
        from pyproj.exceptions import ProjError

        try:
            source, target = CRS.from_user_input(crs), CRS.from_user_input(frame.crs)
            if source != target:
                xy = np.column_stack(Transformer.from_crs(source, target, always_xy=True).transform(*xy.T))
        except ProjError as error:
            raise InputError(
                path, f"its CRS can't be transformed to the tile's ({error})", "Reproject it first"
            ) from None
        if not np.isfinite(xy).all():
            raise InputError(path, f"lies outside of the tile's CRS {frame.crs[:40]}", "Reproject it first")
    return frame.to_local(np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
