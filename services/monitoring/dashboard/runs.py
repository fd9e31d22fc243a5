"""Progress of the runs that is published on the bus (`schema.RunState`, `schema.StepState`).

Bounds: `MAX_RUNS` (a new run replaces the inactive one that has been silent for the longest, and is rejected if all are
active) and `MAX_STEPS` tasks of each run.
"""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.events.schema import RunState, StepState
from scan2sim.services.monitoring.messages import RejectedError

MAX_RUNS, MAX_STEPS = 32, 5000
"""Runs, and tasks of one run, that are stored."""
MAX_LISTED_STEPS = 16
"""Tasks of a run that are listed: first the running ones, then the failed ones, then those done last."""
SILENT_AFTER_S = 20.0
"""A run without an event for so long counts as silent; an active one publishes every five seconds."""
LISTED_STATES = ("running", "failed", "done")
FINAL_STATES = ("done", "cached", "failed")


@dataclass
class _Run:
    """Latest states of a run and its tasks.

    Attributes:
        last_seen: time of its last event, seconds since the epoch.
        last: its latest state; None: only events of its tasks were received.
        steps: states of its tasks by tile and name, the most recently updated last.
        version: increased by every event.
        details: cached part of `Runs.state`; None: to be computed.
    """

    last_seen: float
    last: RunState | None = None
    steps: dict[tuple[str, str], StepState] = field(default_factory=dict)
    version: int = 0
    details: dict[str, Any] | None = None

    def is_active(self, now: float) -> bool:
        """Whether more events are expected."""
        return not self.has_ended() and now - self.last_seen <= SILENT_AFTER_S

    def has_ended(self) -> bool:
        """Whether its final state was received."""
        return self.last is not None and self.last.state != "running"


class Runs:
    """Latest states of runs and their tasks; thread-safe."""

    def __init__(self) -> None:
        self._runs: dict[str, _Run] = {}
        self._lock = threading.Lock()

    def add(self, state: RunState | StepState, at: float) -> None:
        """Store the state of a run or a task received at a time, seconds since the epoch.

        Raises:
            RejectedError: too many runs are active, or the run has too many tasks.
        """
        with self._lock:
            run = self._run(state.run, at)
            if isinstance(state, RunState):
                run.last = state
            else:
                _update(run.steps, state)
            run.last_seen, run.version, run.details = max(run.last_seen, at), run.version + 1, None

    def _run(self, name: str, now: float) -> _Run:
        run = self._runs.get(name)
        if run is None:
            if len(self._runs) >= MAX_RUNS:
                inactive = [name for name, run in self._runs.items() if not run.is_active(now)]
                if not inactive:
                    raise RejectedError(f"over the limit of {MAX_RUNS} runs: no room")
                del self._runs[min(inactive, key=lambda name: self._runs[name].last_seen)]
            run = self._runs[name] = _Run(now)
        return run

    def state(self, now: float) -> list[dict[str, Any]]:
        """JSON-serializable states of all runs; `now` in seconds since the epoch.

        Returns:
            Active runs first, then the most recent ones: `run`, its id; `came`, time of its last event; `silent`,
            whether it fell silent before it ended; `version`; and `details`, which change with the version: `last`, its
            own state or null, `steps`, up to `MAX_LISTED_STEPS` tasks, `known`, their number, and `others`, the number
            of unlisted ones by state.
        """
        with self._lock:
            runs = sorted(self._runs.items(), key=lambda item: (not item[1].is_active(now), -item[1].last_seen))
            for _, run in runs:
                run.details = run.details or _details(run)
            return [
                {
                    "run": name,
                    "came": run.last_seen,
                    "silent": not run.has_ended() and not run.is_active(now),
                    "version": run.version,
                    "details": run.details,
                }
                for name, run in runs
            ]


def _update(steps: dict[tuple[str, str], StepState], state: StepState) -> None:
    """Store the state of a task. Flow and worker both publish it: "running" after a final state is a late event."""
    key = state.tile, state.step
    known = steps.get(key)
    if known is None and len(steps) >= MAX_STEPS:
        raise RejectedError(f"over the limit of {MAX_STEPS} tasks of a run: no room")
    if known is not None:
        if known.state in FINAL_STATES and state.state == "running":
            return
        if state.host is None and state.state != "waiting":
            state = state.model_copy(update={"host": known.host})
        del steps[key]
    steps[key] = state


def _details(run: _Run) -> dict[str, Any]:
    latest_first = [step for step in reversed(run.steps.values()) if step.state in LISTED_STATES]
    listed = sorted(latest_first, key=lambda step: LISTED_STATES.index(step.state))[:MAX_LISTED_STEPS]
    others = Counter(step.state for step in run.steps.values())
    others.subtract(step.state for step in listed)
    return {
        "last": run.last and _printable(run.last.model_dump(exclude={"run"})),
        "steps": [_printable(step.model_dump(exclude={"run"})) for step in listed],
        "known": len(run.steps),
        "others": {state: count for state, count in others.items() if count},
    }


def _printable(state: dict[str, Any]) -> dict[str, Any]:
    return {name: printable(value) if isinstance(value, str) else value for name, value in state.items()}
