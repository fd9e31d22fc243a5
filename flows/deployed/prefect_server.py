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
from pathlib import Path

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip  # before prefect
from prefect import __version__ as own_version
from prefect.client.base import ServerType
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.exceptions import PrefectHTTPStatusError
from prefect.settings import (
    PREFECT_API_URL,
    PREFECT_SERVER_DATABASE_CONNECTION_URL,
    PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS,
    temporary_settings,
)

from scan2sim.flows.commands.display import warn
from scan2sim.pipeline.core import mounts
from scan2sim.pipeline.core.errors import INTERRUPTED, UnavailableError, exit_code

LOOPBACK = "127.0.0.1"
REMEDY_SERVER = (
    "Start it (`prefect server start`), correct PREFECT_API_URL (http://HOST:4200/api), or remove it from the "
    "environment and from Prefect's profile (`prefect config unset PREFECT_API_URL`) to use a temporary server"
)
STOP_TIMEOUT_S = 10.0
"""Time allowed for the temporary server's last requests."""


@contextlib.contextmanager
def prefect_server() -> Iterator[None]:
    """Check that the configured Prefect server can be used; if none is configured, run a temporary one meanwhile.

    Raises:
        UnavailableError: the configured server doesn't answer, refuses the credentials or has another major version, or
            the temporary one doesn't start.
    """
    url = PREFECT_API_URL.value()
    if url is None:
        with _temporary_server():
            yield
        return
    with get_client(sync_client=True) as client:
        _check(url, client)
    yield


def _check(url: str, client: SyncPrefectClient) -> None:
    """Check that a server answers, accepts the credentials (which its health check doesn't need), and fits.

    Raises:
        UnavailableError: it doesn't.
    """
    problem = client.api_healthcheck()
    if problem is not None:
        raise _refused(url, problem) or UnavailableError(
            url, f"the Prefect server doesn't answer ({problem})", REMEDY_SERVER
        )
    if client.server_type == ServerType.CLOUD:
        return
    try:
        version = client.api_version()
    except PrefectHTTPStatusError as error:
        raise _refused(url, error) or UnavailableError(
            url, f"isn't the API of a Prefect server ({error})", REMEDY_SERVER
        ) from None
    except ValueError:  # not JSON: the page for browsers
        raise UnavailableError(url, "isn't the API of a Prefect server", REMEDY_SERVER) from None
    if version.split(".")[0] != own_version.split(".")[0]:
        cause = f"the Prefect server has version {version}, but this machine {own_version}"
        raise UnavailableError(url, cause, "Install the same version on both (constraints.txt)")


def _refused(url: str, error: Exception) -> UnavailableError | None:
    """The error for the user if a server answered that it doesn't accept the credentials."""
    if not isinstance(error, PrefectHTTPStatusError) or error.response.status_code not in (401, 403):
        return None
    remedy = (
        "Set PREFECT_API_AUTH_STRING to the server's PREFECT_SERVER_API_AUTH_STRING (user:password); "
        "for Prefect Cloud, run `prefect cloud login`"
    )
    return UnavailableError(url, "the Prefect server refuses the credentials", remedy)


@contextlib.contextmanager
def _temporary_server() -> Iterator[None]:
    """Serve Prefect's API in a thread of this process.

    The server that Prefect itself would start is another process, which outlives a killed command. On Ctrl-C the
    process exits at once: nobody would see the state of the run after it, and Prefect waits for its running tasks.
    """
    import uvicorn
    from prefect.server.api.server import create_app

    if (text := _warning_of_database(str(PREFECT_SERVER_DATABASE_CONNECTION_URL.value()))) is not None:
        warn(text)
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


def _warning_of_database(url: str, mounted: Path = mounts.MOUNTED) -> str | None:
    """Warning if a server's SQLite database is on a network drive, where SQLite stalls or fails; None if it isn't."""
    _, _, path = url.partition(":///")
    mount = mounts.mount_of(Path(path), mounted) if url.startswith("sqlite") and path else None
    if mount is None or not mount.is_network:
        return None
    return (
        f"the database of the temporary Prefect server, {path}, is on a network drive ({mount.kind}): it may stall or "
        "fail, and servers on two machines damage it. Put it on a local disk: "
        "export PREFECT_SERVER_DATABASE_CONNECTION_URL=sqlite+aiosqlite:////tmp/$USER-prefect.db"
    )


def bypass_proxy(host: str) -> None:
    """Let this process and its children reach a host without the proxy that the environment may name."""
    for name in ("NO_PROXY", "no_proxy"):
        os.environ[name] = ",".join(filter(None, (os.environ.get(name), host)))


def _exit(*_: object) -> None:
    print(INTERRUPTED, file=sys.stderr, flush=True)
    os._exit(exit_code(KeyboardInterrupt()))
