"""Packages brought into OSM, once, however often that is begun (D3.2, section 2.3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from scan2sim.services.orchestration.instance import MARK
from scan2sim.services.orchestration.lifecycle import LOST
from scan2sim.services.orchestration.osm import PASSING, Osm, Refused, Unsure, collection_of, pause
from scan2sim.services.orchestration.package import Package


def onboard(osm: Osm, package: Package, deployment: str) -> str:
    """A package's record; goes on where an earlier try was cut short.

    Args:
        deployment: by whose name the record is marked.

    Raises:
        ScanError: OSM refuses it, or can't be reached.
    """
    collection, marks = collection_of(package), {MARK: deployment, "package": package.name}
    for lost in range(LOST + 1):
        try:
            record = record_of(package, osm.packages(collection))
            if record is None:
                return osm.onboard(package, marks)
            if not record.get("id"):
                osm.fill(package, str(record["_id"]))
            return str(record["_id"])
        except (Unsure, Refused) as error:
            if lost == LOST or (isinstance(error, Refused) and error.status not in PASSING):
                raise
            pause(lost)
    raise AssertionError


def record_of(package: Package, records: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """A package's record: by its descriptor's id, else one that was made for it and is empty."""
    whole = next((one for one in records if one.get("id") == package.descriptor.id), None)
    empty = (one for one in records if not one.get("id") and marks_of(one).get("package") == package.name)
    return whole or next(empty, None)


def marks_of(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """What was kept beside a record when it was made."""
    return (record.get("_admin") or {}).get("userDefinedData") or {}
