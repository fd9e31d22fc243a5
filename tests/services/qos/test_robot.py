"""A robot's requests, against a server of its own."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from scan2sim.services.qos.robot import CONNECTIONS, ask


class Impatient(BaseHTTPRequestHandler):
    """Answers every image, and closes connections that lie idle for a moment."""

    protocol_version = "HTTP/1.1"
    timeout = 0.2

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        body = b'{"state": "done"}'
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@pytest.fixture
def address() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Impatient) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_images_that_come_seldom_are_answered_although_the_server_closes_idle_connections(address: str) -> None:
    answers = ask(address, "classify", [b"an image"], rate=10, seconds=3.0)
    assert answers.sent == 30 > 2 * CONNECTIONS
    assert answers.states == {"done": 30}


def test_a_server_that_is_not_there_is_told() -> None:
    answers = ask("http://127.0.0.1:9", "classify", [b"an image"], rate=100, seconds=0.05)
    assert answers.states == {"ConnectionRefusedError": 5} and answers.response_p95 == float("inf")
