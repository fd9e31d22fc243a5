"""Supervision of background threads: no service lives on with a thread that died unnoticed.

A `SupervisedThread` logs a failure of its job and runs it again; health checks fail meanwhile. A thread that can't be
restarted, of this program or of a library, ends the process (`end_process_with_threads`), so that a service manager
restarts it.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from scan2sim.pipeline.core.errors import StepError

log = logging.getLogger(__name__)

FIRST_RESTART_PAUSE_S, MAX_RESTART_PAUSE_S = 0.1, 30.0
"""Pause before a failed job is run again; doubled with each failure, up to a maximum."""
STABLE_AFTER_S = 60.0
"""A job that has run for so long is run again after the first pause."""


class SupervisedThread(threading.Thread):
    """Daemon thread that runs a job until it returns, and runs it again, with exponential backoff, if it fails."""

    def __init__(self, job: Callable[[], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._job, self._ending, self._failed = job, threading.Event(), False

    def run(self) -> None:
        """Run the job until it returns."""
        pause = 0.0
        while True:
            began = time.monotonic()
            try:
                self._job()
                return
            except Exception:
                is_stable = time.monotonic() - began > STABLE_AFTER_S
                pause = FIRST_RESTART_PAUSE_S if is_stable or not pause else min(MAX_RESTART_PAUSE_S, 2 * pause)
                log.exception("the thread %r failed; it is restarted in %g s", self.name, pause)
            self._failed = True
            if self._ending.wait(pause):
                return
            self._failed = False

    def is_alive(self) -> bool:
        """Whether the job is running; False also while it waits to be run again after a failure."""
        return super().is_alive() and not self._failed

    def join(self, timeout: float | None = None) -> None:
        """Wait for the end of the job, which is not run again."""
        self._ending.set()
        super().join(timeout)


@contextmanager
def end_process_with_threads() -> Iterator[None]:
    """End this process as by SIGTERM if a thread dies of an exception while the context is active.

    In a thread other than the main thread this does nothing: the process isn't the caller's to end there, and the
    signal would not reach it.

    Raises:
        StepError: a thread has died; the exit status shows that the service has failed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    dead: list[str] = []
    report = threading.excepthook

    def end(died: threading.ExceptHookArgs) -> None:
        report(died)
        dead.append(f"the thread {died.thread.name if died.thread else '?'!r} failed ({died.exc_value!r:.200})")
        os.kill(os.getpid(), signal.SIGTERM)

    threading.excepthook = end
    try:
        yield
    finally:
        threading.excepthook = report
        if dead:
            raise StepError("service", dead[0], "Restart it; the log has the cause")
