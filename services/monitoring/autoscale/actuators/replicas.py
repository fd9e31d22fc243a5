"""Actuator for replicas of a program that fetches its work itself; replicas that die are restarted."""

from __future__ import annotations

import subprocess
import threading
import time
from dataclasses import dataclass

from scan2sim.services.monitoring.autoscale.actuators import supervise
from scan2sim.services.supervision import SupervisedThread

CHECK_INTERVAL_S = 0.5
"""Pause between two checks whether all replicas are running."""
MAX_RESTART_PAUSE_S = 60.0
"""Upper bound of the exponential backoff between restarts of a replica."""
STABLE_AFTER_S = 60.0
"""A replica that has run for so long restarts without backoff."""


@dataclass
class _Replica:
    process: subprocess.Popen[bytes]
    started: float
    pause: float = 1.0


class ProgramReplicas:
    """Replicas of a program (`actuators.Actuator`); on Linux and other systems with process sessions."""

    def __init__(self, program: list[str]) -> None:
        self._program, self._lock = program, threading.Lock()
        self._running: list[_Replica] = []
        self._ending: list[subprocess.Popen[bytes]] = []
        self._closed = threading.Event()
        self._supervisor = SupervisedThread(self._supervise, "programs")
        self._supervisor.start()

    def scale(self, count: int) -> None:
        """Set the number of replicas."""
        with self._lock:
            while len(self._running) < count:
                self._running.append(_Replica(self._start(), time.monotonic()))
            while len(self._running) > count:
                process = self._running.pop().process
                _end(process)
                self._ending.append(process)
            self._ending = [one for one in self._ending if one.poll() is None]

    def workers(self) -> int:
        """Number of running replicas."""
        with self._lock:
            return sum(one.process.poll() is None for one in self._running)

    def close(self) -> None:
        """Stop all replicas and wait until they have ended."""
        self._closed.set()
        self._supervisor.join()
        self.scale(0)
        for process in self._ending:
            process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(supervise.command(self._program), stdin=subprocess.PIPE)

    def _supervise(self) -> None:
        while not self._closed.wait(CHECK_INTERVAL_S):
            now = time.monotonic()
            with self._lock:
                for one in self._running:
                    if one.process.poll() is not None and now - one.started > one.pause:
                        _end(one.process)
                        is_stable = now - one.started > STABLE_AFTER_S
                        one.pause = 1.0 if is_stable else min(MAX_RESTART_PAUSE_S, 2 * one.pause)
                        one.process, one.started = self._start(), now


def _end(process: subprocess.Popen[bytes]) -> None:
    assert process.stdin
    process.stdin.close()
