"""Stops the temporary server that Prefect starts if none is configured, however the flow's process ends."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

FLOW_VARIABLE, SERVER_VARIABLE = "SCAN2SIM_FLOW", "PREFECT__SERVER_EPHEMERAL"
"""Environment variables that mark processes of this flow, and Prefect's temporary server."""


@cache
def kill_server_on_exit() -> None:
    """Start a process that waits for the end of this one and then kills the temporary server (Linux only).

    Call it before Prefect starts the server, which inherits the environment variable that identifies it.
    """
    if sys.platform != "linux":
        return
    mark = os.environ[FLOW_VARIABLE] = f"{os.getpid()}-{secrets.token_hex(8)}"
    read_end, _ = os.pipe()  # the write end, open only in this process, is closed when it dies
    subprocess.Popen(
        [sys.executable, "-P", "-m", "scan2sim.flows.deployed.prefect_server_guard", mark],
        stdin=read_end,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, sys.path))),
        start_new_session=True,
    )
    os.close(read_end)


def _main(mark: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdin.buffer.read()
    wanted = {f"{FLOW_VARIABLE}={mark}".encode(), f"{SERVER_VARIABLE}=1".encode()}
    for path in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):  # it has ended, or belongs to another user
            if wanted <= set(path.read_bytes().split(b"\0")):
                os.kill(int(path.parent.name), signal.SIGKILL)


if __name__ == "__main__":
    _main(sys.argv[1])
