"""STAC catalogue of a survey for GIS tools and archives; virtual point cloud (`.vpc`) of its clouds.

A tile is an item: its location, scan time and products. Paths are relative, so that the survey's folder can be moved.
A virtual point cloud is one GeoJSON with one item per cloud, in the form that QGIS and PDAL wrench read: STAC 1.0.0,
the cloud as first asset, a path that starts with `./`, and bounds in the cloud's own CRS.
"""

from __future__ import annotations

import functools
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scan2sim import __version__
from scan2sim.pipeline.core.errors import DataError, from_os_error
from scan2sim.pipeline.core.types import F64, Frame
from scan2sim.pipeline.io.clouds import Header, las
from scan2sim.pipeline.io.geodata import geotiff
from scan2sim.pipeline.io.geodata.crs import LOCAL, _horizontal, _parsed
from scan2sim.pipeline.io.gps_time import from_gps
from scan2sim.pipeline.io.worlds.merge import swap

if TYPE_CHECKING:
    import pystac

PROCESSING_EXTENSION = "https://stac-extensions.github.io/processing/v1.1.0/schema.json"
VPC_EXTENSIONS = (
    "https://stac-extensions.github.io/pointcloud/v1.0.0/schema.json",
    "https://stac-extensions.github.io/projection/v1.1.0/schema.json",
)
LINEAGE = "Surfaces from lidar points, a class at a time, textured from posed photos"
WHOLE_EARTH_BBOX = [-180.0, -90.0, 180.0, 90.0]
SHA_256_MULTIHASH = "1220"  # multihash prefix: SHA-256, 32 bytes
MEDIA_TYPES = {
    ".copc.laz": "application/vnd.laszip+copc",
    ".laz": "application/vnd.laszip",
    ".las": "application/vnd.las",
    ".glb": "model/gltf-binary",
    ".sdf": "application/xml",
    ".html": "text/html",
    ".jpg": "image/jpeg",
    ".png": "image/png",
    ".tif": "image/tiff; application=geotiff; profile=cloud-optimized",
}
ENCODINGS = {".laz": "laszip", ".las": "las", ".ply": "ply"}
PDAL_NAMES = {"scan_angle": "ScanAngleRank", "scanner_channel": "ScanChannel", "nir": "Infrared"}


@dataclass(frozen=True)
class Cloud:
    """A point cloud file.

    Attributes:
        path: the file.
        header: its header, as returned by `pipeline.io.clouds.read_header`.
        digest: SHA-256, hexadecimal, or None.
    """

    path: Path
    header: Header
    digest: str | None = None


@dataclass(frozen=True)
class TileItem:
    """A tile as an item of the catalogue.

    Attributes:
        name: unique in the survey.
        frame: frame of the tile; only its CRS and unit are used.
        clouds: at least one; the tile's bounds are theirs.
        date: scan date with a time zone, used if the GPS times give none.
        times: first and last GPS time of its points, seconds, or None.
        world, glb, report, thumbnail: products: SDF, GLB, report page and preview image; None if missing.
        rasters: kind ("orthophoto", "dsm", "dtm") to GeoTIFF.
        lineage: description of the processing.
    """

    name: str
    frame: Frame
    clouds: tuple[Cloud, ...]
    date: datetime
    times: tuple[float, float] | None = None
    world: Path | None = None
    glb: Path | None = None
    report: Path | None = None
    thumbnail: Path | None = None
    rasters: Mapping[str, Path] = field(default_factory=dict)
    lineage: str = LINEAGE


def write(out: Path, name: str, description: str, tiles: Sequence[TileItem]) -> Path:
    """Write the catalogue `out/stac/`: `collection.json` and `<tile>/<tile>.json`; replaces an earlier one atomically.

    Tiles in a local frame have no location on Earth: their items have no geometry and no bbox, and the collection's
    extent, for which STAC requires a box, is the whole Earth.

    Returns:
        Path of `collection.json`.

    Raises:
        DataError: there is no tile.
        InputError: a file of a tile is missing.
        SpaceError: the disk is full or not writable.
    """
    import pystac

    if not tiles:
        raise DataError(name, "has no tiles", "Add tiles to the survey")
    temporary = out / ".stac"
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        collection = _collection(name, description, tiles)
        collection.normalize_hrefs(str(temporary.absolute()))
        for item in collection.get_items():
            item.make_asset_hrefs_relative()
        collection.save(catalog_type=pystac.CatalogType.SELF_CONTAINED)
        swap(temporary, out / "stac")
    except OSError as error:
        raise from_os_error(error, out) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return out / "stac" / "collection.json"


def write_vpc(path: Path, tiles: Sequence[TileItem]) -> Path:
    """Write all tiles' clouds as one virtual point cloud; returns `path`.

    Where tiles overlap, readers get the points of both.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    features = []
    for tile in tiles:
        for i, cloud in enumerate(tile.clouds):
            feature_id = tile.name if len(tile.clouds) == 1 else f"{tile.name}_{i}"
            features.append(_feature(feature_id, tile, cloud, path.parent))
    temporary = path.with_name(f".{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        body = {"type": "FeatureCollection", "features": features}
        temporary.write_text(json.dumps(body, indent=1), encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise from_os_error(error, path) from None
    return path


def _collection(name: str, description: str, tiles: Sequence[TileItem]) -> pystac.Collection:
    """The catalogue in memory, with absolute paths."""
    import pystac

    items = [_item(tile) for tile in tiles]
    spans = [_span(tile) for tile in tiles]
    boxes = np.array([item.bbox for item in items if item.bbox] or [WHOLE_EARTH_BBOX])
    total_bbox = [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]
    extent = pystac.Extent(
        pystac.SpatialExtent([total_bbox]),
        pystac.TemporalExtent([[min(start for start, _ in spans), max(end for _, end in spans)]]),
    )
    collection = pystac.Collection(name, description or name, extent, license="other")
    collection.add_items(items)
    return collection


def _item(tile: TileItem) -> pystac.Item:
    import pystac
    from pystac.extensions.pointcloud import PhenomenologyType, PointcloudExtension, Schema
    from pystac.extensions.projection import ProjectionExtension

    low, high = _bounds([cloud.header for cloud in tile.clouds])
    geometry, bbox = _footprint(tile.frame, low, high)
    start, end = _span(tile)
    item = pystac.Item(
        tile.name,
        geometry,
        bbox,
        start,
        {"processing:software": {"scan2sim": __version__}, "processing:lineage": tile.lineage},
        start_datetime=start,
        end_datetime=end,
        stac_extensions=[PROCESSING_EXTENSION],
    )
    code, wkt = _crs(tile.frame.crs)
    ProjectionExtension.ext(item, add_if_missing=True).apply(
        code=code,
        wkt2=None if code else wkt,
        geometry=_rectangle(_ring(low, high)),
        bbox=[*low.tolist(), *high.tolist()],
    )
    PointcloudExtension.ext(item, add_if_missing=True).apply(
        sum(cloud.header.count for cloud in tile.clouds),
        PhenomenologyType.LIDAR,
        _encoding(tile.clouds[0].path),
        [Schema(schema) for schema in schemas(tile.clouds[0].path)],
    )
    _add_assets(item, tile)
    return item


def _add_assets(item: pystac.Item, tile: TileItem) -> None:
    """Add the tile's files as assets, with their sizes and, where known, checksums."""
    import pystac
    from pystac.extensions.file import FileExtension

    files: list[tuple[str, Path | None, str, list[str], str | None]] = [
        ("world", tile.world, "Gazebo world", ["data"], None),
        ("glb", tile.glb, "All surfaces in one file", ["data", "visual"], None),
        ("report", tile.report, "How it was made and how good it is", ["metadata"], None),
        ("thumbnail", tile.thumbnail, "Picture", ["thumbnail"], None),
    ]
    for kind, raster in tile.rasters.items():
        files.append(
            (kind, raster, geotiff.KINDS[kind], ["data", "visual"] if kind == "orthophoto" else ["data"], None)
        )
    for i, cloud in enumerate(tile.clouds):  # PDAL's reader expects the asset "data"
        files.append((f"data_{i}" if i else "data", cloud.path, "Lidar points", ["data"], cloud.digest))
    for key, path, title, roles, digest in files:
        if path is None:
            continue
        item.add_asset(key, pystac.Asset(str(path.absolute()), title, media_type=_media_type(path), roles=roles))
        file_info = FileExtension.ext(item.assets[key], add_if_missing=True)
        file_info.apply(size=path.stat().st_size, checksum=digest and SHA_256_MULTIHASH + digest)


def _feature(name: str, tile: TileItem, cloud: Cloud, folder: Path) -> dict[str, Any]:
    """A cloud as an item of a virtual point cloud whose file is in `folder`."""
    low, high = _bounds([cloud.header])
    native = _rectangle(_ring(low, high))
    geometry, bbox = _footprint(tile.frame, low, high)
    start, end = _span(tile)
    return {
        "type": "Feature",
        "stac_version": "1.0.0",  # readers accept no other
        "stac_extensions": list(VPC_EXTENSIONS),
        "id": name,
        "geometry": geometry or native,  # readers require one, even without a location on Earth
        "bbox": bbox or [*low[:2].tolist(), *high[:2].tolist()],
        "properties": {
            "datetime": _iso(start),
            "start_datetime": _iso(start),
            "end_datetime": _iso(end),
            "pc:count": cloud.header.count,
            "pc:type": "lidar",
            "pc:encoding": _encoding(cloud.path),
            "pc:schemas": schemas(cloud.path),
            "proj:wkt2": _crs(tile.frame.crs)[1] or "",
            "proj:geometry": native,
            "proj:bbox": [*low.tolist(), *high.tolist()],
        },
        "links": [],
        "assets": {
            "data": {
                "href": f"./{Path(os.path.relpath(cloud.path, folder)).as_posix()}",
                "type": _media_type(cloud.path),
                "roles": ["data"],
            }
        },
    }


def schemas(path: Path) -> list[dict[str, Any]]:
    """Dimensions of a point: `name` (as in PDAL), `size` in bytes, `type`; for PLY only the coordinates."""
    found: list[dict[str, Any]] = [{"name": axis, "size": 8, "type": "floating"} for axis in "XYZ"]
    if path.suffix.lower() in (".las", ".laz"):
        with las.open_las(path) as reader:
            for dimension in list(reader.header.point_format.dimensions)[3:]:
                camel = "".join(word.capitalize() for word in dimension.name.split("_"))
                kind = {"FloatingPoint": "floating", "SignedInteger": "signed"}.get(dimension.kind.name, "unsigned")
                size = max(1, dimension.num_bits // 8)
                found.append({"name": PDAL_NAMES.get(dimension.name, camel), "size": size, "type": kind})
    return found


def _bounds(headers: Sequence[Header]) -> tuple[F64, F64]:
    low = np.min([header.low for header in headers], axis=0)
    high = np.max([header.high for header in headers], axis=0)
    return np.asarray(low, np.float64), np.asarray(high, np.float64)


def _ring(low: F64, high: F64) -> F64:
    """Corners (5, 2) of a rectangle, counter-clockwise, the first one repeated at the end."""
    (x0, y0), (x1, y1) = low[:2], high[:2]
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])


def _rectangle(ring: F64) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": [ring.tolist()]}


def _footprint(frame: Frame, low: F64, high: F64) -> tuple[dict[str, Any] | None, list[float] | None]:
    """Polygon of a box in degrees and its (west, south, east, north); (None, None) in a local frame."""
    if frame.crs == LOCAL:
        return None, None
    ring = np.column_stack(_to_degrees(frame.crs).transform(*_ring(low, high).T)).round(8)
    return _rectangle(ring), [*ring.min(axis=0).tolist(), *ring.max(axis=0).tolist()]


@functools.cache
def _crs(crs: str) -> tuple[str | None, str | None]:
    """Code (if any) and WKT of a CRS; (None, None) for "local"."""
    if crs == LOCAL:
        return None, None
    authority = _parsed(crs).to_authority()
    return authority and ":".join(authority), _parsed(crs).to_wkt()


@functools.cache
def _to_degrees(crs: str) -> Any:
    from pyproj import Transformer

    return Transformer.from_crs(_horizontal(crs), "EPSG:4326", always_xy=True)


def _span(tile: TileItem) -> tuple[datetime, datetime]:
    """Start and end of the scan, UTC."""
    start, end = (from_gps(time) for time in tile.times) if tile.times else (None, None)
    if start is None or end is None:
        return tile.date.astimezone(UTC), tile.date.astimezone(UTC)
    return start, end


def _iso(time: datetime) -> str:
    return time.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _media_type(path: Path) -> str:
    return next(
        (kind for end, kind in MEDIA_TYPES.items() if path.name.lower().endswith(end)), "application/octet-stream"
    )


def _encoding(path: Path) -> str:
    return ENCODINGS.get(path.suffix.lower(), "unknown")
