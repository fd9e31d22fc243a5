"""Workers that are processes of this machine, and take events from a queue.

A worker is any program that reads a line from its input and answers it with a line when that event is done. It ends
when its input does: so none is left when the one that started it is killed.
"""

from __future__ import annotations

import select
import subprocess
import threading
from collections.abc import Sequence

from scan2sim.services.monitoring.work.queue import EventQueue, Waiting

ENDS_WITHIN = 5.0
"""Seconds that a worker has to end, once its input has."""
LONGEST_PAUSE = 5.0
"""Seconds between two starts of a worker that dies at once, at most."""


class Processes:
    """So many workers of one queue (`actuators.Actuator`)."""

    def __init__(self, queue: EventQueue, command: Sequence[str], deadline: float = 60.0) -> None:
        """Of a command; a worker that doesn't answer for `deadline` seconds is killed, and its event is another's."""
        self._queue, self._command, self._deadline = queue, command, deadline
        self._lock = threading.Lock()
        self._running: list[_Worker] = []
        self._ending: list[_Worker] = []

    def scale(self, count: int) -> None:
        """Start or stop workers; those that are stopped do what they have begun."""
        with self._lock:
            while len(self._running) < count:
                self._running.append(_Worker(self._queue, self._command, self._deadline))
            while len(self._running) > count:
                ended = self._running.pop()
                ended.stop()
                self._ending.append(ended)
            self._ending = [one for one in self._ending if one.thread.is_alive()]

    def workers(self) -> int:
        """Those whose process is there, and that aren't told to stop."""
        with self._lock:
            return sum(one.alive for one in self._running)

    def close(self) -> None:
        """Stop all."""
        self.scale(0)
        for one in list(self._ending):
            one.thread.join(ENDS_WITHIN + self._deadline)


class _Worker:
    """A process, started anew where it dies, and the thread that hands it events."""

    def __init__(self, queue: EventQueue, command: Sequence[str], deadline: float) -> None:
        self._queue, self._command, self._deadline = queue, command, deadline
        self._stopped = threading.Event()
        self.alive = False
        self.thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self.thread.start()

    def stop(self) -> None:
        """End after what is begun."""
        self._stopped.set()

    def _run(self) -> None:
        pause = 0.0
        while not self._stopped.is_set():
            with subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
                self.alive = True
                try:
                    worked = self._serve(process)
                finally:
                    self.alive = False
                    _end(process)
            pause = 0.0 if worked else min(LONGEST_PAUSE, 2 * pause or 0.1)
            self._stopped.wait(pause)

    def _serve(self, process: subprocess.Popen[bytes]) -> bool:
        """Hand it events until it dies or is to stop; whether it did any."""
        worked = False
        while not self._stopped.is_set() and process.poll() is None:
            event = self._queue.take(0.2)
            if event is None:
                continue
            if not self._answers(process, event):
                self._queue.failed(event)
                process.kill()
                break
            self._queue.done(event)
            worked = True
        return worked

    def _answers(self, process: subprocess.Popen[bytes], event: Waiting) -> bool:
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
    except OSError:  # it died over a line
        pass
    try:
        process.wait(ENDS_WITHIN)
    except subprocess.TimeoutExpired:
        process.kill()
