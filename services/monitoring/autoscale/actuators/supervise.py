"""Runs a program while the supervisor's standard input is open, so that none is left when the parent is killed.

The arguments are the program's command line. It receives SIGTERM, and after a timeout its process group is killed.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading

STOP_TIMEOUT_S = 20.0
"""Time that the program has to exit after SIGTERM."""


def command(program: list[str]) -> list[str]:
    """Command line that runs a program under supervision."""
    return [sys.executable, "-I", "-S", __file__, *program]


def main() -> None:
    """Run the program until it exits or the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
    program = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, start_new_session=True)
    threading.Thread(target=_end_with_input, args=(program,), daemon=True).start()
    sys.exit(abs(program.wait()))


def _end_with_input(program: subprocess.Popen[bytes]) -> None:
    sys.stdin.buffer.read()
    program.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        program.wait(STOP_TIMEOUT_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(program.pid, signal.SIGKILL)
    program.wait()


if __name__ == "__main__":
    main()
