"""How services are served, all in the same way: health, figures, token, TLS, limits, errors and pages.

    app = serving.application("the page", served, alive={"reader": reader.is_alive})

    @app.get("/api/history") ...

    serving.run(app, served, listening=print)

`/health/live` and `/health/ready` tell whether the workers do what they are there for, `/metrics` tells Prometheus what
is in `app.state.registry`. Errors are JSON, {where, cause, remedy}, with the status of
`pipeline.core.errors.EXIT_CODES`.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import re
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Gauge, generate_latest
from starlette.exceptions import HTTPException as StarletteHTTPException

from scan2sim.pipeline.core.errors import ScanError, http_status, printable
from scan2sim.services.http.limits import Impatient, allow_many
from scan2sim.services.http.settings import Served

log = logging.getLogger(__name__)

PAGES = Path(__file__).parents[1] / "pages"
"""What pages are made of; shown to all, at /pages."""
PUBLIC = ("/health/", "/pages/")
"""Paths below these need no token: they tell nothing of anybody."""
LARGEST = 2**20
"""Bytes of a request's body, unless a service says otherwise."""
REQUESTS = 256
"""Answered at once; more are sent away (503)."""
PROTOCOL, TOKEN_PROTOCOL = "scan2sim", "token."
"""Names of protocols that pages' WebSockets offer: the one that is spoken, and the token (hexadecimal) as another."""
SENT_WITHIN = 30.0
"""Seconds between two parts of a request's body."""
OWN_NAME = re.compile(r"(localhost|127(\.\d{1,3}){3}|\[::1\])(:\d+)?", re.IGNORECASE)
"""Names of this machine for itself. Others that lead here may be a website's, whose pages would read along."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
"""Of every answer: pages run and show what comes from here alone, and are shown in no other."""

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Check = Callable[[], bool]


def application(
    name: str,
    served: Served,
    *,
    alive: Mapping[str, Check],
    ready: Mapping[str, Check] | None = None,
    public: tuple[str, ...] = (),
    largest: int = LARGEST,
) -> FastAPI:
    """A service without its own paths.

    Args:
        name: what it is called in its description.
        served: how it listens.
        alive: its workers by name, and whether they live; one that doesn't won't come back.
        ready: what else must be so before it is asked anything.
        public: paths that need no token, beside `PUBLIC`: pages that hold no data.
        largest: bytes of a request's body.

    Raises:
        InputError: the token can't be read.
    """
    app = FastAPI(title=name, docs_url=None, redoc_url=None)
    app.add_middleware(_Guard, secret=served.secret(), local=served.is_local(), public=public, largest=largest)
    app.add_exception_handler(ScanError, _of_ours)
    app.add_exception_handler(StarletteHTTPException, _of_http)
    app.add_exception_handler(RequestValidationError, _of_request)
    app.mount("/pages", StaticFiles(directory=PAGES), name="pages")
    _tell_health(app, alive, ready or {})
    _tell_figures(app, alive)
    return app


def run(app: FastAPI, served: Served, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C; `listening` is told the address, once it is there.

    Raises:
        SettingError: it can't listen there.
        InputError: certificate or key are none.
    """
    served.check_tls()
    allow_many()
    with served.listen() as listener:
        address = served.address(listener.getsockname()[1])
        listening(address)
        if served.is_open():
            log.warning("everybody who reaches %s may use it: --token FILE asks for a token", address)
        config = uvicorn.Config(
            app,
            log_level="warning",
            server_header=False,
            ssl_certfile=served.certificate,
            ssl_keyfile=served.key,
            http=Impatient,
            timeout_graceful_shutdown=1,  # live pages never end by themselves
        )
        uvicorn.Server(config).run(sockets=[listener])


def _tell_health(app: FastAPI, alive: Mapping[str, Check], ready: Mapping[str, Check]) -> None:
    def told(checks: Mapping[str, Check]) -> JSONResponse:
        failing = [name for name, check in checks.items() if not check()]
        return JSONResponse({"failing": failing}, 503 if failing else 200)

    @app.get("/health/live")
    def live() -> Response:
        """Whether all workers live; restart it if not."""
        return told(alive)

    @app.get("/health/ready")
    def can_be_asked() -> Response:
        """Whether it can do its work now."""
        return told({**alive, **ready})


def _tell_figures(app: FastAPI, alive: Mapping[str, Check]) -> None:
    app.state.registry = registry = CollectorRegistry()
    workers = Gauge("scan2sim_worker_alive", "Whether a worker lives", ("worker",), registry=registry)
    for name, check in alive.items():
        workers.labels(name).set_function(check)

    @app.get("/metrics")
    def metrics() -> Response:
        """For Prometheus."""
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)


class _Guard:
    """Around all that is served: headers, who may ask, size of requests, errors that nobody expected."""

    def __init__(self, app: Any, *, secret: str | None, local: bool, public: tuple[str, ...], largest: int) -> None:
        self._app, self._local, self._public, self._largest = app, local, public, largest
        self._requests = 0
        self._wanted = None if secret is None else f"Bearer {secret}".encode()

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif (refusal := self._refused(scope)) is not None:
            await self._send_away(refusal, scope, receive, send)
        elif scope["type"] == "http":
            self._requests += 1
            try:
                await self._answer(scope, self._limited(receive), _with_headers(send))
            finally:
                self._requests -= 1
        else:
            await self._app(scope, receive, send)

    def _refused(self, scope: Message) -> Response | None:
        """What who may not ask is told."""
        path, headers = scope["path"], dict(scope["headers"])
        if _from_elsewhere(scope.get("method", "POST"), headers):  # a WebSocket has none, and is no mere look
            return _refusal(403, path, "is asked for by another site's page", "Ask from its own page, or a program")
        if self._requests >= REQUESTS and not path.startswith("/health/"):
            return _refusal(503, path, "is asked for by too many at once", "Ask again in a while")
        if path in self._public or path.startswith(PUBLIC):
            return None
        if self._wanted is not None:
            if hmac.compare_digest(headers.get(b"authorization", b"") or _bearer(scope), self._wanted):
                return None
            answer = _refusal(401, path, "needs a token", "Send the header Authorization: Bearer TOKEN")
            answer.headers["WWW-Authenticate"] = "Bearer"
            return answer
        host = headers.get(b"host", b"").decode("latin-1")
        if self._local and not OWN_NAME.fullmatch(host):
            return _refusal(421, path, "is asked for by a name that isn't this machine's own", "Ask localhost for it")
        return None

    async def _send_away(self, refusal: Response, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await refusal(scope, receive, _with_headers(send))

    async def _answer(self, scope: Message, receive: Receive, send: Send) -> None:
        begun = False

        async def noted(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._app(scope, receive, noted)
        except Exception:
            log.exception("%s %s", scope["method"], printable(scope["path"]))
            if begun:
                raise
            answer = _refusal(500, scope["path"], "failed unexpectedly", "The service's log says why")
            await answer(scope, receive, send)

    def _limited(self, receive: Receive) -> Receive:
        """Bodies are counted as they come, whatever they say that they hold, and are waited for within reason."""
        came, whole = 0, False

        async def counted() -> Message:
            nonlocal came, whole
            try:
                message = await asyncio.wait_for(receive(), None if whole else SENT_WITHIN)
            except TimeoutError:
                raise HTTPException(408, f"sent nothing for {SENT_WITHIN:g} s") from None
            whole = not message.get("more_body", False)
            came += len(message.get("body", b""))
            if came > self._largest:
                raise HTTPException(413, f"is larger than {self._largest} bytes")
            return message

        return counted


def _from_elsewhere(method: str, headers: Mapping[bytes, bytes]) -> bool:
    """Whether another site's page, in a visitor's browser, wants something done."""
    origin = headers.get(b"origin")
    if origin is None or method in ("GET", "HEAD"):
        return False
    return origin.partition(b"://")[2] != headers.get(b"host", b"")


def _bearer(scope: Message) -> bytes:
    """The token that a page's WebSocket brings, as a header: browsers let it name protocols, and nothing else."""
    for name in scope.get("subprotocols", ()):
        if name.startswith(TOKEN_PROTOCOL):
            with contextlib.suppress(ValueError):
                return b"Bearer " + bytes.fromhex(name.removeprefix(TOKEN_PROTOCOL))
    return b""


def chosen_protocol(scope: Message) -> str | None:
    """What a WebSocket is accepted with, where it offers it beside its token."""
    return PROTOCOL if PROTOCOL in scope.get("subprotocols", ()) else None


def _with_headers(send: Send) -> Send:
    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [
                *message["headers"],
                *((name.lower().encode(), value.encode()) for name, value in HEADERS.items()),
            ]
        await send(message)

    return sent


def _refusal(status: int, where: str, cause: str, remedy: str) -> JSONResponse:
    return JSONResponse({"where": where, "cause": cause, "remedy": remedy}, status)


def _of_ours(_: Request, error: Exception) -> Response:
    assert isinstance(error, ScanError)
    return _refusal(http_status(error), error.where, error.cause, error.remedy)


def _of_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, StarletteHTTPException)
    return _refusal(
        error.status_code, printable(request.url.path), str(error.detail), "/openapi.json lists what is here"
    )


def _of_request(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = printable(".".join(map(str, first["loc"][1:])) or "body")
    return _refusal(422, where[:200], str(first["msg"]), "/openapi.json says what it may be")
