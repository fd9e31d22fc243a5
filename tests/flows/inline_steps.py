"""Steps in the test's process instead of one process each, for worlds of tests whose subject isn't the processes.

Starting the process of a step, and the sandboxes of Poisson reconstruction and unwrapping, takes longer than a step of
the tiny street.
"""

from __future__ import annotations

import importlib
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numba
import pytest

from scan2sim.flows.commands import run_with_progress
from scan2sim.flows.engine.planning import PlannedTask, check
from scan2sim.flows.engine.ready_queue import EventCallback, Outcome, ReadyQueue
from scan2sim.flows.engine.run_task import run_task
from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import DamagedError, ScanError, StepError

_one_at_a_time = threading.Lock()
"""Native code that has a process of its own elsewhere may not be safe in several threads."""


@contextmanager
def inline_steps() -> Iterator[None]:
    """Let commands run in this process (`tests.flows.command.in_process`) run their steps in this process, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_with_progress, "execute", execute)
        patch.setattr(sandbox, "call", call)
        yield


def execute(
    planned: Sequence[PlannedTask], store: Store, *, on_event: EventCallback, keep_going: bool = False, **_: Any
) -> Outcome:
    """`scan2sim.flows.engine.execution.execute` without processes: one step after the other."""
    check(planned)
    queue, threads = ReadyQueue(planned, store, on_event), numba.get_num_threads()
    while queue:
        for item in queue.ready():
            queue.take(item)
            on_event(item.task, "start", 0.0, "")
            try:
                manifest = run_task(item, store, item.inputs(store))
            except DamagedError as error:
                queue.rebuild_damaged(item, error)
                break
            except ScanError as error:
                error.add_note(traceback.format_exc())
                queue.fail(item, error)
                if not (keep_going or item.task.side_product):
                    return queue.outcome
            else:
                queue.end(item, manifest)
            finally:
                numba.set_num_threads(threads)  # a step may have limited it
    return queue.outcome


def call(target: str, *args: Any, **_: Any) -> Any:
    """`scan2sim.pipeline.core.sandbox.call` without a process and its limits."""
    module, function = target.split(":")
    try:
        with _one_at_a_time:
            return getattr(importlib.import_module(module), function)(*args)
    except Exception as error:
        raise StepError(
            target, f"{type(error).__name__}: {error}", "Try another seed, backend or resolution"
        ) from error
