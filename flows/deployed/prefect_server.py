"""Prefect server of a command: the configured one, or a temporary one that ends with the process, however it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect.client.orchestration import get_client
from prefect.settings import PREFECT_API_URL, PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS, temporary_settings

from scan2sim.pipeline.core.errors import INTERRUPTED, UnavailableError, exit_code

LOOPBACK = "127.0.0.1"
STOP_TIMEOUT_S = 10.0
"""Time allowed for the temporary server's last requests."""


@contextlib.contextmanager
def prefect_server() -> Iterator[None]:
    """Check that the configured Prefect server answers; if none is configured, run a temporary one meanwhile.

    Raises:
        UnavailableError: the configured server doesn't answer, or the temporary one doesn't start.
    """
    url = PREFECT_API_URL.value()
    if url is None:
        with _temporary_server():
            yield
        return
    with get_client(sync_client=True) as client:
        problem = client.api_healthcheck()
    if problem is not None:
        remedy = "Start it (`prefect server start`), or unset PREFECT_API_URL to use a temporary server"
        raise UnavailableError(url, f"the Prefect server doesn't answer ({problem})", remedy)
    yield


@contextlib.contextmanager
def _temporary_server() -> Iterator[None]:
    """Serve Prefect's API in a thread of this process.

    The server that Prefect itself would start is another process, which outlives a killed command. On Ctrl-C the
    process exits at once: nobody would see the state of the run after it, and Prefect waits for its running tasks.
    """
    import uvicorn
    from prefect.server.api.server import create_app

    config = uvicorn.Config(create_app(ephemeral=True, final=True), log_level="error", lifespan="on")
    server, timeout = uvicorn.Server(config), PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS.value()
    with socket.create_server((LOOPBACK, 0)) as listener:
        url = f"http://{LOOPBACK}:{listener.getsockname()[1]}/api"
        thread = threading.Thread(target=server.run, args=([listener],), name="Prefect server", daemon=True)
        thread.start()
        deadline = time.monotonic() + timeout
        while not server.started:
            if not thread.is_alive() or time.monotonic() > deadline:
                remedy = "See its messages above; `prefect server start` starts one that keeps running"
                raise UnavailableError(url, f"the temporary Prefect server didn't start within {timeout} s", remedy)
            time.sleep(0.05)
        bypass_proxy(LOOPBACK)
        previous = signal.signal(signal.SIGINT, _exit)
        try:
            with temporary_settings({PREFECT_API_URL: url}):
                yield
        finally:
            signal.signal(signal.SIGINT, previous)
            server.should_exit = True
            thread.join(STOP_TIMEOUT_S)


def bypass_proxy(host: str) -> None:
    """Let this process and its children reach a host without the proxy that the environment may name."""
    for name in ("NO_PROXY", "no_proxy"):
        os.environ[name] = ",".join(filter(None, (os.environ.get(name), host)))


def _exit(*_: object) -> None:
    print(INTERRUPTED, file=sys.stderr, flush=True)
    os._exit(exit_code(KeyboardInterrupt()))
