"""The robot's requests to a test server."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from scan2sim.services.qos.robot import MAX_CONNECTIONS, send_images
from tests.fakes.virtual_clock import VirtualClock


class ImpatientServer(BaseHTTPRequestHandler):
    """Responds to every image, and closes the connection after each response without announcing it."""

    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        body = b'{"state": "done"}'
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
        self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


class Server(ThreadingHTTPServer):
    request_queue_size = 64  # the robot opens all its connections at once


@pytest.fixture
def address() -> Iterator[str]:
    with Server(("127.0.0.1", 0), ImpatientServer) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_requests_are_retried_when_the_server_closes_idle_connections(address: str) -> None:
    time = VirtualClock()
    stats = send_images(address, "classify", [b"an image"], rate=10, seconds=3.0, clock=time, sleep=time.sleep)
    assert stats.sent == 30 > 2 * MAX_CONNECTIONS
    assert stats.states == {"done": 30}


def test_an_unreachable_server_is_reported_as_errors() -> None:
    stats = send_images("http://127.0.0.1:9", "classify", [b"an image"], rate=100, seconds=0.05)
    assert stats.states == {"ConnectionRefusedError": 5} and stats.response_p95 == float("inf")
