"""Client of OSM's northbound interface (ETSI GS NFV-SOL 005).

Idempotent requests (GET, DELETE) are retried. POST and PUT are never retried: if their response is lost, the
request may have succeeded, so the caller reads the current state and continues from there (`lifecycle`).
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

logging.getLogger("httpcore").setLevel(logging.WARNING)  # it would log the token, which is part of some URLs

RESPONSE_TIMEOUT_S = 30.0
"""Seconds to wait for a response."""
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


class Osm:
    """OSM client of one user; thread-safe."""

    def __init__(self, connection: Connection, *, before_request: Callable[[], None] | None = None) -> None:
        """Prepare a client; nothing is sent yet. `before_request` is called before each request.

        Raises:
            ScanError: address, password or certificate are missing or invalid.
        """
        self._address, self._password = connection.northbound_url(), connection.read_password()
        self._user = connection.user or os.environ.get("OSM_USER", "admin")
        self._project = connection.project or os.environ.get("OSM_PROJECT", "admin")
        self._client = httpx.Client(
            base_url=self._address,
            verify=connection.ssl_context(),
            timeout=RESPONSE_TIMEOUT_S,
            headers={"Accept": "application/json"},
        )
        self._before_request, self._lock = before_request, threading.Lock()
        self._token, self._expires = "", 0.0

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def __enter__(self) -> Osm:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # packages

    def packages(self, collection: str) -> list[dict[str, Any]]:
        """Package records in `FUNCTIONS` or `SERVICES`."""
        return self._list(collection)

    def onboard(self, package: Package, tags: Mapping[str, str]) -> str:
        """Create a record for a package and upload the package; returns the record's id.

        Args:
            tags: user-defined data of the record, which identify its owner before the upload has given it a name.
        """
        collection = collection_of(package)
        made = self._request("POST", collection, {"userDefinedData": dict(tags)})
        self.fill(package, made["id"])
        return str(made["id"])

    def fill(self, package: Package, record: str) -> None:
        """Upload a package's content to an empty record."""
        content = "package_content" if package.descriptor.type == "vnfd" else "nsd_content"
        headers = {"Content-Type": "application/gzip", "Content-File-MD5": package.md5}
        self._request("PUT", f"{collection_of(package)}/{record}/{content}", package.data, headers)

    def remove(self, collection: str, record: str) -> None:
        """Delete the record of a package or an instance; no error if it doesn't exist."""
        try:
            self._request("DELETE", f"{collection}/{record}")
        except OsmError as error:
            if error.status != 404:
                raise

    # instances

    def instances(self) -> list[dict[str, Any]]:
        """Records of all network service instances."""
        return self._list(INSTANCES)

    def instance(self, instance_id: str) -> dict[str, Any]:
        """Record of an instance."""
        return dict(self._request("GET", f"{INSTANCES}/{instance_id}"))

    def operations(self, instance: str) -> list[dict[str, Any]]:
        """Operations of an instance in the order of their start."""
        found = self._list(f"{OPERATIONS}?nsInstanceId={instance}")
        ours = [one for one in found if one.get("nsInstanceId") == instance]
        return sorted(ours, key=lambda one: one.get("startTime", 0))

    def operation(self, operation_id: str) -> dict[str, Any]:
        """Record of an operation."""
        return dict(self._request("GET", f"{OPERATIONS}/{operation_id}"))

    def create(self, body: Mapping[str, Any]) -> str:
        """Create an instance that isn't instantiated yet; returns its id."""
        return str(self._request("POST", INSTANCES, body)["id"])

    def start_operation(self, instance: str, kind: str, body: Mapping[str, Any]) -> str:
        """Start `instantiate`, `terminate`, `scale`, `heal` or `action`; returns the operation's id."""
        return str(self._request("POST", f"{INSTANCES}/{instance}/{kind}", body)["id"])

    # sites

    def vim(self, name: str) -> str:
        """Id of the VIM account with this name or id.

        Raises:
            SettingError: there is none or more than one.
        """
        return str(self._find(VIMS, name, "VIM account")["_id"])

    def cluster(self, name: str) -> str:
        """Id of the VIM account of the Kubernetes cluster with this name or id.

        Raises:
            SettingError: there is none or more than one.
        """
        return str(self._find(CLUSTERS, name, "Kubernetes cluster")["vim_account"])

    def _find(self, collection: str, name: str, kind: str) -> dict[str, Any]:
        found = self._list(collection)
        chosen = [one for one in found if name in (one.get("name"), one.get("_id"))]
        if len(chosen) != 1:
            known = ", ".join(sorted(str(one.get("name")) for one in found)) or "none"
            count = "no" if not chosen else "more than one"
            raise SettingError(name, f"OSM has {count} {kind} of this name", f"Available: {known}")
        return chosen[0]

    # requests

    def _list(self, path: str) -> list[dict[str, Any]]:
        found = self._request("GET", path)
        if not isinstance(found, list):
            raise OsmError(
                path, "OSM's response isn't a list", "Check that --osm is the northbound interface's address"
            )
        return found

    def _request(self, method: str, path: str, body: Any = None, headers: Mapping[str, str] = {}) -> Any:
        """Send a request with a valid token; retry it if it is idempotent."""
        for left in reversed(range(MAX_ATTEMPTS if method in ("GET", "DELETE") else 1)):
            try:
                return self._request_once(method, path, body, headers)
            except ResponseLost:
                if not left:
                    raise
            except OsmError as error:
                if not left or error.status not in TRANSIENT_STATUSES:
                    raise
            back_off(MAX_ATTEMPTS - left - 1)
        raise AssertionError

    def _request_once(self, method: str, path: str, body: Any, headers: Mapping[str, str]) -> Any:
        token = self._valid_token()
        response = self._send(method, path, body, headers, token)
        for _ in range(MAX_TOKEN_RENEWALS):
            if response.status_code != 401:
                break
            token = self._valid_token(rejected=token)  # OSM may revoke a token before its expiry
            response = self._send(method, path, body, headers, token)
        return _content(response, f"{method} {path}")

    def _valid_token(self, rejected: str = "") -> str:
        """A token that isn't about to expire and isn't the rejected one; logs in if necessary."""
        with self._lock:
            if time.time() > self._expires - TOKEN_RENEWAL_MARGIN_S or self._token == rejected:
                credentials = {"username": self._user, "password": self._password, "project_id": self._project}
                created = _content(self._send("POST", TOKENS, credentials, {}, None), f"POST {TOKENS}")
                self._token = str(created["id"])
                now, ends = time.time(), float(created.get("expires", 0))
                # OSM's clock may differ from this one
                self._expires = ends if ends > now + TOKEN_RENEWAL_MARGIN_S else now + 2 * TOKEN_RENEWAL_MARGIN_S
            return self._token

    def _send(self, method: str, path: str, body: Any, headers: Mapping[str, str], token: str | None) -> httpx.Response:
        if self._before_request:
            self._before_request()
        all_headers = dict(headers) | ({"Authorization": f"Bearer {token}"} if token else {})
        content = {"content": body} if isinstance(body, bytes) else {"json": body} if body is not None else {}
        try:
            return self._client.request(method, path, headers=all_headers, **content)
        except httpx.ConnectError as error:
            if "CERTIFICATE" in str(error).upper():
                cause = f"its certificate isn't trusted ({error})"
                raise UnavailableError(self._address, cause, "Give --ca, its certificate authority") from None
            cause = f"can't connect ({error})"
            raise UnavailableError(self._address, cause, "Check --osm, and that OSM is running") from None
        except httpx.HTTPError as error:
            cause = f"the connection broke before a response was received ({type(error).__name__})"
            raise ResponseLost(f"{method} {path}", cause, "Run again to continue from the current state") from None


def back_off(retry: int) -> None:
    """Wait before retry number `retry`, counted from 0: exponential backoff."""
    time.sleep(RETRY_DELAY_S * 2**retry)


def collection_of(package: Package) -> str:
    """Collection of OSM that stores this kind of package."""
    return FUNCTIONS if package.descriptor.type == "vnfd" else SERVICES


def _content(response: httpx.Response, where: str) -> Any:
    """Decoded body of a response.

    Raises:
        OsmError: it is an error response.
    """
    if response.is_success:
        if not response.content:
            return {}
        try:
            return response.json()
        except ValueError:
            raise OsmError(where, "OSM's response isn't JSON", HTTP_ERRORS[406][1], response.status_code) from None
    cause, remedy = HTTP_ERRORS.get(response.status_code, ("unexpected response of OSM", HTTP_ERRORS[500][1]))
    raise OsmError(where, f"{cause} ({response.status_code}{_detail(response)})", remedy, response.status_code)


def _detail(response: httpx.Response) -> str:
    try:
        body = response.json()
        detail = body.get("detail") if isinstance(body, dict) else None
    except (ValueError, json.JSONDecodeError):
        detail = None
    return f": {printable(str(detail))[:ERROR_DETAIL_MAX_CHARS]}" if detail else ""
