"""What runs is brought to what `services.toml` says: packages, then instances, then what isn't wanted any more goes.

Records in OSM carry the deployment's name: nothing else is ever touched, and nothing needs to be remembered here.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import ScanError, StepError
from scan2sim.pipeline.core.step import Report
from scan2sim.services.orchestration import deployment as files
from scan2sim.services.orchestration.deployment import Deployment, Entry
from scan2sim.services.orchestration.instance import MARK, Instance, Wanted, next_action
from scan2sim.services.orchestration.lifecycle import Patience, bring, find_own, look
from scan2sim.services.orchestration.lifecycle import find as find_id
from scan2sim.services.orchestration.onboarding import marks_of, onboard, record_of
from scan2sim.services.orchestration.osm import (
    FUNCTIONS,
    SERVICES,
    Osm,
    Refused,
    collection_of,
)
from scan2sim.services.orchestration.package import Package, Packages
from scan2sim.services.orchestration.settings import ApplyParams

APART = 1.0
"""Seconds between two requests about one instance, at least."""


@dataclass(frozen=True)
class Change:
    """What is done, or would be.

    Attributes:
        name: of an instance or a package; what: happens to it; why: in a few words.
    """

    name: str
    what: str
    why: str = ""


@dataclass
class Applied:
    """What became of it.

    Attributes:
        done: that was.
        failed: what wasn't, by name.
    """

    done: list[Change] = field(default_factory=list)
    failed: dict[str, ScanError] = field(default_factory=dict)


@dataclass(frozen=True)
class Target:
    """A deployment made ready: what is to be in OSM, and what is.

    Attributes:
        name: of the deployment.
        packages: by their descriptors' ids; functions first.
        wanted: instances by their names.
        records: of packages that are the deployment's, by collection.
        instances: by name, those of the deployment; without: ids of those that aren't wanted, by name.
    """

    name: str
    packages: Mapping[str, Package]
    wanted: Mapping[str, Wanted]
    records: Mapping[str, list[dict[str, Any]]]
    instances: Mapping[str, Instance]
    without: Mapping[str, str]


def target(osm: Osm, asked: Deployment, folder: Path) -> Target:
    """Look at what is there, and at what is to be; `folder` is where the file's own files are.

    Raises:
        ScanError: something that is named isn't there, or OSM refuses.
    """
    made: dict[str, Packages] = {e.name: files.packages(e, asked.deployment, folder) for e in asked.services}
    sites: dict[tuple[str, str], str] = {}

    def vim(entry: Entry) -> str:
        site = (entry.vim, entry.cluster)
        if site not in sites:
            sites[site] = osm.cluster(entry.cluster) if entry.cluster else osm.vim(entry.vim)
        return sites[site]

    wanted = {e.name: files.wanted(e, asked.deployment, made[e.name], folder, vim) for e in asked.services}
    functions = {one.function.descriptor.id: one.function for one in made.values()}
    services = {one.service.descriptor.id: one.service for one in made.values()}
    packages = {f"{FUNCTIONS} {key}": one for key, one in functions.items()}
    packages |= {f"{SERVICES} {key}": one for key, one in services.items()}
    records = {
        collection: [one for one in osm.packages(collection) if marks_of(one).get(MARK) == asked.deployment]
        for collection in (FUNCTIONS, SERVICES)
    }
    ours = [one for one in osm.instances() if Instance.of(one, ()).is_of(asked.deployment)]
    ours.sort(key=lambda one: one.get("create-time", 0))
    instances: dict[str, Instance] = {}
    without: dict[str, str] = {}
    for one in ours:
        name = str(one.get("name"))
        if name in wanted and name not in instances:
            instances[name] = look(osm, one)
        else:
            without[name if name not in instances else f"{name} ({one['_id']})"] = str(one["_id"])
    return Target(asked.deployment, packages, wanted, records, instances, without)


def plan(there: Target) -> list[Change]:
    """What `apply` would do."""
    changes = []
    for package in there.packages.values():
        record = record_of(package, there.records[collection_of(package)])
        if record is None or not record.get("id"):
            changes.append(Change(package.name, "onboard", "is half onboarded" if record else "isn't there"))
    changes += [Change(name, "remove", "isn't asked for") for name in there.without]
    for name, wanted in there.wanted.items():
        instance = there.instances.get(name)
        action = next_action(wanted, instance)
        if action is None:
            continue
        if instance is None:
            changes.append(Change(name, "create", "isn't there"))
        elif instance.mark != wanted.mark:
            changes.append(Change(name, "make anew", "is of another package, site or key"))
        else:
            changes.append(Change(name, str(action), _why(instance, wanted)))
    changes += [Change(str(one.get("id") or one["_id"]), "remove", "nothing needs it") for _, one in _unneeded(there)]
    return changes


def _why(there: Instance, wanted: Wanted) -> str:
    if there.running:
        return f"its {there.running.get('lcmOperationType')} runs"
    if not there.instantiated:
        return "was created only"
    if there.state == "BROKEN":
        return "is broken"
    return f"{there.machines} of {wanted.replicas}" if wanted.kind == "machine" else "is to have other values"


class Pace:
    """Called before each request (`Osm`): keeps requests of threads apart that work on one instance each."""

    def __init__(self, apart: float = APART) -> None:
        self._apart, self._last = apart, threading.local()

    def begin(self) -> None:
        """From now on, this thread's requests are kept apart."""
        self._last.time = 0.0

    def __call__(self) -> None:
        """Wait until this thread may ask again."""
        if not hasattr(self._last, "time"):
            return
        time.sleep(max(0.0, self._last.time + self._apart - time.monotonic()))
        self._last.time = time.monotonic()


def apply(
    osm: Osm,
    there: Target,
    params: ApplyParams,
    report: Report,
    stop: threading.Event | None = None,
    pace: Pace | None = None,
) -> Applied:
    """Do it; what fails doesn't keep the rest from being done.

    Args:
        stop: set to begin nothing more; what is done is kept.
        pace: called before each of `osm`'s requests.
    """
    ended = stop or threading.Event()
    patience = Patience(params.timeout, params.wait, ended.is_set)
    applied = Applied()
    records = _onboard(osm, there, applied, report, ended)
    work: list[tuple[str, Wanted | None]] = [(name, None) for name in there.without]
    changed = [n for n, one in there.wanted.items() if next_action(one, there.instances.get(n)) is not None]
    work += [(name, there.wanted[name]) for name in changed if there.wanted[name].nsd in records]
    done, lock = 0, threading.Lock()

    def one(task: tuple[str, Wanted | None]) -> None:
        nonlocal done
        name, wanted = task
        if wanted:
            find, record = partial(find_own, osm, name, there.name), records[wanted.nsd]
        else:
            find, record = partial(find_id, osm, there.without[name]), ""
        try:
            bring(osm, find, wanted, record, patience, lambda what: report(done / len(work), f"{name}: {what}"))
        except ScanError as error:
            with lock:
                applied.failed[name] = error
        else:
            with lock:
                applied.done.append(Change(name, "as asked" if wanted else "removed"))
        with lock:
            done += 1
            report(done / len(work), name)

    with ThreadPoolExecutor(params.parallel, initializer=pace.begin if pace else None) as pool:
        try:
            list(pool.map(one, work))
        except KeyboardInterrupt:
            ended.set()
            raise
    if not ended.is_set():
        _prune(osm, there, applied)
    return applied


def _onboard(osm: Osm, there: Target, applied: Applied, report: Report, ended: threading.Event) -> dict[str, str]:
    """Packages that are missing, functions first; returns records of network services by their descriptors' ids."""
    found: dict[str, str] = {}
    refused: set[str] = set()
    for package in there.packages.values():
        if ended.is_set():
            break
        if refused & set(package.descriptor.functions):
            continue
        known = record_of(package, there.records[collection_of(package)])
        if known and known.get("id"):
            record = str(known["_id"])
        else:
            report(0.0, f"onboards {package.name}")
            try:
                record = onboard(osm, package, there.name)
            except ScanError as error:
                applied.failed[package.name] = error
                refused.add(package.descriptor.id)
                continue
            applied.done.append(Change(package.name, "onboarded"))
        if package.descriptor.sort == "nsd":
            found[package.descriptor.id] = record
    return found


def _prune(osm: Osm, there: Target, applied: Applied) -> None:
    """Packages of the deployment that nothing needs: network services before their functions."""
    for collection, record in _unneeded(there):
        name = str(record.get("id") or record["_id"])
        try:
            osm.remove(collection, str(record["_id"]))
        except ScanError as error:
            if not (isinstance(error, Refused) and error.status == 409):  # an instance that failed to go has it still
                applied.failed[name] = error
            continue
        applied.done.append(Change(name, "removed"))


def _unneeded(there: Target) -> list[tuple[str, dict[str, Any]]]:
    """Records of packages that aren't wanted, or twice, by their collections; network services first."""
    found = []
    for collection in (SERVICES, FUNCTIONS):
        records = there.records[collection]
        needed = [record_of(one, records) for one in there.packages.values() if collection_of(one) == collection]
        keep = {str(one["_id"]) for one in needed if one}
        found += [(collection, one) for one in records if str(one["_id"]) not in keep]
    return found


def failure(applied: Applied) -> StepError | None:
    """What to say of what failed; None: nothing did."""
    if not applied.failed:
        return None
    name, first = next(iter(applied.failed.items()))
    others = len(applied.failed) - 1
    cause = first.cause + (f"; {others} more failed" if others else "")
    return StepError(name if first.where == name else f"{name}: {first.where}", cause, first.remedy)
