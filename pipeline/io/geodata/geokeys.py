"""CRS given as GeoTIFF keys, as in LAS files: EPSG codes, units that override those of the codes, and projections.

Source: OGC GeoTIFF 1.1 (19-008r4); the records are those of LAS 1.4 R15, section 2.6.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.io.geodata.units import SAME_UNIT, Unit, linear_unit, with_unit

if TYPE_CHECKING:
    from pyproj import CRS

DIRECTORY, DOUBLES, TEXTS = 34735, 34736, 34737
"""Records of the keys, and of values that don't fit into their directory."""
GEOGRAPHIC, PROJECTED, VERTICAL = 2048, 3072, 4096
"""Keys of EPSG codes."""
LINEAR_UNIT, LINEAR_UNIT_SIZE, VERTICAL_UNIT = 3076, 3077, 4099
"""Keys of units: EPSG codes, and the size in metres of one without a code."""
USER_DEFINED = 32767
"""Value of a code that is replaced by other keys."""

UNKNOWN_HEIGHTS: dict[str, Any] = {
    "type": "VerticalCRS",
    "name": "unknown",
    "datum": {"type": "VerticalReferenceFrame", "name": "unknown"},
    "coordinate_system": {
        "subtype": "vertical",
        "axis": [{"name": "Up", "abbreviation": "H", "direction": "up", "unit": "metre"}],
    },
}


def crs_of_records(directory: bytes, doubles: bytes = b"", text: bytes = b"") -> CRS | None:
    """The CRS that GeoTIFF keys define, with their units; None if they name none.

    Args:
        directory, doubles, text: contents of the records (or TIFF tags) 34735 to 34737.

    Raises:
        ValueError: they are damaged, a code is unknown, or a projection without a code can't be read (needs rasterio).
    """
    from pyproj import CRS
    from pyproj.crs import CompoundCRS
    from pyproj.exceptions import CRSError

    found = _keys(directory, doubles)
    code = found.get(PROJECTED, 0) or found.get(GEOGRAPHIC, 0)
    try:
        if code == USER_DEFINED:
            crs = _by_parameters(directory, doubles, text)
        elif code:
            crs = CRS.from_epsg(code)
        else:
            return None
        if crs.is_projected and (unit := _unit(found, LINEAR_UNIT, LINEAR_UNIT_SIZE)):
            crs = with_unit(crs, unit)
        vertical = _vertical(found, crs)
        return crs if vertical is None else CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical])
    except CRSError as error:
        raise ValueError(str(error)) from None


def _keys(directory: bytes, doubles: bytes) -> dict[int, Any]:
    """Numbers of the keys, by their id."""
    if len(directory) < 8:
        raise ValueError("no directory of GeoTIFF keys")
    count = struct.unpack_from("<H", directory, 6)[0]
    if len(directory) < 8 + 8 * count:
        raise ValueError(f"{count} GeoTIFF keys in {len(directory)} bytes")
    found: dict[int, Any] = {}
    for i in range(count):
        key, where, _, value = struct.unpack_from("<4H", directory, 8 + 8 * i)
        if where == 0:
            found[key] = value
        elif where == DOUBLES and 8 * (value + 1) <= len(doubles):
            found[key] = struct.unpack_from("<d", doubles, 8 * value)[0]
    return found


def _by_parameters(directory: bytes, doubles: bytes, text: bytes) -> CRS:
    """The horizontal CRS of keys that describe a projection by its parameters, read by GDAL."""
    from pyproj import CRS

    if optional_deps.missing("rasterio"):
        raise ValueError("its projection has no EPSG code, which needs rasterio: pip install 'scan2sim[rasters]'")
    from rasterio.errors import RasterioError
    from rasterio.io import MemoryFile

    entries = [directory[at : at + 8] for at in range(8, len(directory) - 7, 8)]
    entries = sorted((entry for entry in entries if any(entry[:2])), key=lambda entry: struct.unpack("<H", entry[:2]))
    whole = directory[:6] + struct.pack("<H", len(entries)) + b"".join(entries)  # GDAL refuses empty and unsorted keys
    try:
        with MemoryFile(_tiff(whole, doubles, text)) as file, file.open() as raster:
            crs = CRS.from_user_input(raster.crs.to_wkt()) if raster.crs else None
    except RasterioError as error:
        raise ValueError(f"its projection can't be read: {error}") from None
    if crs is not None and crs.is_compound:
        crs = crs.sub_crs_list[0]
    if crs is None or not crs.is_projected:
        raise ValueError("its projection has no EPSG code, and its parameters are incomplete")
    return crs


def _tiff(directory: bytes, doubles: bytes, text: bytes) -> bytes:
    """A TIFF of one pixel that holds the keys."""
    short, long, double, ascii_ = 3, 4, 12, 2
    tags: dict[int, tuple[int, int, bytes]] = {
        tag: (short, 1, struct.pack("<I", value))
        for tag, value in ((256, 1), (257, 1), (258, 8), (259, 1), (262, 1), (277, 1), (278, 1), (279, 1))
    }
    tags[33550] = double, 3, struct.pack("<3d", 1, 1, 0)  # pixel size
    tags[33922] = double, 6, bytes(48)  # tie point
    tags[DIRECTORY] = short, len(directory) // 2, directory
    if doubles:
        tags[DOUBLES] = double, len(doubles) // 8, doubles
    if text:
        tags[TEXTS] = ascii_, len(text), text
    start = 8 + 2 + 12 * (len(tags) + 1) + 4
    entries, data = {}, b""
    for tag, (kind, count, value) in tags.items():
        at = value if len(value) == 4 and kind == short else struct.pack("<I", start + len(data))
        data += b"" if at == value else value + bytes(len(value) % 2)
        entries[tag] = struct.pack("<HHI", tag, kind, count) + at
    entries[273] = struct.pack("<HHII", 273, long, 1, start + len(data))  # the pixel
    body = b"".join(entries[tag] for tag in sorted(entries))
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4) + data + b"\0"


def _vertical(found: dict[int, Any], horizontal: CRS) -> CRS | None:
    """The vertical CRS, if keys give one, or heights in another unit than that of the horizontal CRS."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    unit = _unit(found, VERTICAL_UNIT)
    try:
        crs = CRS.from_epsg(found.get(VERTICAL, 0))
    except CRSError:  # none, or one of an ellipsoid
        crs = None
    if crs is not None and crs.is_vertical:
        return crs if unit is None else with_unit(crs, unit)
    same = unit is None or abs(unit.metres / horizontal.axis_info[0].unit_conversion_factor - 1) < SAME_UNIT
    if unit is None or same or not horizontal.is_projected:
        return None
    return with_unit(CRS.from_json_dict(UNKNOWN_HEIGHTS), unit)


def _unit(found: dict[int, Any], key: int, size_key: int = 0) -> Unit | None:
    code, size = found.get(key, 0), float(found.get(size_key, 0))
    if code == USER_DEFINED:
        return Unit("unknown", size) if size > 0 else None
    return linear_unit(code) if code else None
