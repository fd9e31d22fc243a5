"""OSM's northbound interface (ETSI GS NFV-SOL 005), as far as services need it: a client.

What may be done twice is tried again; what makes or fills something (POST, PUT) never is, as its answer may be lost and
its work not: who asked looks at what is there and goes on from that (`lifecycle`).
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import httpx

from scan2sim.pipeline.core.errors import SettingError, StepError, UnavailableError, printable
from scan2sim.services.orchestration.package import Package
from scan2sim.services.orchestration.settings import Connection

TOKENS = "/osm/admin/v1/tokens"
FUNCTIONS = "/osm/vnfpkgm/v1/vnf_packages"
SERVICES = "/osm/nsd/v1/ns_descriptors"
INSTANCES = "/osm/nslcm/v1/ns_instances"
OPERATIONS = "/osm/nslcm/v1/ns_lcm_op_occs"
VIMS = "/osm/admin/v1/vim_accounts"
CLUSTERS = "/osm/admin/v1/k8sclusters"

logging.getLogger("httpcore").setLevel(logging.WARNING)  # it would log the token, which OSM sends as an address, too

PATIENCE = 30.0
"""Seconds for an answer."""
TRIES = 4
"""Of what may be done twice."""
TOKENS_TRIED = 3
"""Of a request that is refused for its token."""
PAUSE = 0.5
"""Seconds before it is asked again, twice as many each time."""
EARLY = 60.0
"""Seconds before its end at which a token is renewed."""
TOLD = 300
"""Characters of what OSM says of a fault."""

FAULTS: dict[int, tuple[str, str]] = {
    400: (
        "OSM takes the request for malformed",
        "It may be of another release than those in docs/orchestration.md",
    ),
    401: ("OSM refuses user, password or project", "Check --user, --project and the password"),
    403: ("this user may not do that in this project", "Ask OSM's administrator for a role that may"),
    404: ("OSM has no such thing (any more)", "`scan2sim orchestrate list` says what there is"),
    405: ("this OSM can't do that", "It may be of an older release"),
    406: ("OSM can't answer in JSON", "Check that --osm is the northbound interface's address"),
    409: ("OSM says that this contradicts what is there", "`scan2sim orchestrate list` says what there is"),
    413: ("it is too large for OSM", "Make the package smaller, or raise the limit of what stands before OSM"),
    416: ("OSM has no such part of it", "Run again"),
    422: ("OSM can't work with what was sent", "Mend what it names"),
    429: ("OSM was asked too often", "Run again in a while, with a smaller --parallel"),
    500: ("OSM failed", "Its log says why; run again"),
    502: ("what stands before OSM can't reach it", "Run again in a while"),
    503: ("OSM is busy or being started", "Run again in a while"),
    504: ("OSM didn't answer what stands before it in time", "Run again in a while"),
}
"""By status: what it means, and what to do."""
PASSING = (429, 502, 503, 504)
"""Statuses that may be others a moment later."""


class Refused(StepError):
    """What OSM answered in place of doing it.

    Attributes:
        status: of HTTP.
    """

    def __init__(self, where: str, cause: str, remedy: str, status: int = 500) -> None:
        super().__init__(where, cause, remedy)
        self.args = (where, cause, remedy, status)
        self.status = status


class Unsure(StepError):
    """A connection that broke before an answer came: what was asked for may have been done."""


class Osm:
    """A user's view of OSM; may be asked from many threads."""

    def __init__(self, connection: Connection, *, asked: Callable[[], None] | None = None) -> None:
        """Of a connection; nothing is sent yet. `asked` is called before each request.

        Raises:
            ScanError: as the connection's parts.
        """
        self._address, self._password = connection.northbound(), connection.login()
        self._user = connection.user or os.environ.get("OSM_USER", "admin")
        self._project = connection.project or os.environ.get("OSM_PROJECT", "admin")
        self._client = httpx.Client(
            base_url=self._address, verify=connection.trust(), timeout=PATIENCE, headers={"Accept": "application/json"}
        )
        self._asked, self._lock = asked, threading.Lock()
        self._token, self._expires = "", 0.0

    def close(self) -> None:
        """Close what is open."""
        self._client.close()

    def __enter__(self) -> Osm:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # packages

    def packages(self, collection: str) -> list[dict[str, Any]]:
        """All of `FUNCTIONS` or `SERVICES`."""
        return self._list(collection)

    def onboard(self, package: Package, marks: Mapping[str, str]) -> str:
        """Make a record for a package and send it; returns the record's id.

        Args:
            marks: what is kept beside it, so that it can be told whose it is before it has a name.
        """
        collection = collection_of(package)
        made = self._ask("POST", collection, {"userDefinedData": dict(marks)})
        self.fill(package, made["id"])
        return str(made["id"])

    def fill(self, package: Package, record: str) -> None:
        """Send a package's content to a record that has none."""
        content = "package_content" if package.descriptor.sort == "vnfd" else "nsd_content"
        headers = {"Content-Type": "application/gzip", "Content-File-MD5": package.md5}
        self._ask("PUT", f"{collection_of(package)}/{record}/{content}", package.data, headers)

    def remove(self, collection: str, record: str) -> None:
        """Delete a package's record, or an instance's; one that is gone is well."""
        try:
            self._ask("DELETE", f"{collection}/{record}")
        except Refused as error:
            if error.status != 404:
                raise

    # instances

    def instances(self) -> list[dict[str, Any]]:
        """All of network services."""
        return self._list(INSTANCES)

    def instance(self, which: str) -> dict[str, Any]:
        """One of them."""
        return dict(self._ask("GET", f"{INSTANCES}/{which}"))

    def operations(self, instance: str) -> list[dict[str, Any]]:
        """Of an instance, in the order in which they began."""
        found = self._list(f"{OPERATIONS}?nsInstanceId={instance}")
        ours = [one for one in found if one.get("nsInstanceId") == instance]
        return sorted(ours, key=lambda one: one.get("startTime", 0))

    def operation(self, which: str) -> dict[str, Any]:
        """One of them."""
        return dict(self._ask("GET", f"{OPERATIONS}/{which}"))

    def create(self, body: Mapping[str, Any]) -> str:
        """An instance that isn't instantiated; returns its id."""
        return str(self._ask("POST", INSTANCES, body)["id"])

    def act(self, instance: str, what: str, body: Mapping[str, Any]) -> str:
        """Begin `instantiate`, `terminate`, `scale`, `heal` or `action`; returns the operation's id."""
        return str(self._ask("POST", f"{INSTANCES}/{instance}/{what}", body)["id"])

    # sites

    def vim(self, name: str) -> str:
        """Id of a VIM account by its name or id.

        Raises:
            SettingError: there is none.
        """
        return str(self._named(VIMS, name, "VIM account")["_id"])

    def cluster(self, name: str) -> str:
        """Id of the VIM account of a Kubernetes cluster by its name or id.

        Raises:
            SettingError: there is none.
        """
        return str(self._named(CLUSTERS, name, "Kubernetes cluster")["vim_account"])

    def _named(self, collection: str, name: str, what: str) -> dict[str, Any]:
        found = self._list(collection)
        chosen = [one for one in found if name in (one.get("name"), one.get("_id"))]
        if len(chosen) != 1:
            known = ", ".join(sorted(str(one.get("name")) for one in found)) or "none"
            count = "no" if not chosen else "more than one"
            raise SettingError(name, f"there is {count} {what} of that name in OSM", f"There are: {known}")
        return chosen[0]

    # requests

    def _list(self, path: str) -> list[dict[str, Any]]:
        found = self._ask("GET", path)
        if not isinstance(found, list):
            raise Refused(path, "OSM's answer is no list", "Check that --osm is the northbound interface's address")
        return found

    def _ask(self, method: str, path: str, body: Any = None, headers: Mapping[str, str] = {}) -> Any:
        """Ask with a token that is good, again where that does no harm."""
        for left in reversed(range(TRIES if method in ("GET", "DELETE") else 1)):
            try:
                return self._ask_once(method, path, body, headers)
            except Unsure:
                if not left:
                    raise
            except Refused as error:
                if not left or error.status not in PASSING:
                    raise
            pause(TRIES - left - 1)
        raise AssertionError

    def _ask_once(self, method: str, path: str, body: Any, headers: Mapping[str, str]) -> Any:
        token = self._fresh()
        answer = self._send(method, path, body, headers, token)
        for _ in range(TOKENS_TRIED):
            if answer.status_code != 401:
                break
            token = self._fresh(refused=token)  # it may have been taken back before its time
            answer = self._send(method, path, body, headers, token)
        return _content(answer, f"{method} {path}")

    def _fresh(self, refused: str = "") -> str:
        """A token that is good for a while, and not the one that was refused."""
        with self._lock:
            if time.time() > self._expires - EARLY or self._token == refused:
                given = {"username": self._user, "password": self._password, "project_id": self._project}
                told = _content(self._send("POST", TOKENS, given, {}, None), f"POST {TOKENS}")
                self._token = str(told["id"])
                now, ends = time.time(), float(told.get("expires", 0))
                self._expires = ends if ends > now + EARLY else now + 2 * EARLY  # its clock may be another one
            return self._token

    def _send(self, method: str, path: str, body: Any, headers: Mapping[str, str], token: str | None) -> httpx.Response:
        if self._asked:
            self._asked()
        sent = dict(headers) | ({"Authorization": f"Bearer {token}"} if token else {})
        content = {"content": body} if isinstance(body, bytes) else {"json": body} if body is not None else {}
        try:
            return self._client.request(method, path, headers=sent, **content)
        except httpx.ConnectError as error:
            if "CERTIFICATE" in str(error).upper():
                cause = f"its certificate isn't trusted ({error})"
                raise UnavailableError(self._address, cause, "Give --ca, the authority that signed it") from None
            cause = f"can't be reached ({error})"
            raise UnavailableError(self._address, cause, "Check --osm, and that it runs") from None
        except httpx.HTTPError as error:
            cause = f"the connection broke before an answer came ({type(error).__name__})"
            raise Unsure(f"{method} {path}", cause, "Run again: it goes on from what is there") from None


def pause(times: int) -> None:
    """Wait before something is tried again, so many times after the first."""
    time.sleep(PAUSE * 2**times)


def collection_of(package: Package) -> str:
    """Where its kind of packages is kept."""
    return FUNCTIONS if package.descriptor.sort == "vnfd" else SERVICES


def _content(answer: httpx.Response, where: str) -> Any:
    """What an answer says.

    Raises:
        Refused: it is a refusal.
    """
    if answer.is_success:
        if not answer.content:
            return {}
        try:
            return answer.json()
        except ValueError:
            raise Refused(where, "OSM's answer is no JSON", FAULTS[406][1], answer.status_code) from None
    cause, remedy = FAULTS.get(answer.status_code, ("OSM answered what it doesn't say it would", FAULTS[500][1]))
    raise Refused(where, f"{cause} ({answer.status_code}{_detail(answer)})", remedy, answer.status_code)


def _detail(answer: httpx.Response) -> str:
    try:
        told = answer.json()
        detail = told.get("detail") if isinstance(told, dict) else None
    except (ValueError, json.JSONDecodeError):
        detail = None
    return f": {printable(str(detail))[:TOLD]}" if detail else ""
