"""HTTP factory: health checks, token, error responses, limits, TLS, security headers."""

from __future__ import annotations

import asyncio
import contextlib
import select
import socket
import ssl
import subprocess
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError

import pytest

from scan2sim.pipeline.core.errors import EXIT_CODES, InputError, ScanError, SettingError
from scan2sim.services.http.settings import ServerParams

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
from fastapi import FastAPI, Request, WebSocket
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from websockets.sync.client import connect

from scan2sim.services.http import bodies, factory, limits
from tests.waiting import until

TOKEN = "0123456789abcdef"
ERROR_FIELDS = {"where", "cause", "remedy", "error"}


class Worker:
    """Worker whose liveness the test sets."""

    alive = True

    def is_alive(self) -> bool:
        return self.alive


@pytest.fixture
def token(tmp_path: Path) -> Path:
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n", encoding="utf-8")
    return path


def app_of(params: ServerParams | None = None, **more: Any) -> FastAPI:
    app = factory.application("a test", params or ServerParams(), **({"alive": {}} | more))

    @app.get("/number")
    def number(value: float = 0) -> float:
        return value

    @app.post("/length")
    async def length(request: Request) -> int:
        return len(await request.body())

    @app.get("/fail/{kind}")
    def fail(kind: str) -> None:
        for error in EXIT_CODES:
            if error.__name__ == kind and issubclass(error, ScanError):
                raise error("tile.toml", "is wrong", "Fix it")
        raise ZeroDivisionError("a secret")

    @app.websocket("/socket")
    async def socket(socket: WebSocket) -> None:
        await socket.accept()
        await socket.close()

    return app


def client_of(app: FastAPI, host: str = "localhost") -> TestClient:
    return TestClient(app, base_url=f"http://{host}", raise_server_exceptions=False)


def test_health_reflects_the_workers() -> None:
    worker, broker = Worker(), Worker()
    client = client_of(app_of(alive={"reader": worker.is_alive}, ready={"Kafka": broker.is_alive}))
    assert client.get("/health/live").status_code == client.get("/health/ready").status_code == 200
    broker.alive = False
    assert client.get("/health/live").status_code == 200
    ready = client.get("/health/ready")
    assert (ready.status_code, ready.json()) == (503, {"failing": ["Kafka"]})
    worker.alive = False
    assert client.get("/health/live").json() == {"failing": ["reader"]}
    assert client.get("/health/ready").json() == {"failing": ["reader", "Kafka"]}
    assert 'scan2sim_worker_alive{worker="reader"} 0.0' in client.get("/metrics").text


@pytest.mark.parametrize("kind", [kind for kind in EXIT_CODES if issubclass(kind, ScanError)])
def test_errors_have_the_http_status_of_their_class(kind: type[ScanError]) -> None:
    answer = client_of(app_of()).get(f"/fail/{kind.__name__}")
    assert answer.status_code == EXIT_CODES[kind][1]
    message = {"where": "tile.toml", "cause": "is wrong", "remedy": "Fix it"}
    assert answer.json() == {**message, "error": "tile.toml: is wrong. Fix it"}


@pytest.mark.parametrize(("path", "status"), [("/nix", 404), ("/number?value=x", 422), ("/fail/other", 500)])
def test_error_responses_have_no_details_of_the_program(path: str, status: int) -> None:
    answer = client_of(app_of()).get(path)
    assert answer.status_code == status and set(answer.json()) == ERROR_FIELDS
    assert "secret" not in answer.text


def test_any_host_name_is_accepted_with_the_token(token: Path) -> None:
    client = client_of(app_of(ServerParams(host="0.0.0.0", token=token)), "robot.example")
    assert client.get("/number", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 200
    assert client.get("/number").status_code == 401


def test_only_health_and_static_files_are_public(token: Path) -> None:
    client = client_of(app_of(ServerParams(token=token), public=("/",)))
    for path in ("/number", "/metrics", "/openapi.json", "/health", "/nix", "/pages/../number"):
        for given in ({}, {"Authorization": "Bearer 0123456789abcdeX"}, {"Authorization": TOKEN}):
            answer = client.get(path, headers=given)
            assert answer.status_code == 401 and answer.headers["WWW-Authenticate"] == "Bearer", path
    assert client.get("/health/live").status_code == client.get("/pages/style.css").status_code == 200
    assert client.get("/number?value=3", headers={"Authorization": f"Bearer {TOKEN}"}).json() == 3
    with pytest.raises(WebSocketDisconnect), client.websocket_connect("/socket"):
        pass


def test_dns_rebinding_is_rejected() -> None:
    for host in ("localhost", "127.0.0.1:8080", "[::1]:8080", "LOCALHOST:80"):
        assert client_of(app_of(), host).get("/number").status_code == 200, host
    for host in ("evil.example", "localhost.evil.example", "127.0.0.1.evil.example:8080"):
        answer = client_of(app_of(), host).get("/number")
        assert answer.status_code == 421 and set(answer.json()) == ERROR_FIELDS, host


@pytest.mark.parametrize("text", ["", "short", "two words that are long", "ümläutümläutümläut"])
def test_invalid_tokens_are_rejected(text: str, token: Path) -> None:
    token.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="openssl rand"):
        ServerParams(token=token).secret()
    with pytest.raises(InputError, match="can't be read"):
        ServerParams(token=token.parent / "nowhere").secret()


@pytest.mark.parametrize("with_length", [True, False], ids=["with a length", "in chunks"])
def test_too_large_requests_are_rejected(with_length: bool) -> None:
    client = client_of(app_of(max_body_bytes=1000))

    def post(size: int) -> Any:
        chunks = (b"x" * 100 for _ in range(size // 100))
        return client.post("/length", content=b"x" * size if with_length else chunks)

    assert post(1000).json() == 1000
    assert post(1100).status_code == 413 and "1000 bytes" in post(1100).json()["cause"]


def test_responses_have_security_headers() -> None:
    client = client_of(app_of())
    for path in ("/pages/style.css", "/nix", "/fail/other", "/health/live"):
        headers = client.get(path).headers
        assert "default-src 'none'; script-src 'self'" in headers["Content-Security-Policy"], path
        assert headers["X-Content-Type-Options"] == "nosniff"
    assert client.get("/pages/%2e%2e/serving.py").status_code == 404


@pytest.fixture
def certificate(tmp_path: Path) -> tuple[Path, Path]:
    """Self-signed certificate of localhost and its key."""
    paths = tmp_path / "certificate.pem", tmp_path / "key.pem"
    done = subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost", "-out", paths[0], "-keyout", paths[1]],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return paths


@pytest.fixture
def https_url(certificate: tuple[Path, Path]) -> str:
    """URL of a running HTTPS service."""
    addresses: list[str] = []
    params = ServerParams(port=0, host="localhost", certificate=certificate[0], key=certificate[1])
    thread = threading.Thread(target=factory.run, args=(app_of(params), params, addresses.append), daemon=True)
    thread.start()
    until(lambda: addresses)
    return addresses[0]


def test_service_uses_tls(https_url: str, certificate: tuple[Path, Path]) -> None:
    trusting = ssl.create_default_context(cafile=certificate[0])
    with urllib.request.urlopen(f"{https_url}number?value=2", context=trusting, timeout=60) as answer:
        assert answer.read() == b"2.0"
    with pytest.raises(OSError), urllib.request.urlopen(https_url.replace("https", "http"), timeout=60):
        pass


def test_invalid_server_settings_are_rejected(certificate: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="--key"):
        ServerParams(certificate=certificate[0]).check_tls()
    (tmp_path / "other.pem").write_text("no key", encoding="utf-8")
    with pytest.raises(InputError, match=r"other\.pem"):
        ServerParams(certificate=certificate[0], key=tmp_path / "other.pem").check_tls()
    with ServerParams(port=0).listen() as taken, pytest.raises(SettingError, match="Choose another --port"):
        ServerParams(port=taken.getsockname()[1]).listen()
    with pytest.raises(SettingError, match="192.0.2.1"):
        ServerParams(host="192.0.2.1", token=tmp_path / "token").listen()


@pytest.mark.parametrize(("host", "by_token"), [("0.0.0.0", False), ("0.0.0.0", True), ("127.0.0.1", False)])
def test_tls_without_a_token_logs_a_warning(
    host: str, by_token: bool, certificate: tuple[Path, Path], token: Path,
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("uvicorn.Server.run", lambda self, sockets: None)
    given = token if by_token else None
    served = ServerParams(port=0, host=host, token=given, certificate=certificate[0], key=certificate[1])
    factory.run(app_of(served), served, lambda address: None)
    assert ("--token FILE" in caplog.text) == (host == "0.0.0.0" and not by_token)


class Service:
    """A running service, whose clock is constant unless the test sets it, so that nothing times out by chance.

    Attributes:
        port: its TCP port.
        bodies: bodies of its requests.
        entered: whether a request has reached `/wait`, which answers once `released`.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.entered, self.released = threading.Event(), threading.Event()
        self._now, loops = 1000.0, list[asyncio.AbstractEventLoop]()
        monkeypatch.setattr(limits.LimitedEventLoop, "time", lambda loop: self._now)
        created: list[bodies.Bodies] = []

        def create(max_bytes: int) -> bodies.Bodies:
            created.append(bodies.Bodies(max_bytes))
            return created[-1]

        monkeypatch.setattr(factory, "Bodies", create)
        addresses: list[str] = []
        params = ServerParams(port=0)
        app = app_of(params)

        @app.get("/loop")
        async def loop() -> None:
            loops.append(asyncio.get_running_loop())

        @app.get("/wait")
        def wait() -> float:
            self.entered.set()
            self.released.wait()
            return 2.0

        @app.websocket("/echo")
        async def echo(socket: WebSocket) -> None:
            await socket.accept()
            await socket.send_text(await socket.receive_text())

        threading.Thread(target=factory.run, args=(app, params, addresses.append), daemon=True).start()
        until(lambda: addresses)
        self.port = int(addresses[0].rsplit(":")[-1].strip("/"))
        self.get("loop")
        self.bodies, self._loop = created[0], loops[0]

    def get(self, path: str = "number?value=2") -> bytes:
        """Content of a response."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/{path}", timeout=60) as answer:
            return bytes(answer.read())

    def connect(self, sent: bytes = b"") -> socket.socket:
        """Open a connection, and send something."""
        sock = socket.create_connection(("127.0.0.1", self.port), timeout=60)
        sock.sendall(sent)
        return sock

    def advance(self, seconds: float) -> None:
        """Let the service handle what was sent, then let time pass."""
        self._settle()
        self._now += seconds
        self._settle()

    def _settle(self) -> None:
        async def turns() -> None:
            for _ in range(50):
                await asyncio.sleep(0)

        asyncio.run_coroutine_threadsafe(turns(), self._loop).result(60)


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    """A running service."""
    service = Service(monkeypatch)
    yield service
    service.released.set()


def is_open(sock: socket.socket) -> bool:
    """Whether a connection is open, and nothing was received."""
    poll = select.poll()
    poll.register(sock, select.POLLIN)
    return not poll.poll(0)


def test_a_thousand_idle_connections_do_not_block_others_and_are_closed(plain: Service) -> None:
    idle = [plain.connect() for _ in range(1000)]
    assert plain.get() == b"2.0"
    plain.advance(limits.REQUEST_TIMEOUT_S - 0.1)
    assert all(map(is_open, idle))
    plain.advance(0.2)
    for one in idle:
        assert one.recv(1) == b""
        one.close()


def test_further_connections_are_closed_at_once(plain: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MAX_CONNECTIONS", 3)
    plain.advance(0)
    idle = [plain.connect() for _ in range(3)]
    with plain.connect() as further:
        assert further.recv(1) == b""
    idle.pop().close()
    until(lambda: is_served(plain))
    for one in idle:
        one.close()


def is_served(service: Service) -> bool:
    with contextlib.suppress(OSError):
        return bool(service.get("health/live"))
    return False


GET = b"GET /number?value=2 HTTP/1.1\r\nHost: localhost\r\n"
POST = b"POST /nix HTTP/1.1\r\nHost: localhost\r\nContent-Length: 999\r\n"


@pytest.mark.parametrize("first", [b"", GET + b"\r\n", POST + b"\r\n"], ids=["first", "second", "rejected body"])
def test_slow_headers_time_out(plain: Service, first: bytes) -> None:
    """Slowloris: in the first header, in a later one, or in the body of a request that has been answered."""
    with plain.connect(first) as slow:
        if first.startswith(b"POST"):
            until(lambda: plain.bodies._arriving)
            plain.advance(bodies.BODY_TIMEOUT_S + 0.1)
        answer = b""
        while first and not answer.endswith((b"2.0", b"}")):
            answer += slow.recv(2**16)
        for byte in GET[:9]:
            slow.sendall(bytes([byte]))
            plain.advance(limits.REQUEST_TIMEOUT_S / 10)
        assert is_open(slow)
        slow.sendall(GET[9:10])
        plain.advance(limits.REQUEST_TIMEOUT_S / 9)
        with contextlib.suppress(ConnectionResetError):
            assert slow.recv(1) == b""


def test_slow_responses_and_silent_websockets_are_not_cut_off(plain: Service) -> None:
    with connect(f"ws://127.0.0.1:{plain.port}/echo", open_timeout=60) as silent:
        with plain.connect(b"GET /wait HTTP/1.1\r\nHost: localhost\r\n\r\n") as slow:
            assert plain.entered.wait(60)
            plain.advance(1.5 * limits.REQUEST_TIMEOUT_S)
            assert is_open(slow)
            plain.released.set()
            assert slow.recv(100).startswith(b"HTTP/1.1 200")
        silent.send("still here")
        assert silent.recv(60) == "still here"


def half_post(service: Service, sent: int = 3, size: int = 10) -> socket.socket:
    head = f"POST /length HTTP/1.1\r\nHost: localhost\r\nContent-Length: {size}\r\n\r\n"
    return service.connect(head.encode() + b"x" * sent)


def test_missing_body_times_out(plain: Service) -> None:
    with half_post(plain) as half:
        until(lambda: plain.bodies._total == 3)
        plain.advance(bodies.BODY_TIMEOUT_S - 0.1)
        assert is_open(half)
        plain.advance(0.2)
        assert b"408" in half.recv(100)


def test_complete_body_that_is_too_large_is_rejected_at_once(plain: Service) -> None:
    size = factory.MAX_BODY_BYTES
    head = b"POST /length HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n%x\r\n" % size
    with plain.connect(head + b"x" * size) as whole:
        until(lambda: plain.bodies._total == size)
        whole.sendall(b"\r\n1\r\nx\r\n0\r\n\r\n")
        assert b"413" in whole.recv(100)


def test_body_that_arrives_in_parts_has_a_deadline_in_total(plain: Service) -> None:
    with half_post(plain, size=100) as slow:
        until(lambda: plain.bodies._total == 3)
        for _ in range(9):
            slow.send(b"x")
            plain.advance(bodies.BODY_TIMEOUT_S / 10)
        assert is_open(slow)
        plain.advance(bodies.BODY_TIMEOUT_S / 9)
        assert b"408" in slow.recv(100)


def test_body_that_has_been_arriving_longest_is_given_up_for_others(
    plain: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bodies, "MAX_ARRIVING", 3)
    slow: list[socket.socket] = []
    for count in (1, 2, 3, 3, 3):
        slow.append(half_post(plain))
        until(lambda: plain.bodies._total == 3 * count)  # noqa: B023
        plain.advance(0)
        assert len(plain.bodies._arriving) == count
    assert [b"408" in one.recv(100) for one in slow[:2]] == [True, True]
    for one in slow[2:]:
        one.sendall(b"y" * 7)
        assert b"200" in one.recv(100)
        one.close()


def test_memory_for_bodies_is_limited(plain: Service) -> None:
    size, count = factory.MAX_BODY_BYTES, bodies.MAX_MEMORY_BODIES
    slow = []
    for number in range(1, count + 1):
        slow.append(half_post(plain, size - 1, size))
        until(lambda: plain.bodies._total == number * (size - 1))  # noqa: B023
    with half_post(plain, size, size) as complete:
        assert b"200" in complete.recv(100)
    assert b"408" in slow[0].recv(100), "the oldest was given up"
    assert all(map(is_open, slow[1:]))
    for one in slow:
        one.close()


def test_health_is_served_whatever_the_number_of_requests(plain: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factory, "MAX_CONCURRENT_REQUESTS", 1)
    with plain.connect(b"GET /wait HTTP/1.1\r\nHost: localhost\r\n\r\n"):
        assert plain.entered.wait(60)
        with pytest.raises(HTTPError) as caught:
            plain.get()
        assert caught.value.code == 503 and caught.value.headers["Retry-After"] == "1"
        assert plain.get("health/live")


def test_cross_origin_requests_are_rejected() -> None:
    """Browsers send the Origin header with cross-site forms (CSRF)."""
    client = TestClient(app_of(), base_url="http://localhost:8080")
    assert client.post("/length", content=b"abc", headers={"Origin": "http://evil.example"}).status_code == 403
    assert client.post("/length", content=b"abc", headers={"Origin": "null"}).status_code == 403
    assert client.post("/length", content=b"abc", headers={"Origin": "http://localhost:8080"}).json() == 3
    assert client.post("/length", content=b"abc").json() == 3 and client.get("/number?value=1").json() == 1
