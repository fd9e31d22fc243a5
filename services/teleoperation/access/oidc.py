"""OpenID Connect: a provider's settings, and the exchange of an authorization code for who has signed in.

The ID token comes from the provider itself, over TLS whose certificate is verified; so its issuer is known without
verifying its signature (OpenID Connect Core 1.0, section 3.1.3.7, point 6).
"""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
import ssl
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from scan2sim.pipeline.core.errors import InputError, ScanError, UnavailableError
from scan2sim.pipeline.io import toml
from scan2sim.services.loopback import is_loopback

DOCUMENT = "docs/teleoperation.md describes the fields"
RESPONSE_TIMEOUT_S = 10.0
"""Maximum wait for a response of the provider."""
RESPONSE_MAX_BYTES = 200_000
"""Maximum size of a response."""
FAILURE_REPEATED_S = 5.0
"""Time for which the provider isn't contacted again after its metadata couldn't be read."""
CLOCK_TOLERANCE_S = 60.0
"""Accepted difference between the clocks of provider and station."""


class SignInError(ScanError):
    """A sign-in that the provider, or a check of its answer, rejected."""


class OidcParams(BaseModel):
    """An OpenID provider.

    Attributes:
        issuer: its address, as in its tokens.
        client_id: of the page, registered at the provider.
        client_secret_file: file with the client's secret; None: a public client.
        claim: claim that `login` of a driver is compared with.
        scopes: requested scopes; `openid` and those that contain the claim.
        hours: duration of a sign-in.
        ca: certificates (PEM) of the authority that signed the provider's; None: those that this machine trusts.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    issuer: Annotated[str, Field(pattern=r"^https?://[^?#\s]+$", max_length=500)]
    client_id: Annotated[str, Field(min_length=1, max_length=200)]
    client_secret_file: Path | None = None
    claim: Annotated[str, Field(min_length=1, max_length=100)] = "email"
    scopes: tuple[str, ...] = ("openid", "email")
    hours: Annotated[float, Field(gt=0, le=24)] = 8.0
    ca: Path | None = None


class _Endpoints(BaseModel):
    """What is used of the provider's metadata (OpenID Connect Discovery 1.0, section 3)."""

    issuer: str
    authorization_endpoint: str
    token_endpoint: str


@dataclass(frozen=True)
class Attempt:
    """A sign-in that has begun.

    Attributes:
        redirect: address to which the provider sends the browser back.
        state, nonce, verifier: random values that bind the answer to this browser, the ID token and the code to it.
        began: seconds of the monotonic clock.
    """

    redirect: str
    state: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    nonce: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    verifier: str = field(default_factory=lambda: secrets.token_urlsafe(48))
    began: float = field(default_factory=time.monotonic)


class Provider:
    """An OpenID provider; its methods are thread-safe, and wait for it."""

    def __init__(self, path: Path) -> None:
        """Read the settings of a TOML file; doesn't contact the provider.

        Raises:
            InputError: the file, the client's secret or the certificates can't be read, or aren't valid.
        """
        absent = ("file not found", "See docs/teleoperation.md for an example")
        self.params = toml.read(path, OidcParams, absent=absent, fields=DOCUMENT)
        _require_protected(path, self.params.issuer)
        self._secret = _read_secret(path, self.params.client_secret_file)
        self._context = _tls(path, self.params.ca)
        self._lock = threading.Lock()
        self._endpoints: _Endpoints | None = None
        self._failure: tuple[float, ScanError] | None = None

    def authorization_url(self, attempt: Attempt) -> str:
        """Address of the provider's page, to which the browser is sent.

        Raises:
            UnavailableError: the provider can't be reached, or its metadata aren't valid.
        """
        challenge = base64.urlsafe_b64encode(hashlib.sha256(attempt.verifier.encode()).digest()).rstrip(b"=")
        query = {
            "response_type": "code",
            "client_id": self.params.client_id,
            "redirect_uri": attempt.redirect,
            "scope": " ".join(self.params.scopes),
            "state": attempt.state,
            "nonce": attempt.nonce,
            "code_challenge": challenge.decode(),
            "code_challenge_method": "S256",
        }
        address = self._metadata().authorization_endpoint
        return f"{address}{'&' if '?' in address else '?'}{urllib.parse.urlencode(query)}"

    def login(self, attempt: Attempt, code: str) -> str:
        """Who has signed in: the claim of the ID token that the provider gives for an authorization code.

        Raises:
            UnavailableError: the provider can't be reached.
            SignInError: it rejects the code, or the ID token isn't valid for this attempt.
        """
        fields = {
            "grant_type": "authorization_code",
            "code": code,
            "redirect_uri": attempt.redirect,
            "client_id": self.params.client_id,
            "code_verifier": attempt.verifier,
        }
        headers = {}
        if self._secret is not None:
            pair = ":".join(urllib.parse.quote(one, safe="") for one in (self.params.client_id, self._secret))
            headers["Authorization"] = f"Basic {base64.b64encode(pair.encode()).decode()}"
        answer = self._request(self._metadata().token_endpoint, urllib.parse.urlencode(fields).encode(), headers)
        return self._claim(_claims(answer.get("id_token"), self.params.issuer), attempt)

    def _claim(self, claims: dict[str, Any], attempt: Attempt) -> str:
        audience, now = claims.get("aud"), time.time()
        audiences = audience if isinstance(audience, list) else [audience]
        expires, claim = claims.get("exp"), claims.get(self.params.claim)
        if claims.get("iss") != self.params.issuer:
            problem = f"is of another issuer ({claims.get('iss')!s:.100})"
        elif (
            self.params.client_id not in audiences or claims.get("azp", self.params.client_id) != self.params.client_id
        ):
            problem = "is for another client"
        elif not isinstance(expires, int | float) or expires < now - CLOCK_TOLERANCE_S:
            problem = "has expired: check the clocks of both"
        elif claims.get("nonce") != attempt.nonce:
            problem = "is of another sign-in"
        elif not isinstance(claim, str) or not claim:
            problem = f"has no claim `{self.params.claim}`: request its scope, or set another `claim`"
        elif self.params.claim == "email" and claims.get("email_verified", True) is not True:
            problem = "has an e-mail address that the provider hasn't verified"
        else:
            return claim
        raise SignInError(self.params.issuer, f"its ID token {problem}", "See the settings of --oidc, and try again")

    def _metadata(self) -> _Endpoints:
        """The provider's metadata; a failure is repeated for some seconds, so that nobody can occupy all threads."""
        with self._lock:
            if self._endpoints is not None:
                return self._endpoints
            if self._failure is not None and time.monotonic() < self._failure[0]:
                raise self._failure[1]
            try:
                self._endpoints = self._read_metadata()
            except ScanError as error:
                self._failure = time.monotonic() + FAILURE_REPEATED_S, error
                raise
            return self._endpoints

    def _read_metadata(self) -> _Endpoints:
        address = self.params.issuer.rstrip("/") + "/.well-known/openid-configuration"
        try:
            found = _Endpoints.model_validate(self._request(address))
        except ValidationError as error:
            name = ".".join(map(str, error.errors()[0]["loc"]))
            cause = f"its metadata have no valid `{name}`"
            raise UnavailableError(address, cause, "Check `issuer` in the file of --oidc") from None
        if found.issuer != self.params.issuer:
            cause = f"calls itself {found.issuer:.200}"
            raise UnavailableError(self.params.issuer, cause, "Write `issuer` exactly so in the file of --oidc")
        for endpoint in (found.authorization_endpoint, found.token_endpoint):
            _require_protected(address, endpoint)
        return found

    def _request(self, url: str, body: bytes | None = None, headers: dict[str, str] | None = None) -> dict[str, Any]:
        """JSON object that the provider answers with."""
        remedy = "Check `issuer` in the file of --oidc, and that this machine reaches it"
        request = urllib.request.Request(url, body, {"Accept": "application/json"} | (headers or {}))
        opener = urllib.request.build_opener(_NoRedirects, urllib.request.HTTPSHandler(context=self._context))
        try:
            with opener.open(request, timeout=RESPONSE_TIMEOUT_S) as response:
                found = json.loads(response.read(RESPONSE_MAX_BYTES))
        except urllib.error.HTTPError as error:
            raise _http_error(url, error, rejects=body is not None) from None
        except (OSError, ValueError, RecursionError) as error:
            reason = getattr(error, "reason", error)
            cause = "doesn't answer in JSON" if isinstance(error, ValueError) else f"can't be reached ({reason!s:.150})"
            raise UnavailableError(url, cause, remedy) from None
        if not isinstance(found, dict):
            raise UnavailableError(url, "doesn't answer with a JSON object", remedy)
        return found


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Redirects aren't followed: they would take the code and the secret elsewhere."""

    def redirect_request(self, *_: Any) -> None:
        """No further request."""


def _http_error(url: str, error: urllib.error.HTTPError, *, rejects: bool) -> ScanError:
    """An error status; `rejects`: a 4xx means that the provider rejects this sign-in."""
    try:
        answer = json.loads(error.read(RESPONSE_MAX_BYTES))
    except (OSError, ValueError, RecursionError):
        answer = None
    reason = answer.get("error") if isinstance(answer, dict) else None
    detail = answer.get("error_description") if isinstance(answer, dict) else None
    text = ", ".join(one[:150] for one in (reason, detail) if isinstance(one, str)) or f"status {error.code}"
    if rejects and 400 <= error.code < 500:
        return SignInError(url, f"the provider rejects the sign-in ({text})", "Try again; check client id and secret")
    return UnavailableError(url, f"the provider answers {text}", "Check `issuer` in the file of --oidc; see its log")


def _claims(token: object, issuer: str) -> dict[str, Any]:
    """Claims of an ID token (JWT)."""
    try:
        payload = str(token).split(".")[1]
        found = json.loads(base64.urlsafe_b64decode(payload + "=" * (-len(payload) % 4)))
    except (IndexError, ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise SignInError(issuer, "its answer has no valid ID token", "Request the scope `openid`, and try again")
    return found


def _require_protected(where: str | Path, url: str) -> None:
    """Check that an address is of https, or of this machine."""
    parts = urllib.parse.urlsplit(url)
    if parts.scheme != "https" and not (parts.scheme == "http" and is_loopback(parts.hostname or "")):
        raise InputError(where, f"{url:.200} is not an https address", "Use the provider's https address")


def _read_secret(settings: Path, path: Path | None) -> str | None:
    if path is None:
        return None
    path = settings.parent / path
    try:
        found = path.read_text("utf-8").strip()
    except (OSError, UnicodeError) as error:
        raise InputError(path, f"can't be read ({error})", "Give the file with the client's secret") from None
    if not found:
        raise InputError(path, "is empty", "Write the client's secret into it")
    return found


def _tls(settings: Path, ca: Path | None) -> ssl.SSLContext:
    path = None if ca is None else settings.parent / ca
    try:
        return ssl.create_default_context(cafile=path)
    except OSError as error:  # an SSLError, too
        raise InputError(path or settings, f"can't be used as `ca` ({error})", "Give certificates as PEM") from None
