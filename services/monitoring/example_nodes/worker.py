"""A worker to try scaling with: takes a given time over each event. Reads a line, answers with a line.

Seconds an event are its argument: half a one is D3.2's worker, which does two events a second.
"""

from __future__ import annotations

import sys
import time


def command(seconds: float) -> list[str]:
    """That starts one; Python's libraries are left out, so it is there in a blink."""
    return [sys.executable, "-I", "-S", __file__, repr(seconds)]


def main() -> None:
    """Work until there is no more input."""
    for _ in sys.stdin:
        time.sleep(float(sys.argv[1]))
        print("done", flush=True)


if __name__ == "__main__":
    main()
