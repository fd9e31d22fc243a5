"""Idempotent onboarding of packages into OSM (D3.2, section 2.3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from scan2sim.services.orchestration.instance import OWNER_TAG
from scan2sim.services.orchestration.lifecycle import MAX_LOST_RESPONSES
from scan2sim.services.orchestration.osm import TRANSIENT_STATUSES, Osm, OsmError, ResponseLost, back_off, collection_of
from scan2sim.services.orchestration.package import Package


def onboard(osm: Osm, package: Package, deployment: str) -> str:
    """Onboard a package, or continue an interrupted attempt; returns the id of its record.

    Args:
        deployment: name of the deployment, stored as the record's owner.

    Raises:
        ScanError: OSM rejects the package, or can't be reached.
    """
    collection, tags = collection_of(package), {OWNER_TAG: deployment, "package": package.name}
    for lost in range(MAX_LOST_RESPONSES + 1):
        try:
            record = record_of(package, osm.packages(collection))
            if record is None:
                return osm.onboard(package, tags)
            if not record.get("id"):
                osm.fill(package, str(record["_id"]))
            return str(record["_id"])
        except (ResponseLost, OsmError) as error:
            if lost == MAX_LOST_RESPONSES or (isinstance(error, OsmError) and error.status not in TRANSIENT_STATUSES):
                raise
            back_off(lost)
    raise AssertionError


def record_of(package: Package, records: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """A package's record: the one with its descriptor's id, else an empty one that was created for it."""
    uploaded = next((one for one in records if one.get("id") == package.descriptor.id), None)
    empty = (one for one in records if not one.get("id") and tags_of(one).get("package") == package.name)
    return uploaded or next(empty, None)


def tags_of(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """User-defined data that were stored with a record."""
    return (record.get("_admin") or {}).get("userDefinedData") or {}
