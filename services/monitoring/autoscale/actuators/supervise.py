"""Runs a program for as long as this one's input is open: so none is left when the one that started it is killed.

The program is this one's arguments. It is asked to end (SIGTERM), and killed with all that it started if it doesn't.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading

ENDS_WITHIN = 20.0
"""Seconds that a program has to end, once it is asked to."""


def command(program: list[str]) -> list[str]:
    """That keeps a program."""
    return [sys.executable, "-I", "-S", __file__, *program]


def main() -> None:
    """Run it to its end, or to that of the input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started this one
    program = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, start_new_session=True)
    threading.Thread(target=_end_with_input, args=(program,), daemon=True).start()
    sys.exit(abs(program.wait()))


def _end_with_input(program: subprocess.Popen[bytes]) -> None:
    sys.stdin.buffer.read()
    program.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        program.wait(ENDS_WITHIN)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(program.pid, signal.SIGKILL)
    program.wait()


if __name__ == "__main__":
    main()
