"""Footprints of buildings: polygons of a GeoJSON or a GeoPackage (OGC 12-128r19), by what Python has itself."""

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
MOST = 1_000_000  # rows of a table: a view's needn't end
ENVELOPES = (0, 32, 48, 48, 64)  # bytes, by a GeoPackage geometry's flag
POLYGON, MULTIPOLYGON = 3, 6
UNREADABLE = (
    OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError, struct.error,
    sqlite3.Error,
)  # fmt: skip

Ring = F64


def read(path: Path, frame: Frame) -> list[F64]:
    """Rings (K, 2) around what is built, in the frame's local metres, their inside to the left.

    Geometries other than polygons are passed over. GeoJSON without a `crs` of its own is in the tile's CRS where its
    coordinates can't be degrees, else in WGS 84, as RFC 7946 says.

    Raises:
        InputError: it can't be read, holds no polygon, or its CRS can't be brought to the tile's.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(path, "is no GeoJSON or GeoPackage", f"Footprints are {', '.join(SUFFIXES)} files")
    file_checks.check(path, "Put it there, or leave the footprints out")
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
        raise InputError(path, "holds no polygon", "Footprints are polygons, one a building")
    return rings


def _geojson(path: Path) -> Iterator[tuple[str | None, list[Ring]]]:
    """CRS and rings of each polygon; None: the file doesn't say."""
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
    """CRS and rings of each polygon of all tables of features."""
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as base:
        tables = base.execute(
            "SELECT g.table_name, g.column_name, s.organization, s.organization_coordsys_id, s.definition "
            "FROM gpkg_geometry_columns g JOIN gpkg_spatial_ref_sys s ON g.srs_id = s.srs_id"
        ).fetchall()
        for table, column, organization, code, definition in tables:
            known = str(organization).upper() in ("EPSG", "ESRI", "OGC") and int(code) > 0
            crs = f"{organization}:{code}" if known else None if definition in (None, "undefined") else definition
            name, what = (str(text).replace('"', '""') for text in (table, column))
            for i, (blob,) in enumerate(base.execute(f'SELECT "{what}" FROM "{name}" LIMIT {MOST + 1}')):
                if i == MOST:
                    raise ValueError(f"{table} has more than {MOST:,} rows")
                for polygon in _from_blob(blob):
                    yield crs, polygon


def _from_blob(blob: bytes | None) -> Iterator[list[Ring]]:
    """The polygons of a GeoPackage's geometry: a header, then well-known binary."""
    if not blob:
        return
    if blob[:2] != b"GP":
        raise ValueError("a geometry isn't a GeoPackage's")
    yield from _well_known(blob, 8 + ENVELOPES[(blob[3] >> 1) & 7])[0]


def _well_known(data: bytes, at: int) -> tuple[list[list[Ring]], int]:
    """Polygons of the well-known binary at a place, and where it ends."""
    order = "<" if data[at] == 1 else ">"
    kind = struct.unpack_from(f"{order}I", data, at + 1)[0]
    width = 2 + {0: 0, 1: 1, 2: 1, 3: 2}[kind % 10_000 // 1000] + bool(kind & 0x8000_0000) + bool(kind & 0x4000_0000)
    kind, at = (kind & 0xFFFF) % 1000, at + 5
    if kind not in (POLYGON, MULTIPOLYGON):
        return [], len(data)
    count, at = struct.unpack_from(f"{order}I", data, at)[0], at + 4
    if kind == MULTIPOLYGON:
        polygons: list[list[Ring]] = []
        for _ in range(count):
            inner, at = _well_known(data, at)
            polygons += inner
        return polygons, at
    rings: list[Ring] = []
    for _ in range(count):
        n, at = struct.unpack_from(f"{order}I", data, at)[0], at + 4
        if at + 8 * width * n > len(data):
            raise ValueError("a geometry ends too early")
        values = np.frombuffer(data, f"{order}f8", width * n, at).reshape(n, width)
        rings.append(values[:, :2].astype(np.float64))
        at += 8 * width * n
    return [rings], at


def _local(path: Path, xy: F64, crs: str | None, frame: Frame) -> F64:
    """(N, 2) local metres of places in a CRS; None: the tile's, or degrees."""
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
            raise InputError(path, f"its CRS can't be brought to the tile's ({error})", "Reproject it first") from None
        if not np.isfinite(xy).all():
            raise InputError(path, f"lies outside of the tile's CRS {frame.crs[:40]}", "Reproject it first")
    return frame.to_local(np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
