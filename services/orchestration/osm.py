"""Client of OSM's northbound interface (ETSI GS NFV-SOL 005).

Idempotent requests (GET, DELETE) are retried, and all while OSM refuses connections (it restarts) after it had answered
before. Other POST and PUT are never retried: if their response is lost, the request may have succeeded, so the caller
reads the current state and continues from there (`lifecycle`). Every answer is validated (`records`) before it is used.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import httpx
from pydantic_core import from_json

from scan2sim.pipeline.core.errors import SettingError, StepError, UnavailableError, printable
from scan2sim.services.credentials import redacted, secrets_of, without
from scan2sim.services.orchestration import certificates, records
from scan2sim.services.orchestration.package import Package
from scan2sim.services.orchestration.records import (
    Created,
    InstanceRecord,
    OperationRecord,
    PackageRecord,
    SiteRecord,
    SliceCreated,
    SliceRecord,
    TemplateRecord,
)
from scan2sim.services.orchestration.settings import Connection

TOKENS = "/osm/admin/v1/tokens"
FUNCTIONS = "/osm/vnfpkgm/v1/vnf_packages"
SERVICES = "/osm/nsd/v1/ns_descriptors"
INSTANCES = "/osm/nslcm/v1/ns_instances"
OPERATIONS = "/osm/nslcm/v1/ns_lcm_op_occs"
VIMS = "/osm/admin/v1/vim_accounts"
CLUSTERS = "/osm/admin/v1/k8sclusters"
REPOSITORIES = "/osm/admin/v1/k8srepos"
TEMPLATES = "/osm/nst/v1/netslice_templates"
SLICES = "/osm/nsilcm/v1/netslice_instances"
SLICE_OPERATIONS = "/osm/nsilcm/v1/nsi_lcm_op_occs"
SITE_KINDS = {VIMS: "VIM account", CLUSTERS: "Kubernetes cluster", REPOSITORIES: "Helm repository"}

logging.getLogger("httpcore").setLevel(logging.WARNING)  # it would log the token, which is part of some URLs
log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 10.0
"""Seconds to wait for a connection."""
RESPONSE_TIMEOUT_S = 60.0
"""Seconds to wait for a whole response; uploads of large packages take OSM long."""
SLOW_RESPONSE_S = 10.0
"""Seconds without a response after which this is reported."""
MAX_RESPONSE_BYTES = 64 * 2**20
"""Maximum size of a response, decompressed."""
MAX_ATTEMPTS = 4
"""Attempts of an idempotent request."""
MAX_TOKEN_RENEWALS = 3
"""Attempts with a renewed token after a request was rejected with 401."""
RETRY_DELAY_S = 0.5
"""Seconds before the first retry; doubled for each further one."""
TOKEN_RENEWAL_MARGIN_S = 60.0
"""Seconds before its expiry at which a token is renewed."""
ERROR_DETAIL_MAX_CHARS = 300
"""Maximum length of OSM's error detail in messages."""

HTTP_ERRORS: dict[int, tuple[str, str]] = {
    400: (
        "OSM rejected the request as malformed",
        "Check that its release is one of those in docs/orchestration.md",
    ),
    401: ("OSM rejected user, password or project", "Check --user, --project and the password"),
    403: ("permission denied in this project", "Ask OSM's administrator for a role with this permission"),
    404: ("not found in OSM", "`scan2sim orchestrate list` lists what exists"),
    405: ("not supported by this OSM", "Its release may be too old"),
    406: ("OSM can't answer in JSON", "Check that --osm is the northbound interface's address"),
    409: ("conflict with the current state of OSM", "`scan2sim orchestrate list` lists what exists"),
    413: ("too large for OSM", "Make the package smaller, or raise the size limit of the proxy in front of OSM"),
    416: ("OSM rejected the requested range", "Run again"),
    422: ("OSM can't process the request", "Fix what the message names"),
    429: ("too many requests to OSM", "Run again later, with a smaller --parallel"),
    500: ("internal error of OSM", "See its log; run again"),
    502: ("the proxy in front of OSM can't reach it", "Run again later"),
    503: ("OSM is busy or starting", "Run again later"),
    504: ("OSM didn't respond to its proxy in time", "Run again later"),
}
"""Cause and remedy by HTTP status."""
TRANSIENT_STATUSES = (429, 502, 503, 504)
"""HTTP statuses after which a request is retried."""


REFUSAL_STATUSES = (400, 405, 409, 413, 422)
"""HTTP statuses of an upload that can't succeed later: its empty record is deleted."""
OLD_RELEASE_DETAILS = ("must be a list of only one element", "vnfd-catalog", "nsd-catalog")
"""Parts of the answers of Release 8 and older to descriptors of SOL006."""
OLD_RELEASE = (
    "this OSM is older than Release 9: it doesn't know SOL006, the model of these packages",
    "Upgrade OSM; docs/orchestration.md lists the supported releases",
)
UNEXPECTED_FORM_REMEDY = "Check that --osm is the northbound interface of a release in docs/orchestration.md"


class OsmError(StepError):
    """Error response of OSM.

    Attributes:
        status: HTTP status.
    """

    def __init__(self, where: str, cause: str, remedy: str, status: int = 500) -> None:
        super().__init__(where, cause, remedy)
        self.args = (where, cause, remedy, status)
        self.status = status


class ResponseLost(StepError):
    """The connection broke before a response was received; the request may have been executed."""


class ConnectionRefused(ResponseLost):
    """OSM, which answered before, refuses connections: the request wasn't executed."""


class ResponseOverdue(ResponseLost):
    """No response within `RESPONSE_TIMEOUT_S`."""


Answer = TypeVar("Answer")


def _warn_slow(text: str) -> None:
    log.warning("%s", text)


class Osm:
    """OSM client of one user; thread-safe."""

    def __init__(
        self,
        connection: Connection,
        *,
        before_request: Callable[[], None] | None = None,
        on_slow: Callable[[str], None] = _warn_slow,
    ) -> None:
        """Prepare a client; nothing is sent yet.

        Args:
            before_request: called before each request.
            on_slow: called with a message when a response takes longer than `SLOW_RESPONSE_S`.

        Raises:
            ScanError: address, password or certificate are missing or invalid.
        """
        self._address, self._password = connection.northbound_url(), connection.read_password()
        self._user = connection.user or os.environ.get("OSM_USER", "admin")
        self._project = connection.project or os.environ.get("OSM_PROJECT", "admin")
        self._tls = connection.ssl_context()
        self._client = httpx.Client(
            base_url=self._address,
            verify=self._tls,
            timeout=httpx.Timeout(RESPONSE_TIMEOUT_S, connect=CONNECT_TIMEOUT_S),
            headers={"Accept": "application/json"},
        )
        self._before_request, self._on_slow, self._lock = before_request, on_slow, threading.Lock()
        self._token, self._expires, self._answered = "", 0.0, False

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def __enter__(self) -> Osm:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # packages

    def packages(self, collection: str) -> list[PackageRecord]:
        """Package records in `FUNCTIONS` or `SERVICES`."""
        return self._get(list[PackageRecord], collection)

    def onboard(self, package: Package, tags: Mapping[str, str]) -> str:
        """Create a record for a package and upload the package; returns the record's id.

        Args:
            tags: user-defined data of the record, which identify its owner before the upload has given it a name.
        """
        made = self._post(collection_of(package), {"userDefinedData": dict(tags)})
        self.fill(package, made)
        return made

    def fill(self, package: Package, record: str) -> None:
        """Upload a package's content to an empty record.

        Raises:
            OsmError: OSM refuses the package; then the record is deleted, as it would stay empty.
        """
        content = "package_content" if package.descriptor.type == "vnfd" else "nsd_content"
        headers = {"Content-Type": "application/gzip", "Content-File-MD5": package.md5}
        path = f"{collection_of(package)}/{record}"
        try:
            self._request("PUT", f"{path}/{content}", package.data, headers)
        except OsmError as error:
            if error.status in REFUSAL_STATUSES:
                self._discard(path)
            if any(part in error.cause for part in OLD_RELEASE_DETAILS):
                raise OsmError(package.name, *OLD_RELEASE, error.status) from None
            raise

    def _discard(self, path: str) -> None:
        try:
            self._request("DELETE", path)
        except StepError as error:
            log.warning("the empty record %s stays in OSM: %s", path, error)

    def remove(self, collection: str, record: str) -> None:
        """Delete a record; no error if it doesn't exist."""
        try:
            self._request("DELETE", f"{collection}/{record}")
        except OsmError as error:
            if error.status != 404:
                raise

    # instances

    def instances(self) -> list[InstanceRecord]:
        """Records of all network service instances."""
        return self._get(list[InstanceRecord], INSTANCES)

    def instance(self, instance_id: str) -> InstanceRecord:
        """Record of an instance."""
        return self._get(InstanceRecord, f"{INSTANCES}/{instance_id}")

    def operations(self, instance: str) -> list[OperationRecord]:
        """Operations of an instance in the order of their start."""
        found = self._get(list[OperationRecord], f"{OPERATIONS}?nsInstanceId={instance}")
        return sorted((one for one in found if one.instance == instance), key=lambda one: one.started)

    def operation(self, operation_id: str, collection: str = OPERATIONS) -> OperationRecord:
        """Record of an operation in `OPERATIONS` or `SLICE_OPERATIONS`."""
        return self._get(OperationRecord, f"{collection}/{operation_id}")

    def create(self, body: Mapping[str, Any]) -> str:
        """Create an instance that isn't instantiated yet; returns its id."""
        return self._post(INSTANCES, body)

    def start_operation(self, instance: str, kind: str, body: Mapping[str, Any]) -> str:
        """Start `instantiate`, `terminate`, `scale`, `heal` or `action`; returns the operation's id."""
        return self._post(f"{INSTANCES}/{instance}/{kind}", body)

    # sites

    def sites(self, collection: str) -> list[SiteRecord]:
        """Records in `VIMS`, `CLUSTERS` or `REPOSITORIES`."""
        return self._get(list[SiteRecord], collection)

    def add_site(self, collection: str, body: Mapping[str, Any]) -> str:
        """Create a record in `VIMS`, `CLUSTERS` or `REPOSITORIES`; returns its id."""
        return self._post(collection, body)

    def vim(self, name: str) -> str:
        """Id of the VIM account with this name or id.

        Raises:
            SettingError: there is none or more than one.
        """
        return self.site(VIMS, name).record

    def cluster(self, name: str) -> str:
        """Id of the VIM account of the Kubernetes cluster with this name or id.

        Raises:
            SettingError: there is none or more than one.
        """
        return self.site(CLUSTERS, name).vim

    def site(self, collection: str, name: str) -> SiteRecord:
        """Record in `VIMS`, `CLUSTERS` or `REPOSITORIES` with this name or id.

        Raises:
            SettingError: there is none or more than one.
        """
        found = self.sites(collection)
        chosen = [one for one in found if name in (one.name, one.record)]
        if len(chosen) != 1:
            known = ", ".join(sorted(one.name for one in found)) or "none"
            count = "no" if not chosen else "more than one"
            raise SettingError(name, f"OSM has {count} {SITE_KINDS[collection]} of this name", f"Available: {known}")
        return chosen[0]

    # network slices

    def templates(self) -> list[TemplateRecord]:
        """Records of all network slice templates."""
        return self._get(list[TemplateRecord], TEMPLATES)

    def add_template(self, data: bytes, media_type: str) -> str:
        """Upload a template, YAML or a .tar.gz package; returns its record's id."""
        path, headers = f"{TEMPLATES}_content", {"Content-Type": media_type}
        return _validated(Created, self._request("POST", path, data, headers), f"POST {path}").id

    def slices(self) -> list[SliceRecord]:
        """Records of all network slice instances."""
        return self._get(list[SliceRecord], SLICES)

    def create_slice(self, body: Mapping[str, Any]) -> str:
        """Create and instantiate a slice; returns the operation's id."""
        path = f"{SLICES}_content"
        return _validated(SliceCreated, self._request("POST", path, body), f"POST {path}").operation

    def remove_slice(self, record: str) -> None:
        """Terminate a slice and its network services; OSM then removes its record."""
        self.remove(f"{SLICES}_content", record)

    # requests

    def _get(self, kind: type[Answer], path: str) -> Answer:
        return _validated(kind, self._request("GET", path), f"GET {path}")

    def _post(self, path: str, body: Mapping[str, Any]) -> str:
        """Create something; returns its id."""
        return _validated(Created, self._request("POST", path, body), f"POST {path}").id

    def _request(self, method: str, path: str, body: Any = None, headers: Mapping[str, str] = {}) -> Any:
        """Send a request with a valid token; retry it if that is safe."""
        for left in reversed(range(MAX_ATTEMPTS)):
            try:
                return self._request_once(method, path, body, headers)
            except (ResponseLost, OsmError) as error:
                if not left or not _may_retry(method, error):
                    raise
            back_off(MAX_ATTEMPTS - left - 1)
        raise AssertionError

    def _request_once(self, method: str, path: str, body: Any, headers: Mapping[str, str]) -> Any:
        token = self._valid_token()
        status, answer = self._send(method, path, body, headers, token)
        for _ in range(MAX_TOKEN_RENEWALS):
            if status != 401:
                break
            token = self._valid_token(rejected=token)  # OSM may revoke a token before its expiry
            status, answer = self._send(method, path, body, headers, token)
        return _checked(status, answer, f"{method} {path}", body)

    def _valid_token(self, rejected: str = "") -> str:
        """A token that isn't about to expire and isn't the rejected one; logs in if necessary."""
        with self._lock:
            if time.time() > self._expires - TOKEN_RENEWAL_MARGIN_S or self._token == rejected:
                credentials = {"username": self._user, "password": self._password, "project_id": self._project}
                where = f"POST {TOKENS}"
                try:
                    answer = _checked(*self._send("POST", TOKENS, credentials, {}, None), where, credentials)
                except OsmError as error:
                    if error.status == 404:
                        cause = f"OSM doesn't know the project {self._project} ({error.status})"
                        raise OsmError(where, cause, "Check --project and --osm", error.status) from None
                    raise
                created = _validated(records.Token, answer, where)
                self._token = created.id
                now, ends = time.time(), created.expires
                # OSM's clock may differ from this one
                self._expires = ends if ends > now + TOKEN_RENEWAL_MARGIN_S else now + 2 * TOKEN_RENEWAL_MARGIN_S
            return self._token

    def _send(
        self, method: str, path: str, body: Any, headers: Mapping[str, str], token: str | None
    ) -> tuple[int, bytes]:
        """Status and body of the response; of a redirect, its target in place of the body."""
        if self._before_request:
            self._before_request()
        where = f"{method} {path}"
        all_headers = dict(headers) | ({"Authorization": f"Bearer {token}"} if token else {})
        content = {"content": body} if isinstance(body, bytes) else {"json": body} if body is not None else {}
        try:
            with self._notify_slow(where), self._client.stream(method, path, headers=all_headers, **content) as found:
                self._answered = True
                if found.is_redirect:
                    return found.status_code, found.headers.get("location", "").encode()
                return found.status_code, _read_bounded(found, where)
        except httpx.ConnectError as error:
            if "CERTIFICATE" in str(error).upper():
                raise certificates.untrusted(self._address, str(error), self._tls) from None
            raise self._not_connected(where, str(error)) from None
        except httpx.ConnectTimeout:
            raise self._not_connected(where, f"no answer within {CONNECT_TIMEOUT_S:g} s") from None
        except httpx.TimeoutException:
            raise _overdue(where) from None
        except (httpx.HTTPError, httpx.InvalidURL, httpx.StreamError) as error:
            cause = f"the connection broke before a response was received ({type(error).__name__})"
            raise ResponseLost(where, cause, "Run again to continue from the current state") from None

    def _not_connected(self, where: str, reason: str) -> StepError | UnavailableError:
        cause = f"can't connect ({reason})"
        if self._answered:
            return ConnectionRefused(where, cause, "OSM has answered before: wait until it is back, and run again")
        return UnavailableError(self._address, cause, "Check --osm, and that OSM is running")

    @contextmanager
    def _notify_slow(self, where: str) -> Iterator[None]:
        text = f"OSM has not answered {where} for {SLOW_RESPONSE_S:g} s; waiting up to {RESPONSE_TIMEOUT_S:g} s"
        timer = threading.Timer(SLOW_RESPONSE_S, self._on_slow, (text,))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()


def _may_retry(method: str, error: StepError) -> bool:
    """Whether a failed request can be sent again without doing anything twice, and without waiting for long."""
    if isinstance(error, ConnectionRefused):
        return True
    if method not in ("GET", "DELETE") or isinstance(error, ResponseOverdue):
        return False
    return is_transient(error)


def is_transient(error: StepError) -> bool:
    """Whether a failed request may succeed later without a change: its response was lost, or OSM is busy."""
    return not isinstance(error, OsmError) or error.status in TRANSIENT_STATUSES


def _overdue(where: str) -> ResponseOverdue:
    cause = f"OSM didn't answer within {RESPONSE_TIMEOUT_S:g} s"
    return ResponseOverdue(where, cause, "Check its load, and run again to continue from the current state")


def _read_bounded(response: httpx.Response, where: str) -> bytes:
    """Body of a response: limited in size, and in time even if each byte comes in time."""
    ends, body = time.monotonic() + RESPONSE_TIMEOUT_S, bytearray()
    for part in response.iter_bytes():
        body += part
        if len(body) > MAX_RESPONSE_BYTES:
            cause = f"OSM's response is larger than {MAX_RESPONSE_BYTES:,} bytes"
            raise OsmError(where, cause, HTTP_ERRORS[406][1], response.status_code)
        if time.monotonic() > ends:
            raise _overdue(where)
    return bytes(body)


def back_off(retry: int) -> None:
    """Wait before retry number `retry`, counted from 0: exponential backoff."""
    time.sleep(RETRY_DELAY_S * 2**retry)


def collection_of(package: Package) -> str:
    """Collection of OSM that stores this kind of package."""
    return FUNCTIONS if package.descriptor.type == "vnfd" else SERVICES


def _checked(status: int, body: bytes, where: str, sent: Any) -> Any:
    """Decoded body of a response.

    Args:
        status, body: of the response.
        where: the request, for messages.
        sent: body of the request, whose credentials OSM's messages may quote.

    Raises:
        OsmError: it is an error response, or not JSON.
    """
    if 200 <= status < 300:
        if not body:
            return {}
        try:
            return from_json(body, allow_inf_nan=False)
        except ValueError:
            raise OsmError(where, "OSM's response isn't JSON", HTTP_ERRORS[406][1], status) from None
    if 300 <= status < 400:
        target = printable(body.decode("utf-8", "replace"))[:ERROR_DETAIL_MAX_CHARS] or "another address"
        cause = f"the server redirects to {redacted(target)} ({status})"
        raise OsmError(where, cause, "Give --osm the address of the northbound interface itself", status)
    cause, remedy = HTTP_ERRORS.get(status, ("unexpected response of OSM", HTTP_ERRORS[500][1]))
    raise OsmError(where, f"{cause} ({status}{_detail(body, sent)})", remedy, status)


def _detail(body: bytes, sent: Any) -> str:
    try:
        found = from_json(body)
    except ValueError:
        return ""
    detail = found.get("detail") if isinstance(found, dict) else None
    return f": {printable(without(str(detail), secrets_of(sent)))[:ERROR_DETAIL_MAX_CHARS]}" if detail else ""


def _validated(kind: type[Answer], answer: Any, where: str) -> Answer:
    """An answer in the form that is expected.

    Raises:
        OsmError: it has another one.
    """
    try:
        return records.read(kind, answer)
    except ValueError as error:
        cause = f"OSM's response doesn't have the expected form ({error})"
        raise OsmError(where, cause, UNEXPECTED_FORM_REMEDY, 200) from None
