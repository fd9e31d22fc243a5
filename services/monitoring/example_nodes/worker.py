"""Example worker for autoscaling: takes a fixed time per event. Reads a line per event and replies with a line.

Its argument is the time per event in seconds: 0.5 corresponds to D3.2's worker, which processes two events per second.
"""

from __future__ import annotations

import sys
import time


def command(seconds: float) -> list[str]:
    """Command line that starts a worker; it skips `site` (-I -S), so that it starts fast."""
    return [sys.executable, "-I", "-S", __file__, repr(seconds)]


def main() -> None:
    """Process events until the end of the input."""
    for _ in sys.stdin:
        time.sleep(float(sys.argv[1]))
        print("done", flush=True)


if __name__ == "__main__":
    main()
