"""Linear units of CRS: those of EPSG, and CRS in other units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from pyproj import CRS


class Unit(NamedTuple):
    """A linear unit: its name, and its size in metres."""

    name: str
    metres: float


SAME_UNIT = 1e-7
"""Relative difference up to which units are the same: the two feet differ by 2e-6."""
UNITS = {
    "m": Unit("metre", 1.0),
    "ft": Unit("foot", 0.3048),
    "us-ft": Unit("US survey foot", 1200 / 3937),
}
"""Units of the option `--units`."""


def linear_unit(code: int) -> Unit:
    """The unit of an EPSG code, such as 9003.

    Raises:
        ValueError: it is no linear unit.
    """
    from pyproj.database import get_units_map

    units = get_units_map(auth_name="EPSG", category="linear")
    found = next((unit for unit in units.values() if unit.code == str(code)), None)
    if found is None:
        raise ValueError(f"its unit {code} is unknown")
    return Unit(found.name, float(found.conv_factor))


def with_unit(crs: CRS, unit: Unit) -> CRS:
    """The same CRS with its lengths in another unit; unchanged if that is its own."""
    from pyproj import CRS

    axes = [axis for axis in crs.axis_info if not axis.unit_name.startswith("degree")]
    if all(abs(axis.unit_conversion_factor / unit.metres - 1) < SAME_UNIT for axis in axes):
        return crs
    body = crs.to_json_dict()
    body["name"] = f"{body['name']} ({unit.name})"
    for part in _parts(body):
        part.pop("id", None)
        for axis in part.get("coordinate_system", {}).get("axis", ()):
            if not _is_angle(axis.get("unit")):
                axis["unit"] = {"type": "LinearUnit", "name": unit.name, "conversion_factor": unit.metres}
    return CRS.from_json_dict(body)


def _parts(body: dict[str, Any]) -> list[dict[str, Any]]:
    """A CRS in PROJ's JSON, with its components or source, all of which have axes."""
    inner = [*body.get("components", ()), *([body["source_crs"]] if "source_crs" in body else ())]
    return [body, *(part for one in inner for part in _parts(one))]


def _is_angle(unit: Any) -> bool:
    return unit == "degree" or (isinstance(unit, dict) and unit.get("type") == "AngularUnit")
