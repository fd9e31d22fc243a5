"""Idempotent onboarding of packages into OSM (D3.2, section 2.3.1)."""

from __future__ import annotations

from collections.abc import Sequence

from scan2sim.services.orchestration.instance import OWNER_TAG
from scan2sim.services.orchestration.lifecycle import MAX_LOST_RESPONSES
from scan2sim.services.orchestration.osm import Osm, OsmError, ResponseLost, back_off, collection_of, is_transient
from scan2sim.services.orchestration.package import Package
from scan2sim.services.orchestration.records import PackageRecord


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
            if not record.id:
                osm.fill(package, record.record)
            return record.record
        except (ResponseLost, OsmError) as error:
            if lost == MAX_LOST_RESPONSES or not is_transient(error):
                raise
            back_off(lost)
    raise AssertionError


def record_of(package: Package, records: Sequence[PackageRecord]) -> PackageRecord | None:
    """A package's record: the one with its descriptor's id, else an empty one that was created for it."""
    uploaded = next((one for one in records if one.id == package.descriptor.id), None)
    empty = (one for one in records if not one.id and one.tags.get("package") == package.name)
    return uploaded or next(empty, None)
