"""Workers that are programs which find their work themselves: so many copies of one, started anew where they die."""

from __future__ import annotations

import subprocess
import threading
import time
from dataclasses import dataclass

from scan2sim.services.monitoring.autoscale.actuators import supervise

LOOKED_AT = 0.5
"""Seconds between two looks at whether all run."""
LONGEST_PAUSE = 60.0
"""Seconds between two starts of a program that dies, at most."""
LASTED = 60.0
"""Seconds after which a program counts as one that runs."""


@dataclass
class _Copy:
    process: subprocess.Popen[bytes]
    started: float
    pause: float = 1.0


class Programs:
    """So many copies of a program (`actuators.Actuator`); on Linux and other systems with sessions of processes."""

    def __init__(self, program: list[str]) -> None:
        self._program, self._lock = program, threading.Lock()
        self._running: list[_Copy] = []
        self._ending: list[subprocess.Popen[bytes]] = []
        self._closed = threading.Event()
        self._keeping = threading.Thread(target=self._keep, name="programs", daemon=True)
        self._keeping.start()

    def scale(self, count: int) -> None:
        """Start or stop copies."""
        with self._lock:
            while len(self._running) < count:
                self._running.append(_Copy(self._start(), time.monotonic()))
            while len(self._running) > count:
                process = self._running.pop().process
                _end(process)
                self._ending.append(process)
            self._ending = [one for one in self._ending if one.poll() is None]

    def workers(self) -> int:
        """Those that run."""
        with self._lock:
            return sum(one.process.poll() is None for one in self._running)

    def close(self) -> None:
        """Stop all."""
        self._closed.set()
        self._keeping.join()
        self.scale(0)
        for process in self._ending:
            process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(supervise.command(self._program), stdin=subprocess.PIPE)

    def _keep(self) -> None:
        while not self._closed.wait(LOOKED_AT):
            now = time.monotonic()
            with self._lock:
                for one in self._running:
                    if one.process.poll() is not None and now - one.started > one.pause:
                        _end(one.process)
                        one.pause = 1.0 if now - one.started > LASTED else min(LONGEST_PAUSE, 2 * one.pause)
                        one.process, one.started = self._start(), now


def _end(process: subprocess.Popen[bytes]) -> None:
    assert process.stdin
    process.stdin.close()
