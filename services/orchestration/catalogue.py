"""Services as a person sees them: packages in a folder, what OSM has of them, and what is being done."""

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
from scan2sim.services.orchestration.instance import Instance
from scan2sim.services.orchestration.lifecycle import Patience
from scan2sim.services.orchestration.osm import FUNCTIONS, SERVICES, Osm
from scan2sim.services.orchestration.package import Package

log = logging.getLogger(__name__)

KEPT = 2.0
"""Seconds for which what OSM said is shown again."""
MOST = 200
"""Packages of a folder."""


@dataclass(frozen=True)
class Shown:
    """A service.

    Attributes:
        id: of its network service's descriptor; title: for people.
        functions: ids of its functions; missing: those whose packages aren't here.
        onboarded: whether OSM has all of its packages.
        instances: name and state of each in OSM.
        doing: what is being done; failed: why the last thing wasn't, "" where it was.
    """

    id: str
    title: str
    functions: tuple[str, ...]
    missing: tuple[str, ...]
    onboarded: bool
    instances: tuple[tuple[str, str], ...]
    doing: str
    failed: str

    def facts(self) -> dict[str, Any]:
        """As JSON has them."""
        return asdict(self)


class Catalogue:
    """Of a folder's packages and an OSM; work on different services goes on at once."""

    def __init__(self, osm: Osm, folder: Path, site: Callable[[Osm], str]) -> None:
        """`site` says on which VIM account services are instantiated.

        Raises:
            InputError: the folder can't be made.
        """
        self._osm, self._folder, self._site = osm, folder, site
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(folder, f"is no folder ({error.strerror})", "Name another one") from None
        self._pool, self._lock = ThreadPoolExecutor(4, "catalogue"), threading.Lock()
        self._read: dict[Path, tuple[int, Package | None]] = {}
        self._doing: dict[str, str] = {}
        self._failed: dict[str, str] = {}
        self._seen: tuple[float, list[dict[str, Any]], set[str]] = (0.0, [], set())
        self._ended = threading.Event()

    def close(self) -> None:
        """End when what is begun may be left: nothing is undone."""
        self._ended.set()
        self._pool.shutdown(cancel_futures=True)

    def services(self) -> list[Shown]:
        """All whose network service is in the folder.

        Raises:
            ScanError: OSM can't be asked.
        """
        packages = self._packages()
        instances, onboarded = self._ask()
        functions = {one.descriptor.id for one in packages if one.descriptor.sort == "vnfd"}
        shown = []
        for one in packages:
            found = one.descriptor
            if found.sort != "nsd":
                continue
            there = [Instance.of(record, ()) for record in instances]
            shown.append(
                Shown(
                    id=found.id,
                    title=str(found.body["nsd"]["nsd"][0].get("description", "")),
                    functions=found.functions,
                    missing=tuple(name for name in found.functions if name not in functions | onboarded),
                    onboarded={f"nsd {found.id}", *found.functions} <= onboarded,
                    instances=tuple((each.name, each.state) for each in there if each.nsd == found.id),
                    doing=self._doing.get(found.id, ""),
                    failed=self._failed.get(found.id, ""),
                )
            )
        return shown

    def add(self, data: bytes) -> str:
        """Put a package into the folder; returns its descriptor's id.

        Raises:
            InputError: it is none, or the folder is full.
        """
        found = package.unpacked(data, "the upload")
        kept = Package(f"{found.descriptor.id}_{found.descriptor.sort}", data, found.descriptor)
        if "/" in kept.name or kept.name.startswith("."):
            raise InputError("the upload", f"{found.descriptor.id!r} can't be a file's name", "Give it another id")
        if len(list(self._folder.glob("*.tar.gz"))) >= MOST:
            raise InputError(self._folder, f"holds {MOST} packages already", "Remove some")
        with tempfile.NamedTemporaryFile(dir=self._folder, suffix=".part", delete=False) as file:
            file.write(data)
        Path(file.name).replace(self._folder / f"{kept.name}.tar.gz")
        return found.descriptor.id

    def onboard(self, service: str) -> None:
        """Begin to bring a service's packages into OSM."""
        packages = self._of(service)
        self._begin(service, "onboards", lambda: operations.onboard(self._osm, packages))

    def instantiate(self, service: str, name: str) -> None:
        """Begin to start an instance of a service."""
        self._of(service)
        site = self._site(self._osm)

        def work() -> None:
            patience = Patience(stop=self._ended.is_set)
            operations.instantiate(self._osm, name, service, site, patience=patience, say=self._say(service))

        self._begin(service, f"starts {name}", work)

    def delete(self, service: str) -> None:
        """Begin to remove a service's instances, and its packages from OSM."""
        packages = self._of(service)

        def work() -> None:
            operations.delete(self._osm, packages, Patience(stop=self._ended.is_set), self._say(service))

        self._begin(service, "removes it", work)

    def _of(self, service: str) -> list[Package]:
        """A service's packages, of those in the folder."""
        packages = self._packages()
        own = [one for one in packages if (one.descriptor.sort, one.descriptor.id) == ("nsd", service)]
        if not own:
            raise SettingError(service, "there is no such service", "Upload its packages")
        functions = own[0].descriptor.functions
        return own + [one for one in packages if one.descriptor.sort == "vnfd" and one.descriptor.id in functions]

    def _packages(self) -> list[Package]:
        found = []
        for path in sorted(self._folder.glob("*.tar.gz"))[:MOST]:
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

    def _ask(self) -> tuple[list[dict[str, Any]], set[str]]:
        """Instances, and ids of packages; those of network services behind `nsd `."""
        with self._lock:
            asked, instances, ids = self._seen
            if time.monotonic() > asked + KEPT:
                instances = self._osm.instances()
                ids = {str(one.get("id")) for one in self._osm.packages(FUNCTIONS)}
                ids |= {f"nsd {one.get('id')}" for one in self._osm.packages(SERVICES)}
                self._seen = time.monotonic(), instances, ids
            return instances, ids

    def _say(self, service: str) -> Callable[[str], None]:
        def say(text: str) -> None:
            self._doing[service] = text

        return say

    def _begin(self, service: str, what: str, work: Callable[[], object]) -> None:
        with self._lock:
            if service in self._doing:
                raise BusyError(service, f"is being worked on ({self._doing[service]})", "Wait for its end")
            self._doing[service] = what
            self._failed.pop(service, None)

        def run() -> None:
            try:
                work()
            except ScanError as error:
                self._failed[service] = str(error)
            finally:
                with self._lock:
                    del self._doing[service]
                    self._seen = (0.0, *self._seen[1:])

        self._pool.submit(run)
