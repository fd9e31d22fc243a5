"""Reconcile OSM with `services.toml`: onboard packages, then update instances, then remove what is no longer listed.

Records in OSM are tagged with the deployment's name. Records without this tag are never changed, and no state is kept
on this side.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from scan2sim.pipeline.core.errors import ScanError, StepError
from scan2sim.pipeline.core.step import Report
from scan2sim.services.orchestration import deployment as files
from scan2sim.services.orchestration.deployment import Deployment, ServiceEntry
from scan2sim.services.orchestration.instance import OWNER_TAG, DesiredInstance, Instance, next_action
from scan2sim.services.orchestration.lifecycle import WaitPolicy, find_owned, load_instance, reconcile
from scan2sim.services.orchestration.lifecycle import find as find_by_id
from scan2sim.services.orchestration.onboarding import onboard, record_of
from scan2sim.services.orchestration.osm import (
    FUNCTIONS,
    SERVICES,
    Osm,
    OsmError,
    collection_of,
)
from scan2sim.services.orchestration.package import Package, Packages
from scan2sim.services.orchestration.records import PackageRecord
from scan2sim.services.orchestration.settings import ApplyParams

REQUEST_INTERVAL_S = 1.0
"""Minimum number of seconds between two requests about one instance."""


@dataclass(frozen=True)
class Change:
    """A change that was made or is planned.

    Attributes:
        name: name of the instance or package.
        action: what happens to it.
        reason: why, in a few words.
    """

    name: str
    action: str
    reason: str = ""


@dataclass
class ApplyResult:
    """Outcome of `apply`.

    Attributes:
        done: changes that were made.
        failed: errors by name of the instance or package.
    """

    done: list[Change] = field(default_factory=list)
    failed: dict[str, ScanError] = field(default_factory=dict)


@dataclass(frozen=True)
class DeploymentState:
    """Desired and observed state of a deployment.

    Attributes:
        name: name of the deployment.
        packages: desired packages by collection and descriptor id, functions first.
        desired: desired instances by name.
        records: the deployment's package records in OSM, by collection.
        instances: the deployment's instances in OSM that are desired, by name.
        obsolete: ids of its instances that aren't desired, by name.
    """

    name: str
    packages: Mapping[str, Package]
    desired: Mapping[str, DesiredInstance]
    records: Mapping[str, list[PackageRecord]]
    instances: Mapping[str, Instance]
    obsolete: Mapping[str, str]


def load_state(osm: Osm, requested: Deployment, folder: Path) -> DeploymentState:
    """Compare a deployment with OSM; relative paths in `services.toml` start at `folder`.

    Raises:
        ScanError: a service, site or key wasn't found, or OSM rejected a request.
    """
    built: dict[str, Packages] = {e.name: files.packages(e, requested.deployment, folder) for e in requested.services}
    sites: dict[tuple[str, str], str] = {}

    def vim(entry: ServiceEntry) -> str:
        site = (entry.vim, entry.cluster)
        if site not in sites:
            sites[site] = osm.cluster(entry.cluster) if entry.cluster else osm.vim(entry.vim)
        return sites[site]

    desired = {
        e.name: files.desired_instance(e, requested.deployment, built[e.name], folder, vim) for e in requested.services
    }
    functions = {one.function.descriptor.id: one.function for one in built.values()}
    services = {one.service.descriptor.id: one.service for one in built.values()}
    packages = {f"{FUNCTIONS} {key}": one for key, one in functions.items()}
    packages |= {f"{SERVICES} {key}": one for key, one in services.items()}
    records = {
        collection: [one for one in osm.packages(collection) if one.tags.get(OWNER_TAG) == requested.deployment]
        for collection in (FUNCTIONS, SERVICES)
    }
    ours = [one for one in osm.instances() if Instance.of(one, ()).belongs_to(requested.deployment)]
    ours.sort(key=lambda one: one.created)
    instances: dict[str, Instance] = {}
    obsolete: dict[str, str] = {}
    for one in ours:
        name = one.name
        if name in desired and name not in instances:
            instances[name] = load_instance(osm, one)
        else:
            obsolete[name if name not in instances else f"{name} ({one.record})"] = one.record
    return DeploymentState(requested.deployment, packages, desired, records, instances, obsolete)


def plan(state: DeploymentState) -> list[Change]:
    """Changes that `apply` would make."""
    changes = []
    for package in state.packages.values():
        record = record_of(package, state.records[collection_of(package)])
        if record is None or not record.id:
            changes.append(Change(package.name, "onboard", "its upload is incomplete" if record else "not in OSM"))
    changes += [Change(name, "remove", "not in services.toml") for name in state.obsolete]
    for name, desired in state.desired.items():
        instance = state.instances.get(name)
        action = next_action(desired, instance)
        if action is None:
            continue
        if instance is None:
            changes.append(Change(name, "create", "not in OSM"))
        elif instance.tag != desired.tag:
            changes.append(Change(name, "recreate", "its package, site or key changed"))
        else:
            changes.append(Change(name, str(action), _reason(instance, desired)))
    changes += [Change(one.name, "remove", "unused") for _, one in _unused(state)]
    return changes


def _reason(instance: Instance, desired: DesiredInstance) -> str:
    if instance.running_operation:
        return f"its {instance.running_operation.kind} is running"
    if not instance.instantiated:
        return "created but not instantiated"
    if instance.state == "BROKEN":
        return "its state is BROKEN"
    return f"{instance.machine_count} of {desired.replicas}" if desired.kind == "machine" else "its values changed"


class RequestPacer:
    """Rate limit, called before each request (`Osm`): each worker thread handles one instance at a time."""

    def __init__(self, interval_s: float = REQUEST_INTERVAL_S) -> None:
        self._interval_s, self._last = interval_s, threading.local()

    def begin(self) -> None:
        """Limit the requests of the calling thread from now on."""
        self._last.time = 0.0

    def __call__(self) -> None:
        """Wait until the calling thread may send its next request."""
        if not hasattr(self._last, "time"):
            return
        time.sleep(max(0.0, self._last.time + self._interval_s - time.monotonic()))
        self._last.time = time.monotonic()


def apply(
    osm: Osm,
    state: DeploymentState,
    params: ApplyParams,
    report: Report,
    stop: threading.Event | None = None,
    pacer: RequestPacer | None = None,
) -> ApplyResult:
    """Make the planned changes; a failure doesn't stop the other changes.

    Args:
        stop: set it to start no further changes; completed changes are kept.
        pacer: rate limit, called before each of `osm`'s requests.
    """
    stopping = stop or threading.Event()
    wait_policy = WaitPolicy(params.timeout, params.wait, stopping.is_set)
    result = ApplyResult()
    service_records = _onboard(osm, state, result, report, stopping)
    work: list[tuple[str, DesiredInstance | None]] = [(name, None) for name in state.obsolete]
    changed = [n for n, one in state.desired.items() if next_action(one, state.instances.get(n)) is not None]
    work += [(name, state.desired[name]) for name in changed if state.desired[name].nsd in service_records]
    done, lock = 0, threading.Lock()

    def reconcile_one(task: tuple[str, DesiredInstance | None]) -> None:
        nonlocal done
        name, desired = task
        if desired:
            find, record = partial(find_owned, osm, name, state.name), service_records[desired.nsd]
        else:
            find, record = partial(find_by_id, osm, state.obsolete[name]), ""
        try:
            reconcile(osm, find, desired, record, wait_policy, lambda text: report(done / len(work), f"{name}: {text}"))
        except ScanError as error:
            with lock:
                result.failed[name] = error
        else:
            with lock:
                result.done.append(Change(name, "up to date" if desired else "removed"))
        with lock:
            done += 1
            report(done / len(work), name)

    with ThreadPoolExecutor(params.parallel, initializer=pacer.begin if pacer else None) as pool:
        try:
            list(pool.map(reconcile_one, work))
        except KeyboardInterrupt:
            stopping.set()
            raise
    if not stopping.is_set():
        _prune(osm, state, result)
    return result


def _onboard(
    osm: Osm, state: DeploymentState, result: ApplyResult, report: Report, stopping: threading.Event
) -> dict[str, str]:
    """Onboard missing packages, functions first; returns record ids of network services by descriptor id."""
    service_records: dict[str, str] = {}
    rejected: set[str] = set()
    for package in state.packages.values():
        if stopping.is_set():
            break
        if rejected & set(package.descriptor.functions):
            continue
        known = record_of(package, state.records[collection_of(package)])
        if known and known.id:
            record = known.record
        else:
            report(0.0, f"onboarding {package.name}")
            try:
                record = onboard(osm, package, state.name)
            except ScanError as error:
                result.failed[package.name] = error
                rejected.add(package.descriptor.id)
                continue
            result.done.append(Change(package.name, "onboarded"))
        if package.descriptor.type == "nsd":
            service_records[package.descriptor.id] = record
    return service_records


def _prune(osm: Osm, state: DeploymentState, result: ApplyResult) -> None:
    """Remove the deployment's unused packages: network services before their functions."""
    for collection, record in _unused(state):
        name = record.name
        try:
            osm.remove(collection, record.record)
        except ScanError as error:
            # 409: an instance whose removal failed still uses it
            if not (isinstance(error, OsmError) and error.status == 409):
                result.failed[name] = error
            continue
        result.done.append(Change(name, "removed"))


def _unused(state: DeploymentState) -> list[tuple[str, PackageRecord]]:
    """Package records that are unused or duplicates, with their collections; network services first."""
    found = []
    for collection in (SERVICES, FUNCTIONS):
        records = state.records[collection]
        needed = [record_of(one, records) for one in state.packages.values() if collection_of(one) == collection]
        keep = {one.record for one in needed if one}
        found += [(collection, one) for one in records if one.record not in keep]
    return found


def failure(result: ApplyResult) -> StepError | None:
    """One error for all failures; None if nothing failed."""
    if not result.failed:
        return None
    name, first = next(iter(result.failed.items()))
    others = len(result.failed) - 1
    cause = first.cause + (f"; {others} more failed" if others else "")
    return StepError(name if first.where == name else f"{name}: {first.where}", cause, first.remedy)
