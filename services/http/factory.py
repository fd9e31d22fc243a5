"""Web application of a service with what all services share: health, metrics, token, TLS, limits, errors and pages.

    app = factory.application("dashboard", params, alive={"reader": reader.is_alive})

    @app.get("/api/history") ...

    factory.run(app, params, listening=print)

`/health/live` and `/health/ready` are liveness and readiness probes, `/metrics` exports `app.state.registry` to
Prometheus. Errors are JSON, {where, cause, remedy, error}, with the status of `pipeline.core.errors.EXIT_CODES`;
`error` is the whole message. On paths of the Open Inference Protocol it is alone, as the protocol defines errors.
"""

from __future__ import annotations

import contextlib
import hmac
import logging
import re
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Gauge, generate_latest
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.requests import ClientDisconnect

from scan2sim.pipeline.core.errors import ScanError, http_status, printable
from scan2sim.services.http.bodies import Bodies, Receive
from scan2sim.services.http.limits import LimitedEventLoop, raise_file_limit, request_in_progress
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.supervision import end_process_with_threads

log = logging.getLogger(__name__)

PAGES = Path(__file__).parents[1] / "pages"
"""Static files of the web pages, served at /pages without a token."""
PUBLIC_PATHS = ("/health/", "/pages/")
"""Prefixes of the paths that need no token, because they hold no data."""
MAX_BODY_BYTES = 2**20
"""Default limit of the size of a request's body."""
MAX_CONCURRENT_REQUESTS = 256
"""Requests whose bodies are complete; further ones are rejected with status 503."""
INFERENCE_PATHS = "/v2"
"""Prefix of the paths of the Open Inference Protocol."""
HEALTH_PATHS = ("/health/",)
"""Prefixes of the paths that are always served, whatever the number of requests."""
PROTOCOL, TOKEN_PROTOCOL = "scan2sim", "token."
"""WebSocket subprotocols that the pages offer: the one that is spoken, and the prefix of the token in hexadecimal."""
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
Send = Callable[[Message], Awaitable[None]]
Check = Callable[[], bool]


def application(
    name: str,
    params: ServerParams,
    *,
    alive: Mapping[str, Check],
    ready: Mapping[str, Check] | None = None,
    public: tuple[str, ...] = (),
    health: tuple[str, ...] = (),
    max_body_bytes: int = MAX_BODY_BYTES,
    accepts: Callable[[str], bool] | None = None,
    sign_in: str = "",
) -> FastAPI:
    """Create the application of a service, without the paths of the service itself.

    Args:
        name: title in its OpenAPI description.
        params: server settings.
        alive: liveness checks of its worker threads by name; a failure is permanent and requires a restart.
        ready: further checks for readiness.
        public: paths that need no token in addition to `PUBLIC_PATHS`: pages that hold no data.
        health: prefixes of its health paths in addition to `HEALTH_PATHS`.
        max_body_bytes: limit of the size of a request's body.
        accepts: whether a token is valid, for a service whose users have their own, instead of the token of `params`.
        sign_in: path at which users sign in, which responses with status 401 name; "": none.

    Raises:
        InputError: the token can't be read.
    """
    secret = params.secret()
    app = FastAPI(title=name, docs_url=None, redoc_url=None)
    app.add_middleware(
        _Guard,
        accepts=accepts or (None if secret is None else partial(hmac.compare_digest, secret)),
        local=params.is_local(),
        public=public,
        health=HEALTH_PATHS + health,
        max_body_bytes=max_body_bytes,
        sign_in=sign_in,
    )
    app.add_exception_handler(ScanError, _scan_error_response)
    app.add_exception_handler(StarletteHTTPException, _http_error_response)
    app.add_exception_handler(RequestValidationError, _validation_error_response)
    app.mount("/pages", StaticFiles(directory=PAGES), name="pages")
    _add_health(app, alive, ready or {})
    _add_metrics(app, alive)
    return app


def add_error(app: FastAPI, kind: type[ScanError], status: int) -> None:
    """Answer a kind of error with another status than that of `EXIT_CODES`."""
    app.add_exception_handler(kind, partial(_scan_error_response, status=status))


def run(app: FastAPI, params: ServerParams, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C; `listening` is called with the URL when the socket is open.

    Raises:
        SettingError: it can't listen on the address or port.
        InputError: the certificate or key is invalid.
        StepError: a thread of this process has died.
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
        with end_process_with_threads():
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
        self,
        app: Any,
        *,
        accepts: Callable[[str], bool] | None,
        local: bool,
        public: tuple[str, ...],
        health: tuple[str, ...],
        max_body_bytes: int,
        sign_in: str,
    ) -> None:
        self._app, self._local, self._public, self._health = app, local, public, health
        self._bodies, self._requests = Bodies(max_body_bytes), 0
        self._accepts, self._sign_in = accepts, sign_in

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        with request_in_progress():
            await self._handle(scope, receive, send)

    async def _handle(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif (rejection := self._rejection(scope)) is not None:
            await self._reject(rejection, scope, receive, send)
        elif scope["type"] == "http":
            await self._receive(scope, receive, _with_headers(send))
        else:
            await self._app(scope, receive, send)

    def _rejection(self, scope: Message) -> Response | None:
        """Response to a request that is not allowed; None: it is allowed."""
        path, headers = scope["path"], dict(scope["headers"])
        if _is_cross_origin(scope.get("method", "POST"), headers):  # a WebSocket has no method and may change state
            cause = "cross-origin request: the page is on another site"
            return _error_response(path, 403, cause, "Use the service's own page, or a program")
        if path in self._public or path.startswith(PUBLIC_PATHS):
            return None
        if self._accepts is not None:
            if (token := sent_token(scope)) is not None and self._accepts(token):
                return None
            remedy = "Send the header Authorization: Bearer TOKEN"
            if self._sign_in:
                remedy = f"Sign in at {self._sign_in}, or send a token: Authorization: Bearer TOKEN"
            response = _error_response(path, 401, "requires a token", remedy, sign_in=self._sign_in)
            response.headers["WWW-Authenticate"] = "Bearer"
            return response
        host = headers.get(b"host", b"").decode("latin-1")
        if self._local and not LOOPBACK_HOST.fullmatch(host):
            cause = "the Host header isn't a loopback name of this machine"
            return _error_response(path, 421, cause, "Use http://localhost as the address")
        return None

    async def _reject(self, rejection: Response, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await rejection(scope, receive, _with_headers(send))

    async def _receive(self, scope: Message, receive: Receive, send: Send) -> None:
        """Receive the body of a request, then handle it."""
        where = printable(scope["path"])
        try:
            async with self._bodies.receive(receive, dict(scope["headers"])) as body:
                if self._requests >= MAX_CONCURRENT_REQUESTS and not scope["path"].startswith(self._health):
                    raise HTTPException(503, "too many concurrent requests", {"Retry-After": "1"})
                self._requests += 1
                try:
                    await self._answer(scope, _replayed(body, receive), send)
                finally:
                    self._requests -= 1
        except HTTPException as error:
            response = _error_response(where, error.status_code, str(error.detail), "Retry, or send less at once")
            response.headers.update(error.headers or {})
            await response(scope, receive, send)
        except ClientDisconnect:
            log.info("%s %s: the client has disconnected", scope["method"], where)

    async def _answer(self, scope: Message, receive: Receive, send: Send) -> None:
        begun = False

        async def send_and_note(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._app(scope, receive, send_and_note)
        except ClientDisconnect:
            raise
        except Exception:
            log.exception("%s %s", scope["method"], printable(scope["path"]))
            if begun:
                raise
            response = _error_response(scope["path"], 500, "internal error", "See the service's log")
            await response(scope, receive, send)


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Return a received body as one message; later ones are those of the server."""
    messages = iter([{"type": "http.request", "body": body, "more_body": False}])

    async def replayed() -> Message:
        return next(messages, None) or await receive()

    return replayed


def _is_cross_origin(method: str, headers: Mapping[bytes, bytes]) -> bool:
    """Whether a request that may change state comes from another site's page in a browser (CSRF)."""
    origin = headers.get(b"origin")
    if origin is None or method in ("GET", "HEAD"):
        return False
    return origin.partition(b"://")[2] != headers.get(b"host", b"")


def sent_token(scope: Message) -> str | None:
    """Token of a request, ASCII; None: it has none.

    It is in the Authorization header, or in a WebSocket's subprotocols: browsers can't set a WebSocket's headers.
    """
    header = dict(scope["headers"]).get(b"authorization", b"").decode("latin-1")
    if header.startswith("Bearer ") and header.isascii():
        return str(header.removeprefix("Bearer "))
    for name in scope.get("subprotocols", ()):
        if name.startswith(TOKEN_PROTOCOL):
            with contextlib.suppress(ValueError):
                return bytes.fromhex(name.removeprefix(TOKEN_PROTOCOL)).decode("ascii")
    return None


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


def _error_response(
    path: str, status: int, cause: str, remedy: str, where: str = "", sign_in: str = ""
) -> JSONResponse:
    """Response to a request; without `where`, the error is in its path."""
    where = where or printable(path)
    message = {"error": f"{where}: {cause}. {remedy}"}
    if not path.startswith(INFERENCE_PATHS):
        message = {"where": where, "cause": cause, "remedy": remedy, **message}
    return JSONResponse(message | ({"sign_in": sign_in} if sign_in else {}), status)


def _scan_error_response(request: Request, error: Exception, status: int | None = None) -> Response:
    assert isinstance(error, ScanError)
    return _error_response(request.url.path, status or http_status(error), error.cause, error.remedy, str(error.where))


def _http_error_response(request: Request, error: Exception) -> Response:
    assert isinstance(error, StarletteHTTPException)
    remedy = "/openapi.json lists the paths of this service"
    response = _error_response(request.url.path, error.status_code, str(error.detail), remedy)
    response.headers.update(error.headers or {})
    return response


def _validation_error_response(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = printable(".".join(map(str, first["loc"][1:])) or "body")
    return _error_response(
        request.url.path, 422, str(first["msg"]), "/openapi.json describes the valid values", where[:200]
    )
