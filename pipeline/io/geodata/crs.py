"""Coordinate reference systems (CRS): the CRS of a tile, metres per unit of its axes, transformations to WGS 84."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Frame
from scan2sim.pipeline.io.geodata import units as units_io
from scan2sim.pipeline.io.geodata.units import with_unit

if TYPE_CHECKING:
    from pyproj import CRS

    from scan2sim.pipeline.io.clouds import Header

UNITS = {key: unit.metres for key, unit in units_io.UNITS.items()}
"""Metres per unit of the option `--units`."""
LOCAL = "local"


def common(
    tile: Path,
    crs: str | None,
    units: str | None,
    clouds: Sequence[Path],
    headers: Sequence[Header],
    warn: Callable[[str], None] = lambda _: None,
) -> tuple[str, float]:
    """The CRS of a tile and metres per unit: the given CRS and unit, else those that its clouds have in common.

    Args:
        tile: named in errors.
        crs: code or WKT, "local" without georeference, or None: that of the clouds.
        units: key of `units.UNITS`, or None: that of the CRS.
        clouds, headers: files, and their headers.
        warn: receives what differs from the given CRS and unit.

    Raises:
        InputError: no CRS is known, the clouds have different ones, or the CRS isn't projected.
    """
    cloud_crs = [(path, h.crs) for path, h in zip(clouds, headers, strict=True)]
    known = [(path, c) for path, c in cloud_crs if c]
    if crs is None:
        for path, other in known[1:]:
            if not same(known[0][1], other):
                raise InputError(
                    path,
                    f"is in {name(other)}, but {known[0][0].name} is in {name(known[0][1])}",
                    "Reproject all clouds of a tile to one CRS first, or name the right one with --crs",
                )
        unknown = [path for path, c in cloud_crs if not c]
        if unknown:
            raise InputError(
                unknown[0],
                "has no CRS, and neither has the tile",
                'Add crs = "EPSG:..." to tile.toml, or crs = "local" for metres without georeference',
            )
        crs = known[0][1] or LOCAL
    elif crs != LOCAL:
        for path, other in known:
            if note := contradiction(other, crs):
                warn(f"{path}: {note}")
    if crs == LOCAL:
        return LOCAL, UNITS[units or "m"]
    if units is None:
        return crs, _metres_per_unit(tile, crs)
    given = with_units(crs, units)
    if given != crs:
        warn(f"the coordinates are read in {units}, as given, though {name(crs)} has another unit")
    return given, _metres_per_unit(tile, given)


def contradiction(own: str | None, used: str) -> str:
    """Note on the CRS in a cloud's header, if another one is used; empty otherwise."""
    if own is None or used == LOCAL or same(own, used):
        return ""
    return f"its header says {name(own)}; {name(used)} is used, as given"


def with_units(crs: str, units: str) -> str:
    """The CRS with its lengths in `units` (a key of `units.UNITS`); unchanged if that is its unit.

    Raises:
        InputError: the CRS is invalid.
    """
    parsed = _parsed(crs)
    changed = with_unit(parsed, units_io.UNITS[units])
    return crs if changed is parsed else str(changed.to_wkt())


def utm(latitude: float, longitude: float) -> str:
    """EPSG code of the UTM zone (WGS 84) that contains a position in degrees."""
    return utm_zone(min(int((longitude + 180) // 6) + 1, 60), north=latitude >= 0)


def utm_zone(zone: int, *, north: bool) -> str:
    """EPSG code of a UTM zone (WGS 84), 1 to 60, of one hemisphere."""
    return f"EPSG:{(32600 if north else 32700) + zone}"


def to_wgs84(frame: Frame, xyz: npt.ArrayLike = (0.0, 0.0, 0.0)) -> tuple[float, float, float] | None:
    """(latitude deg, longitude deg, height m) of a local point; None for a local frame.

    The height is that of the CRS (ellipsoidal or orthometric); no vertical transformation is applied.
    """
    if frame.crs == LOCAL:
        return None
    from pyproj import Transformer

    local = np.asarray(xyz, float)
    x, y, _ = frame.to_crs(local).tolist()
    lon, lat = Transformer.from_crs(_horizontal(frame.crs), "EPSG:4979", always_xy=True).transform(x, y)[:2]
    return float(lat), float(lon), float(local[2] + frame.origin[2])


def to_ecef(frame: Frame, xyz: npt.ArrayLike) -> F64:
    """Local points (N, 3) as earth-centred WGS 84 metres (N, 3), EPSG:4978; heights as in `to_wgs84`."""
    from pyproj import Transformer

    local = np.asarray(xyz, np.float64)
    projected = frame.to_crs(local)
    lon, lat = Transformer.from_crs(_horizontal(frame.crs), "EPSG:4979", always_xy=True).transform(*projected.T[:2])[:2]
    to_centre = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    return np.stack(to_centre.transform(lon, lat, local[:, 2] + frame.origin[2]), axis=1)


def convergence(frame: Frame) -> float:
    """Meridian convergence at the origin, radians: the angle from true north to grid north, clockwise positive."""
    if frame.crs == LOCAL:
        return 0.0
    from pyproj import Proj

    origin = to_wgs84(frame)
    assert origin is not None
    return float(np.radians(Proj(_horizontal(frame.crs)).get_factors(origin[1], origin[0]).meridian_convergence))


def has_heights(crs: str) -> bool:
    """Whether a CRS is compound, that is, defines its vertical datum (such as a geoid)."""
    return crs != LOCAL and bool(_parsed(crs).is_compound)


def proj_string(crs: str) -> str:
    """PROJ string of a projected CRS, with metres as unit whatever its own are, without its vertical part."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "a PROJ string loses information": output formats require it
        text = _horizontal(crs).to_proj4()
    return (
        " ".join(part for part in text.split() if not part.startswith(("+units", "+to_meter", "+type"))) + " +units=m"
    )


def _parsed(crs: str) -> CRS:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return CRS.from_user_input(crs)
    except CRSError as error:
        raise InputError(
            "crs", f"{crs[:60]!r} is not a valid CRS ({error})", 'Give a code such as "EPSG:32633", or WKT'
        ) from None


def _horizontal(crs: str) -> CRS:
    parsed = _parsed(crs)
    return parsed.sub_crs_list[0] if parsed.is_compound else parsed


def same(a: str | None, b: str | None) -> bool:
    """Whether two codes or WKT strings denote the same horizontal CRS."""
    if a == b:
        return True
    if not a or not b or LOCAL in (a, b):
        return False
    first, second = _horizontal(a), _horizontal(b)
    return bool(first == second or (first.to_epsg() is not None and first.to_epsg() == second.to_epsg()))


def name(crs: str | None) -> str:
    """Display name of a CRS: its EPSG code, else its name."""
    if not crs or crs == LOCAL:
        return "no CRS"
    parsed = _parsed(crs)
    code = parsed.to_epsg()
    return f"EPSG:{code}" if code else str(parsed.name)


def short(crs: str) -> str:
    """The EPSG code if it identifies the CRS completely, otherwise the CRS unchanged."""
    if crs == LOCAL:
        return crs
    from pyproj import CRS

    code = CRS.from_user_input(crs).to_epsg(min_confidence=100)
    return f"EPSG:{code}" if code else crs


def _metres_per_unit(tile: Path, crs: str) -> float:
    horizontal = _horizontal(crs)
    if _parsed(crs).is_geocentric:
        cause = f"its CRS {name(crs)} is geocentric (coordinates from the centre of the earth)"
        remedy = "Reproject the clouds, for example to UTM, or name the CRS that they are in, if it is another one"
        raise InputError(tile, cause, remedy)
    if not horizontal.is_projected:
        raise InputError(
            tile,
            f"its CRS {name(crs)} is not projected (meshes need metres, not degrees)",
            "Reproject the clouds, for example to UTM",
        )
    factor = float(horizontal.axis_info[0].unit_conversion_factor)
    heights = [float(axis.unit_conversion_factor) for axis in _parsed(crs).axis_info[2:]]
    if any(abs(height / factor - 1) > 1e-5 for height in heights):
        raise InputError(
            tile,
            f"{name(crs)} has heights in units of {heights[0]:g} m, but horizontal units of {factor:g} m",
            "Reproject the clouds to a CRS with the same unit (metres or feet) for both",
        )
    return factor
