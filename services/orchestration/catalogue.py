"""Catalogue of services for the web page: packages in a folder, their state in OSM, and running jobs."""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import BusyError, InputError, ScanError, SettingError
from scan2sim.services.orchestration import operations, package
from scan2sim.services.orchestration.lifecycle import WaitPolicy
from scan2sim.services.orchestration.osm import FUNCTIONS, SERVICES, Osm
from scan2sim.services.orchestration.package import Package
from scan2sim.services.orchestration.records import InstanceRecord

log = logging.getLogger(__name__)

CACHE_LIFETIME_S = 2.0
"""Seconds for which OSM's responses are cached."""
MAX_PACKAGES = 200
"""Maximum number of packages in a folder."""


@dataclass(frozen=True)
class ServiceStatus:
    """State of a service.

    Attributes:
        id: id of its network service's descriptor.
        title: title for people.
        functions: ids of its functions.
        missing: ids of its functions whose packages are neither in the folder nor in OSM.
        onboarded: whether OSM has all of its packages.
        instances: name and state of its instances in OSM.
        doing: the running job; empty if there is none.
        failed: error of the last job; empty if it succeeded.
    """

    id: str
    title: str
    functions: tuple[str, ...]
    missing: tuple[str, ...]
    onboarded: bool
    instances: tuple[tuple[str, str], ...]
    doing: str
    failed: str

    def as_json(self) -> dict[str, Any]:
        """As a dictionary for JSON."""
        return asdict(self)


class Catalogue:
    """Services of a folder of packages and an OSM. One job at a time runs for each service."""

    def __init__(self, osm: Osm, folder: Path, site: Callable[[Osm], str]) -> None:
        """`site` returns the id of the VIM account on which services are instantiated.

        Raises:
            InputError: the folder can't be created.
        """
        self._osm, self._folder, self._site = osm, folder, site
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(folder, f"not a folder ({error.strerror})", "Choose another one") from None
        self._pool, self._lock = ThreadPoolExecutor(4, "catalogue"), threading.Lock()
        self._read: dict[Path, tuple[int, Package | None]] = {}
        self._jobs: dict[str, str] = {}
        self._failed: dict[str, str] = {}
        self._osm_cache: tuple[float, list[InstanceRecord], set[str]] = (0.0, [], set())
        self._closing = threading.Event()

    def close(self) -> None:
        """Stop at the next safe point; nothing is undone."""
        self._closing.set()
        self._pool.shutdown(cancel_futures=True)

    def services(self) -> list[ServiceStatus]:
        """All services whose network service package is in the folder.

        Raises:
            ScanError: OSM can't be reached.
        """
        packages = self._packages()
        instances, onboarded = self._osm_state()
        functions = {one.descriptor.id for one in packages if one.descriptor.type == "vnfd"}
        statuses = []
        for one in packages:
            found = one.descriptor
            if found.type != "nsd":
                continue
            statuses.append(
                ServiceStatus(
                    id=found.id,
                    title=str(found.body["nsd"]["nsd"][0].get("description", "")),
                    functions=found.functions,
                    missing=tuple(name for name in found.functions if name not in functions | onboarded),
                    onboarded={f"nsd {found.id}", *found.functions} <= onboarded,
                    instances=tuple((each.name, each.state) for each in instances if each.descriptor == found.id),
                    doing=self._jobs.get(found.id, ""),
                    failed=self._failed.get(found.id, ""),
                )
            )
        return statuses

    def add(self, data: bytes) -> str:
        """Store a package in the folder; returns its descriptor's id.

        Raises:
            InputError: the package is invalid, or the folder is full.
        """
        found = package.parse(data, "the upload")
        stored = Package(f"{found.descriptor.id}_{found.descriptor.type}", data, found.descriptor)
        if "/" in stored.name or stored.name.startswith("."):
            raise InputError("the upload", f"{found.descriptor.id!r} isn't usable as a file name", "Change the id")
        if len(list(self._folder.glob("*.tar.gz"))) >= MAX_PACKAGES:
            raise InputError(self._folder, f"full: {MAX_PACKAGES} packages", "Remove some")
        with tempfile.NamedTemporaryFile(dir=self._folder, suffix=".part", delete=False) as file:
            file.write(data)
        Path(file.name).replace(self._folder / f"{stored.name}.tar.gz")
        return found.descriptor.id

    def onboard(self, service: str) -> None:
        """Start onboarding a service's packages into OSM."""
        packages = self._packages_of(service)
        self._start_job(service, "onboarding", lambda: operations.onboard(self._osm, packages))

    def instantiate(self, service: str, name: str) -> None:
        """Start an instance of a service."""
        self._packages_of(service)
        site = self._site(self._osm)

        def work() -> None:
            wait_policy = WaitPolicy(stop=self._closing.is_set)
            operations.instantiate(
                self._osm, name, service, site, wait_policy=wait_policy, notify=self._notify(service)
            )

        self._start_job(service, f"starting {name}", work)

    def delete(self, service: str) -> None:
        """Start removing a service's instances and its packages from OSM."""
        packages = self._packages_of(service)

        def work() -> None:
            operations.delete(self._osm, packages, WaitPolicy(stop=self._closing.is_set), self._notify(service))

        self._start_job(service, "removing", work)

    def _packages_of(self, service: str) -> list[Package]:
        """A service's packages in the folder."""
        packages = self._packages()
        own = [one for one in packages if (one.descriptor.type, one.descriptor.id) == ("nsd", service)]
        if not own:
            raise SettingError(service, "unknown service", "Upload its packages")
        functions = own[0].descriptor.functions
        return own + [one for one in packages if one.descriptor.type == "vnfd" and one.descriptor.id in functions]

    def _packages(self) -> list[Package]:
        found = []
        for path in sorted(self._folder.glob("*.tar.gz"))[:MAX_PACKAGES]:
            changed = path.stat().st_mtime_ns
            if self._read.get(path, (0, None))[0] != changed:
                try:
                    self._read[path] = changed, package.read(path)
                except InputError as error:
                    log.warning("%s", error)
                    self._read[path] = changed, None
            if (one := self._read[path][1]) is not None:
                found.append(one)
        return found

    def _osm_state(self) -> tuple[list[InstanceRecord], set[str]]:
        """Instances and ids of packages in OSM; those of network services have the prefix `nsd `."""
        with self._lock:
            fetched, instances, ids = self._osm_cache
            if time.monotonic() > fetched + CACHE_LIFETIME_S:
                instances = self._osm.instances()
                ids = {one.id for one in self._osm.packages(FUNCTIONS)}
                ids |= {f"nsd {one.id}" for one in self._osm.packages(SERVICES)}
                self._osm_cache = time.monotonic(), instances, ids
            return instances, ids

    def _notify(self, service: str) -> Callable[[str], None]:
        def notify(text: str) -> None:
            self._jobs[service] = text

        return notify

    def _start_job(self, service: str, what: str, work: Callable[[], object]) -> None:
        with self._lock:
            if service in self._jobs:
                raise BusyError(service, f"another job is running ({self._jobs[service]})", "Wait until it has ended")
            self._jobs[service] = what
            self._failed.pop(service, None)

        def run() -> None:
            try:
                work()
            except ScanError as error:
                self._failed[service] = str(error)
            finally:
                with self._lock:
                    del self._jobs[service]
                    self._osm_cache = (0.0, *self._osm_cache[1:])

        self._pool.submit(run)
