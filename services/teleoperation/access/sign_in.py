"""Sign-in at an OpenID provider: the paths /login and /login/callback of a page, and sessions of those who signed in.

The provider proves who somebody is; the file of drivers decides what they may do (`login` of a driver). A session ends
when its driver is removed from that file, or its time is over.
"""

from __future__ import annotations

import hashlib
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI, Request
from fastapi.responses import PlainTextResponse, RedirectResponse, Response

from scan2sim.pipeline.core.errors import ScanError, SettingError
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.access.drivers import Access, AccessError, Driver, Drivers
from scan2sim.services.teleoperation.access.oidc import Attempt, Provider
from scan2sim.services.teleoperation.settings import PageParams

PATH = "/login"
"""Path that begins a sign-in; the provider sends the browser back to `CALLBACK`."""
CALLBACK = f"{PATH}/callback"
ATTEMPT_MAX_S = 600.0
"""Time for a sign-in at the provider."""
ATTEMPTS_MAX = 1000
"""Sign-ins in progress; of more, the oldest are given up."""
SESSIONS_MAX = 1000
"""Sessions; of more, the oldest end."""
COOKIE = "scan2sim_login"


class SignedIn:
    """Drivers by their own tokens, and by sessions of those who signed in at a provider; thread-safe."""

    def __init__(self, drivers: Drivers, provider: Provider, *, now: Callable[[], float] = time.monotonic) -> None:
        self.provider, self._drivers, self._now = provider, drivers, now
        self._lock = threading.Lock()
        self._attempts: dict[str, Attempt] = {}
        self._sessions: dict[str, tuple[str, float]] = {}  # login and end, by the digest of the session's token

    def identify(self, token: str) -> Driver | None:
        """The driver of a token or session; None: nobody's, revoked or expired."""
        if (found := self._drivers.identify(token)) is not None:
            return found
        with self._lock:
            login, ends = self._sessions.get(_digest(token), ("", 0.0))
        return self._drivers.of_login(login) if login and self._now() < ends else None

    def begin(self, redirect: str) -> tuple[Attempt, str]:
        """A new sign-in, and the provider's address for it.

        Raises:
            UnavailableError: the provider can't be reached.
        """
        attempt = Attempt(redirect, began=self._now())
        url = self.provider.authorization_url(attempt)
        with self._lock:
            self._attempts[attempt.state] = attempt
            _limit(self._attempts, ATTEMPTS_MAX)
        return attempt, url

    def finish(self, state: str, code: str) -> str:
        """End a sign-in; returns the token of a new session.

        Raises:
            AccessError: the sign-in is unknown or too old, or who signed in isn't a driver.
            SignInError: the provider rejects it. UnavailableError: the provider can't be reached.
        """
        with self._lock:
            attempt = self._attempts.pop(state, None)
        if attempt is None or self._now() - attempt.began > ATTEMPT_MAX_S:
            raise AccessError("sign-in", "isn't known here, or took too long", "Open the page and sign in again")
        login = self.provider.login(attempt, code)
        if self._drivers.of_login(login) is None:
            remedy = "Ask whoever manages the drivers: `teleop drivers FILE --add NAME --login` adds them"
            raise AccessError(login[:200], "is not one of the drivers here", remedy)
        token = secrets.token_urlsafe(32)
        with self._lock:
            self._sessions[_digest(token)] = login, self._now() + 3600 * self.provider.params.hours
            _limit(self._sessions, SESSIONS_MAX)
        return token


def access(params: PageParams) -> Access | None:
    """Who may use a page; None: everybody with its token.

    Raises:
        SettingError: a provider is given, but no drivers. InputError: one of the files isn't valid.
    """
    if params.drivers is None:
        if params.oidc is not None:
            cause = "needs the drivers who may sign in"
            raise SettingError(
                "--oidc", cause, "Give --drivers FILE; `teleop drivers FILE --add NAME --login` writes it"
            )
        return None
    drivers = Drivers(params.drivers)
    return drivers if params.oidc is None else SignedIn(drivers, Provider(params.oidc))


def protected(name: str, params: ServerParams, alive: Mapping[str, factory.Check], who: Access | None) -> FastAPI:
    """Application of a page whose users are `who`, with the paths of the sign-in; otherwise as `factory.application`.

    Raises:
        InputError: the token can't be read.
    """
    sign_in = isinstance(who, SignedIn)
    app = factory.application(
        name,
        params,
        alive=alive,
        public=("/", PATH, CALLBACK) if sign_in else ("/",),
        accepts=None if who is None else lambda token: who.identify(token) is not None,
        sign_in=PATH if sign_in else "",
    )
    factory.add_error(app, AccessError, 403)
    if isinstance(who, SignedIn):
        _add_routes(app, who)
    return app


def _add_routes(app: FastAPI, signed_in: SignedIn) -> None:

    @app.get(PATH, include_in_schema=False)
    def login(request: Request) -> Response:
        base = str(request.base_url).rstrip("/")
        try:
            attempt, url = signed_in.begin(base + CALLBACK)
        except ScanError as error:
            return _failure(error)
        response = RedirectResponse(url, 302)
        response.set_cookie(
            COOKIE, attempt.state, max_age=int(ATTEMPT_MAX_S), path=PATH, httponly=True, samesite="lax",
            secure=request.url.scheme == "https",
        )  # fmt: skip
        return response

    @app.get(CALLBACK, include_in_schema=False)
    def callback(request: Request, state: str = "", code: str = "", error: str = "") -> Response:
        try:
            if not state or not secrets.compare_digest(request.cookies.get(COOKIE, "").encode(), state.encode()):
                cause = "was begun in another browser, or cookies are disabled"
                raise AccessError("sign-in", cause, "Open the page and sign in again")
            if error or not code:
                raise AccessError("sign-in", f"was rejected by the provider ({error or 'no code'!s:.100})", "Try again")
            token = signed_in.finish(state, code)
        except ScanError as failure:
            return _failure(failure)
        response = RedirectResponse(f"/#session={quote(token)}", 303)  # a fragment is sent to no server
        response.delete_cookie(COOKIE, path=PATH)
        return response


def _failure(error: ScanError) -> Response:
    """A sentence for the person in front of the browser: 403 if they aren't let in, 502 if the provider fails."""
    status = 403 if isinstance(error, AccessError) else 502
    return PlainTextResponse(f"{error}\n", status)


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _limit(entries: dict[str, Any], count: int) -> None:
    """Remove the oldest entries beyond a number."""
    while len(entries) > count:
        del entries[next(iter(entries))]
