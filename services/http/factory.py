"""Web application of a service with what all services share: health, metrics, token, TLS, limits, errors and pages.

    app = factory.application("dashboard", params, alive={"reader": reader.is_alive})

    @app.get("/api/history") ...

    factory.run(app, params, listening=print)

`/health/live` and `/health/ready` are liveness and readiness probes, `/metrics` exports `app.state.registry` to
Prometheus. Errors are JSON, {where, cause, remedy}, with the status of
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
from scan2sim.services.http.limits import LimitedEventLoop, raise_file_limit, request_in_progress
from scan2sim.services.http.settings import ServerParams

log = logging.getLogger(__name__)

PAGES = Path(__file__).parents[1] / "pages"
"""Static files of the web pages, served at /pages without a token."""
PUBLIC_PATHS = ("/health/", "/pages/")
"""Prefixes of the paths that need no token, because they hold no data."""
MAX_BODY_BYTES = 2**20
"""Default limit of the size of a request's body."""
MAX_CONCURRENT_REQUESTS = 256
"""Further requests are rejected with status 503."""
PROTOCOL, TOKEN_PROTOCOL = "scan2sim", "token."
"""WebSocket subprotocols that the pages offer: the one that is spoken, and the prefix of the token in hexadecimal."""
BODY_TIMEOUT_S = 30.0
"""Longest pause between two parts of a request's body."""
LOOPBACK_HOST = re.compile(r"(localhost|127(\.\d{1,3}){3}|\[::1\])(:\d+)?", re.IGNORECASE)
"""Valid Host headers of a server on loopback; others may be a DNS rebinding attack by another website."""
SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
"""Headers of every response: pages load resources only from here and can't be embedded in other pages."""

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Check = Callable[[], bool]


def application(
    name: str,
    params: ServerParams,
    *,
    alive: Mapping[str, Check],
    ready: Mapping[str, Check] | None = None,
    public: tuple[str, ...] = (),
    max_body_bytes: int = MAX_BODY_BYTES,
) -> FastAPI:
    """Create the application of a service, without the paths of the service itself.

    Args:
        name: title in its OpenAPI description.
        params: server settings.
        alive: liveness checks of its worker threads by name; a failure is permanent and requires a restart.
        ready: further checks for readiness.
        public: paths that need no token in addition to `PUBLIC_PATHS`: pages that hold no data.
        max_body_bytes: limit of the size of a request's body.

    Raises:
        InputError: the token can't be read.
    """
    app = FastAPI(title=name, docs_url=None, redoc_url=None)
    app.add_middleware(
        _Guard, secret=params.secret(), local=params.is_local(), public=public, max_body_bytes=max_body_bytes
    )
    app.add_exception_handler(ScanError, _scan_error_response)
    app.add_exception_handler(StarletteHTTPException, _http_error_response)
    app.add_exception_handler(RequestValidationError, _validation_error_response)
    app.mount("/pages", StaticFiles(directory=PAGES), name="pages")
    _add_health(app, alive, ready or {})
    _add_metrics(app, alive)
    return app


def run(app: FastAPI, params: ServerParams, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C; `listening` is called with the URL when the socket is open.

    Raises:
        SettingError: it can't listen on the address or port.
        InputError: the certificate or key is invalid.
    """
    params.check_tls()
    raise_file_limit()
    with params.listen() as listener:
        address = params.address(listener.getsockname()[1])
        listening(address)
        if params.is_open():
            log.warning("anyone who can reach %s can use it; --token FILE restricts access", address)
        config = uvicorn.Config(
            app,
            log_level="warning",
            server_header=False,
            ssl_certfile=params.certificate,
            ssl_keyfile=params.key,
            http="h11",
            loop=f"{LimitedEventLoop.__module__}:{LimitedEventLoop.__name__}",
            timeout_graceful_shutdown=1,  # event streams of live pages never end by themselves
        )
        uvicorn.Server(config).run(sockets=[listener])


def _add_health(app: FastAPI, alive: Mapping[str, Check], ready: Mapping[str, Check]) -> None:
    def response(checks: Mapping[str, Check]) -> JSONResponse:
        failing = [name for name, check in checks.items() if not check()]
        return JSONResponse({"failing": failing}, 503 if failing else 200)

    @app.get("/health/live")
    def live() -> Response:
        """Liveness probe: whether all worker threads are running; if not, restart the service."""
        return response(alive)

    @app.get("/health/ready")
    def is_ready() -> Response:
        """Readiness probe: whether it can handle requests now."""
        return response({**alive, **ready})


def _add_metrics(app: FastAPI, alive: Mapping[str, Check]) -> None:
    app.state.registry = registry = CollectorRegistry()
    workers = Gauge("scan2sim_worker_alive", "Whether a worker thread is running", ("worker",), registry=registry)
    for name, check in alive.items():
        workers.labels(name).set_function(check)

    @app.get("/metrics")
    def metrics() -> Response:
        """Metrics in the text format of Prometheus."""
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)


class _Guard:
    """ASGI middleware: security headers, access control, request limits, unexpected errors."""

    def __init__(
        self, app: Any, *, secret: str | None, local: bool, public: tuple[str, ...], max_body_bytes: int
    ) -> None:
        self._app, self._local, self._public, self._max_body_bytes = app, local, public, max_body_bytes
        self._requests = 0
        self._authorization = None if secret is None else f"Bearer {secret}".encode()

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        with request_in_progress():
            await self._handle(scope, receive, send)

    async def _handle(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif (rejection := self._rejection(scope)) is not None:
            await self._reject(rejection, scope, receive, send)
        elif scope["type"] == "http":
            self._requests += 1
            try:
                await self._answer(scope, self._limited(receive), _with_headers(send))
            finally:
                self._requests -= 1
        else:
            await self._app(scope, receive, send)

    def _rejection(self, scope: Message) -> Response | None:
        """Response to a request that is not allowed; None: it is allowed."""
        path, headers = scope["path"], dict(scope["headers"])
        if _is_cross_origin(scope.get("method", "POST"), headers):  # a WebSocket has no method and may change state
            cause = "cross-origin request: the page is on another site"
            return _error_response(403, path, cause, "Use the service's own page, or a program")
        if self._requests >= MAX_CONCURRENT_REQUESTS and not path.startswith("/health/"):
            return _error_response(503, path, "too many concurrent requests", "Retry later")
        if path in self._public or path.startswith(PUBLIC_PATHS):
            return None
        if self._authorization is not None:
            if hmac.compare_digest(headers.get(b"authorization", b"") or _bearer(scope), self._authorization):
                return None
            response = _error_response(401, path, "requires a token", "Send the header Authorization: Bearer TOKEN")
            response.headers["WWW-Authenticate"] = "Bearer"
            return response
        host = headers.get(b"host", b"").decode("latin-1")
        if self._local and not LOOPBACK_HOST.fullmatch(host):
            cause = "the Host header isn't a loopback name of this machine"
            return _error_response(421, path, cause, "Use http://localhost as the address")
        return None

    async def _reject(self, rejection: Response, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await rejection(scope, receive, _with_headers(send))

    async def _answer(self, scope: Message, receive: Receive, send: Send) -> None:
        begun = False

        async def send_and_note(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._app(scope, receive, send_and_note)
        except Exception:
            log.exception("%s %s", scope["method"], printable(scope["path"]))
            if begun:
                raise
            response = _error_response(500, scope["path"], "internal error", "See the service's log")
            await response(scope, receive, send)

    def _limited(self, receive: Receive) -> Receive:
        """Limit the body's actual size, whatever its Content-Length is, and the time between its parts."""
        received_bytes, complete = 0, False

        async def limited() -> Message:
            nonlocal received_bytes, complete
            try:
                message = await asyncio.wait_for(receive(), None if complete else BODY_TIMEOUT_S)
            except TimeoutError:
                raise HTTPException(408, f"no data for {BODY_TIMEOUT_S:g} s") from None
            complete = not message.get("more_body", False)
            received_bytes += len(message.get("body", b""))
            if received_bytes > self._max_body_bytes:
                raise HTTPException(413, f"the body is larger than {self._max_body_bytes} bytes")
            return message

        return limited


def _is_cross_origin(method: str, headers: Mapping[bytes, bytes]) -> bool:
    """Whether a request that may change state comes from another site's page in a browser (CSRF)."""
    origin = headers.get(b"origin")
    if origin is None or method in ("GET", "HEAD"):
        return False
    return origin.partition(b"://")[2] != headers.get(b"host", b"")


def _bearer(scope: Message) -> bytes:
    """Authorization header from a WebSocket's subprotocols: browsers can't set other headers of a WebSocket."""
    for name in scope.get("subprotocols", ()):
        if name.startswith(TOKEN_PROTOCOL):
            with contextlib.suppress(ValueError):
                return b"Bearer " + bytes.fromhex(name.removeprefix(TOKEN_PROTOCOL))
    return b""


def chosen_protocol(scope: Message) -> str | None:
    """Subprotocol with which to accept a WebSocket; None if it doesn't offer it."""
    return PROTOCOL if PROTOCOL in scope.get("subprotocols", ()) else None


def _with_headers(send: Send) -> Send:
    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [
                *message["headers"],
                *((name.lower().encode(), value.encode()) for name, value in SECURITY_HEADERS.items()),
            ]
        await send(message)

    return send_with_headers


def _error_response(status: int, where: str, cause: str, remedy: str) -> JSONResponse:
    return JSONResponse({"where": where, "cause": cause, "remedy": remedy}, status)


def _scan_error_response(_: Request, error: Exception) -> Response:
    assert isinstance(error, ScanError)
    return _error_response(http_status(error), error.where, error.cause, error.remedy)


def _http_error_response(request: Request, error: Exception) -> Response:
    assert isinstance(error, StarletteHTTPException)
    path = printable(request.url.path)
    return _error_response(error.status_code, path, str(error.detail), "/openapi.json lists the paths of this service")


def _validation_error_response(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = printable(".".join(map(str, first["loc"][1:])) or "body")
    return _error_response(422, where[:200], str(first["msg"]), "/openapi.json describes the valid values")
