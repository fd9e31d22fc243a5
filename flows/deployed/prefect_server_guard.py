"""The temporary server that Prefect starts where none is named: it ends with the flow's process, however that ends."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

FLOW, SERVER = "SCAN2SIM_FLOW", "PREFECT__SERVER_EPHEMERAL"


@cache
def guard() -> None:
    """Have a process wait for the end of this one, and end the temporary server then (Linux; elsewhere nothing).

    Before Prefect starts it: the server inherits the mark by which it is known.
    """
    if sys.platform != "linux":
        return
    mark = os.environ[FLOW] = f"{os.getpid()}-{secrets.token_hex(8)}"
    end, _ = os.pipe()  # the other end, which only this process holds open, is closed by its death
    subprocess.Popen(
        [sys.executable, "-P", "-m", "scan2sim.flows.deployed.prefect_server_guard", mark],
        stdin=end,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, sys.path))),
        start_new_session=True,
    )
    os.close(end)


def _main(mark: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdin.buffer.read()
    wanted = {f"{FLOW}={mark}".encode(), f"{SERVER}=1".encode()}
    for path in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):  # it has ended, or is another user's
            if wanted <= set(path.read_bytes().split(b"\0")):
                os.kill(int(path.parent.name), signal.SIGKILL)


if __name__ == "__main__":
    _main(sys.argv[1])
