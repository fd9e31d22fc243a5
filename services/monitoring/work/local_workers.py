"""Worker processes on this machine that process the events of a queue.

A worker is any program that reads a line per event from its input and replies with a line when the event is done. It
exits when its input ends, so that no worker is left when its parent is killed.
"""

from __future__ import annotations

import select
import subprocess
import threading
from collections.abc import Sequence

from scan2sim.services.monitoring.work.queue import EventQueue, QueuedEvent
from scan2sim.services.supervision import SupervisedThread

STOP_TIMEOUT_S = 5.0
"""Time that a worker has to exit after its input has ended."""
MAX_RESTART_PAUSE_S = 5.0
"""Upper bound of the exponential backoff between restarts of a worker that dies without processing an event."""


class LocalWorkers:
    """Actuator of the worker processes of one queue (`actuators.Actuator`)."""

    def __init__(self, queue: EventQueue, command: Sequence[str], deadline: float = 60.0) -> None:
        """`command` starts a worker; one that takes longer than `deadline` seconds per event is killed and retried."""
        self._queue, self._command, self._deadline = queue, command, deadline
        self._lock = threading.Lock()
        self._running: list[_Worker] = []
        self._ending: list[_Worker] = []

    def scale(self, count: int) -> None:
        """Set the number of workers; those that are stopped finish their current event first."""
        with self._lock:
            while len(self._running) < count:
                self._running.append(_Worker(self._queue, self._command, self._deadline))
            while len(self._running) > count:
                surplus = self._running.pop()
                surplus.stop()
                self._ending.append(surplus)
            self._ending = [one for one in self._ending if one.thread.is_alive()]

    def workers(self) -> int:
        """Number of workers with a running process, without those that are stopping."""
        with self._lock:
            return sum(one.alive for one in self._running)

    def close(self) -> None:
        """Stop all workers and wait until they have ended."""
        self.scale(0)
        for one in list(self._ending):
            one.thread.join(STOP_TIMEOUT_S + self._deadline)


class _Worker:
    """A worker process, restarted when it dies, and the thread that passes events to it."""

    def __init__(self, queue: EventQueue, command: Sequence[str], deadline: float) -> None:
        self._queue, self._command, self._deadline = queue, command, deadline
        self._stopped = threading.Event()
        self.alive = False
        self.thread = SupervisedThread(self._run, "worker")
        self.thread.start()

    def stop(self) -> None:
        """Stop after the current event."""
        self._stopped.set()

    def _run(self) -> None:
        pause = 0.0
        while not self._stopped.is_set():
            with subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
                self.alive = True
                try:
                    processed_any = self._serve(process)
                finally:
                    self.alive = False
                    _end(process)
            pause = 0.0 if processed_any else min(MAX_RESTART_PAUSE_S, 2 * pause or 0.1)
            self._stopped.wait(pause)

    def _serve(self, process: subprocess.Popen[bytes]) -> bool:
        """Pass events to the process until it dies or is stopped; returns whether it processed any."""
        processed_any = False
        while not self._stopped.is_set() and process.poll() is None:
            event = self._queue.take(0.2)
            if event is None:
                continue
            if not self._process_event(process, event):
                self._queue.failed(event)
                process.kill()
                break
            self._queue.done(event)
            processed_any = True
        return processed_any

    def _process_event(self, process: subprocess.Popen[bytes], event: QueuedEvent) -> bool:
        """Whether the worker processed the event within the deadline."""
        assert process.stdin and process.stdout
        try:
            process.stdin.write(event.line.encode() + b"\n")
            process.stdin.flush()
        except OSError:
            return False
        ready, _, _ = select.select([process.stdout], [], [], self._deadline)
        return bool(ready) and process.stdout.readline().endswith(b"\n")


def _end(process: subprocess.Popen[bytes]) -> None:
    assert process.stdin
    try:
        process.stdin.close()
    except OSError:  # the process died while a line was being written
        pass
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
