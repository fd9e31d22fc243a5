"""Coordinates against the area of use of their CRS: what is wrong with them, and which other reading fits.

A header's CRS is often wrong: degrees over coordinates in metres, metres over coordinates in feet, northing before
easting, local coordinates under a national CRS.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.geodata.crs import LOCAL, _horizontal, name
from scan2sim.pipeline.io.geodata.units import UNITS

if TYPE_CHECKING:
    from pyproj import CRS

NEAR_DEG = 0.3
"""Distance from an area of use up to which coordinates fit it without doubt, degrees."""
MARGIN_SHARE = (0.5, 0.25)
"""Shares of its width and height up to which they may fit it: data of a country is often kept in one zone."""
MAX_DEGREES_EXTENT = 0.5
"""Extent up to which coordinates may be degrees: larger tiles don't exist."""
NEAR_ZERO = 50_000.0
"""Coordinates below this are local ones, unless they fit their CRS."""
NORTHINGS, EASTINGS = (3.8e6, 9.4e6), (1.66e5, 8.34e5)
"""Northings from 34 degrees, and eastings of UTM: nothing else has such values in this order."""


class Misfit(NamedTuple):
    """Why coordinates don't fit their CRS.

    Attributes:
        cause: what is wrong.
        remedy: how to read them otherwise.
        severe: whether they would make a wrong world: mirrored, or of a wrong size.
    """

    cause: str
    remedy: str
    severe: bool

    def __str__(self) -> str:
        return f"{self.cause}. {self.remedy}"


def misfit(crs: str, low: npt.ArrayLike, high: npt.ArrayLike) -> Misfit | None:
    """What is wrong with coordinates in a CRS, or None.

    Args:
        crs: code or WKT, or "local".
        low, high: (3,) bounds in the units of the CRS, in the order easting, northing, height.
    """
    lowest, highest = np.asarray(low, np.float64)[:2], np.asarray(high, np.float64)[:2]
    middle = (lowest + highest) / 2
    if not np.isfinite(middle).all():
        return None
    if crs == LOCAL:
        return _swapped_local(middle)
    given = _horizontal(crs)
    if given.is_geographic:
        if abs(middle[0]) <= 360 and abs(middle[1]) <= 360:
            return None
        around = f"{middle[0]:,.0f} / {middle[1]:,.0f}"
        cause = f"its CRS {name(crs)} has degrees, but its coordinates around {around} are lengths"
        return Misfit(cause, "Name the projected CRS that they are in, for example --crs EPSG:32633", True)
    area = _area(given)
    if area is None or area.contains(middle, NEAR_DEG):
        return None
    return _other_reading(given, name(crs), area, middle, highest - lowest)


def _other_reading(given: CRS, called: str, area: _Area, middle: F64, extent: F64) -> Misfit | None:
    """The reading of coordinates outside of the area of use that fits; None if they are just beyond its border."""
    outside = f"its coordinates around {middle[0]:,.0f} / {middle[1]:,.0f} are outside of the area of use of {called}"
    far = not area.contains(middle, MARGIN_SHARE)
    if far and area.contains(middle[::-1], NEAR_DEG):
        return Misfit(f"{outside}: northing comes before easting", "Name the order with --axes neh", True)
    unit = float(given.axis_info[0].unit_conversion_factor)
    factors = {key: other.metres / unit for key, other in UNITS.items() if abs(other.metres / unit - 1) > 1e-4}
    for key, factor in factors.items() if area.american or unit != 1 else ():
        text = "us-ft (or ft)" if key == "ft" else key
        if area.contains(middle * factor, 0.0):
            return Misfit(f"{outside}, but fit it in another unit", f"Name the unit with --units {text}", True)
        if area.contains(middle[::-1] * factor, 0.0):
            remedy = f"Name unit and order with --units {text} --axes neh"
            return Misfit(f"{outside}: they fit with northing before easting, in another unit", remedy, True)
    if np.abs(middle).max() <= 360 and extent.max() <= MAX_DEGREES_EXTENT:
        return Misfit(f"{outside}: they seem to be degrees", f"Reproject them to {called}", True)
    if np.abs(middle).max() <= NEAR_ZERO:
        return Misfit(f"{outside}: they seem to be local", "Leave out the georeference with --crs local", False)
    if not far:
        return None
    zone = re.search(r"zone (\d+)", given.name)
    if zone and area.contains(middle - [int(zone[1]) * 1e6, 0], MARGIN_SHARE):
        remedy = (
            "Name a CRS of such coordinates with --crs (EPSG:5649 for zone 31, 4647 for 32, 5650 for 33), or subtract "
            f"{zone[1]}000000 from the eastings"
        )
        return Misfit(f"{outside}: the eastings begin with the zone number {zone[1]}", remedy, False)
    return Misfit(outside, "Check the CRS, or name another with --crs: the world has the wrong position", False)


class _Area(NamedTuple):
    """Area of use of a CRS in degrees; `east` is above 180 if it crosses the date line."""

    to_degrees: Callable[..., tuple[float, float]]
    west: float
    south: float
    east: float
    north: float

    @property
    def american(self) -> bool:
        """Whether feet are used there."""
        return self.east < -50

    def contains(self, position: F64, margin: float | tuple[float, float]) -> bool:
        """Whether a position (2,) is inside, with a margin in degrees, or in shares of the width and height."""
        longitude, latitude = self.to_degrees(*position.tolist())
        if not (np.isfinite(longitude) and np.isfinite(latitude)):
            return False
        size = self.east - self.west, self.north - self.south
        across, along = (
            (margin, margin)
            if isinstance(margin, float)
            else (max(NEAR_DEG, share * length) for share, length in zip(margin, size, strict=True))
        )
        turned = any(self.west - across <= longitude + turn <= self.east + across for turn in (-360, 0, 360))
        return bool(turned and self.south - along <= latitude <= self.north + along)


def _area(crs: CRS) -> _Area | None:
    """The area of use of a CRS; None if it is unknown."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    area = crs.area_of_use
    if area is None:  # WKT 1 has none: that of the CRS with this code or, in another unit (`units.with_unit`), name
        code = crs.to_epsg(min_confidence=70)
        try:
            area = CRS.from_user_input(code or crs.name.rpartition(" (")[0]).area_of_use
        except CRSError:
            return None
    if area is None:
        return None
    to_degrees = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform
    return _Area(to_degrees, area.west, area.south, area.east + (360 if area.east < area.west else 0), area.north)


def _swapped_local(middle: F64) -> Misfit | None:
    if NORTHINGS[0] <= middle[0] <= NORTHINGS[1] and EASTINGS[0] <= middle[1] <= EASTINGS[1]:
        cause = f"its coordinates around {middle[0]:,.0f} / {middle[1]:,.0f} seem to have northing before easting"
        return Misfit(f"{cause}, which mirrors the world", "Name the order with --axes neh", False)
    return None
