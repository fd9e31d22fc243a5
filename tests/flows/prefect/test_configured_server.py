"""Prefect servers that can't be used: each is named before anything runs, with what to change."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

pytest.importorskip("prefect", reason="Prefect isn't installed")

from scan2sim.flows.deployed.prefect_server import LOOPBACK, _warning_of_database, prefect_server  # isort: skip  # before prefect
from prefect import __version__
from prefect.settings import PREFECT_API_URL, temporary_settings

from scan2sim.pipeline.core.errors import UnavailableError

Serve = Callable[[int, str], None]


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Iterator[Serve]:
    """Configure a server that is healthy, and answers everything else with a status and a text."""
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, LOOPBACK)
    answer = (200, "")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            status, text = (200, "true") if self.path == "/api/health" else answer
            self.send_response(status)
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    def go(status: int, text: str) -> None:
        nonlocal answer
        answer = (status, text)

    with ThreadingHTTPServer((LOOPBACK, 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with temporary_settings({PREFECT_API_URL: f"http://{LOOPBACK}:{server.server_port}/api"}):
            yield go
        server.shutdown()


@pytest.mark.parametrize(
    ("status", "text", "cause", "remedy"),
    [
        (401, "{}", "refuses the credentials", "PREFECT_API_AUTH_STRING"),
        (404, "{}", "isn't the API of a Prefect server", "4200/api"),
        (200, "<html>", "isn't the API of a Prefect server", "prefect config unset PREFECT_API_URL"),
        (200, '"1.2.3"', "has version 1.2.3, but this machine", "same version"),
    ],
)
def test_server_that_cannot_be_used_is_named(serve: Serve, status: int, text: str, cause: str, remedy: str) -> None:
    serve(status, text)
    with pytest.raises(UnavailableError) as caught, prefect_server():
        pass
    assert cause in caught.value.cause and remedy in caught.value.remedy


@pytest.mark.parametrize(
    ("url", "warned"),
    [
        ("sqlite+aiosqlite:////nowhere/home/me/.prefect/prefect.db", True),
        ("sqlite+aiosqlite:////tmp/prefect.db", False),
        ("sqlite+aiosqlite:///:memory:", False),
        ("postgresql+asyncpg://prefect:SECRET@localhost/prefect", False),
    ],
)
def test_temporary_server_warns_of_a_database_on_a_network_drive(url: str, warned: bool, tmp_path: Path) -> None:
    lines = ["22 1 8:1 / / rw - ext4 /dev/sda1 rw", "40 22 0:44 / /nowhere/home rw - nfs4 server:/home rw,hard"]
    (tmp_path / "mountinfo").write_text("\n".join(lines), encoding="utf-8")
    text = _warning_of_database(url, tmp_path / "mountinfo") or ""
    assert ("network drive (nfs4)" in text and "PREFECT_SERVER_DATABASE_CONNECTION_URL=" in text) == warned


def test_server_of_this_version_is_used(serve: Serve) -> None:
    serve(200, json.dumps(__version__))
    with prefect_server():
        pass
