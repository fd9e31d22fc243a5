"""Clients of a toolbox's servers: Triton's own, senders of slow bodies, and others that must be served meanwhile."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tests.fakes.interpreters import TRITON_PYTHON

CALLS = Path(__file__).with_name("triton_calls.py")
SLOW_POSTS = 300
SLOW_INTERVAL_S = 0.2
"""Pause between two bytes of a slow body."""


def call_by_triton(model: str, http_port: int, grpc_address: str, images: Sequence[Path]) -> dict[str, Any]:
    """Make all calls of `triton_calls.py`; returns their number, `calls`, and the errors by call, `failed`."""
    command = [*map(str, (TRITON_PYTHON, CALLS, model, f"127.0.0.1:{http_port}", grpc_address, *images))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


@contextlib.contextmanager
def slow_posts(port: int, path: str, count: int = SLOW_POSTS) -> Iterator[list[socket.socket]]:
    """Posts whose bodies arrive byte by byte while the context is active; yields their connections."""
    header = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/jpeg\r\nContent-Length: 100000\r\n\r\n"
    posts = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(count)]
    for post in posts:
        post.sendall(header.encode())
    stop = threading.Event()

    def trickle() -> None:
        while not stop.wait(SLOW_INTERVAL_S):
            for post in posts:
                with contextlib.suppress(OSError):
                    post.send(b"x")

    thread = threading.Thread(target=trickle, daemon=True)
    thread.start()
    try:
        yield posts
    finally:
        stop.set()
        thread.join()
        for post in posts:
            post.close()


def response_s(url: str, body: bytes | None = None, kind: str = "image/jpeg") -> float:
    """Seconds until the response to a request; infinite if it is an error or takes more than 10 s."""
    request = urllib.request.Request(url, body, {"Content-Type": kind} if body else {})
    began = time.monotonic()
    try:
        with urllib.request.urlopen(request, timeout=10) as response:
            response.read()
    except OSError:
        return float("inf")
    return time.monotonic() - began
