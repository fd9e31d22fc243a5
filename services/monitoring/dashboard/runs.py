"""Runs of steps as events of the bus say (`events.RunState`, `events.StepState`), for as long as fits on a page.

Bounds: `RUNS` runs (of those that go on no more, the one longest silent goes; a new one is refused where all go on) and
`STEPS` steps of each.
"""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.history import Refused
from scan2sim.services.monitoring.events.schema import RunState, StepState

RUNS, STEPS = 32, 5000
"""Runs, and steps of one, that are kept at most."""
SHOWN = 16
"""Steps of a run that are shown, at most: those that run, then those that failed, then those that were done last."""
SILENT = 20.0
"""Seconds without a word after which a run counts as silent; one that lives says something every five."""
ORDER = ("running", "failed", "done")
ENDED = ("done", "kept", "failed")


@dataclass
class _Run:
    """What is known of a run.

    Attributes:
        came: seconds since the epoch, when it was heard of last.
        last: its own state; None: of its steps alone was heard.
        steps: by tile and name, the one heard of last at the end.
        version: grows with what is known.
        details: as `state` has them; None: not made yet.
    """

    came: float
    last: RunState | None = None
    steps: dict[tuple[str, str], StepState] = field(default_factory=dict)
    version: int = 0
    details: dict[str, Any] | None = None

    def goes_on(self, now: float) -> bool:
        """Whether more is to be expected of it."""
        return not self.has_ended() and now - self.came <= SILENT

    def has_ended(self) -> bool:
        """Whether it said so."""
        return self.last is not None and self.last.state != "running"


class Runs:
    """Takes states of runs and steps; may be used from any thread."""

    def __init__(self) -> None:
        self._runs: dict[str, _Run] = {}
        self._lock = threading.Lock()

    def take(self, state: RunState | StepState, at: float) -> None:
        """Keep the state of a run or a step at a time, seconds since the epoch.

        Raises:
            Refused: there is no room.
        """
        with self._lock:
            run = self._run(state.run, at)
            if isinstance(state, RunState):
                run.last = state
            else:
                _keep(run.steps, state)
            run.came, run.version, run.details = max(run.came, at), run.version + 1, None

    def _run(self, name: str, now: float) -> _Run:
        run = self._runs.get(name)
        if run is None:
            if len(self._runs) >= RUNS:
                over = [name for name, run in self._runs.items() if not run.goes_on(now)]
                if not over:
                    raise Refused(f"of more than {RUNS} runs: no room")
                del self._runs[min(over, key=lambda name: self._runs[name].came)]
            run = self._runs[name] = _Run(now)
        return run

    def state(self, now: float) -> list[dict[str, Any]]:
        """All runs, JSON-able; `now` in seconds since the epoch.

        Returns:
            Those that go on first, then the latest: `run`, its id; `came`, when it was heard of last; `silent`, whether
            it fell silent before it ended; `version`, and what changes with it, `details`: `last`, its own state or
            null, `steps`, up to `SHOWN`, `known`, how many there are, and `others`, those not shown by their state.
        """
        with self._lock:
            runs = sorted(self._runs.items(), key=lambda item: (not item[1].goes_on(now), -item[1].came))
            for _, run in runs:
                run.details = run.details or _details(run)
            return [
                {
                    "run": name,
                    "came": run.came,
                    "silent": not run.has_ended() and not run.goes_on(now),
                    "version": run.version,
                    "details": run.details,
                }
                for name, run in runs
            ]


def _keep(steps: dict[tuple[str, str], StepState], state: StepState) -> None:
    """Keep a step's state; one that ended runs again only after it waited: a flow and its worker publish both."""
    place = state.tile, state.step
    known = steps.get(place)
    if known is None and len(steps) >= STEPS:
        raise Refused(f"of a run of more than {STEPS} steps: no room")
    if known is not None:
        if known.state in ENDED and state.state == "running":
            return
        if state.host is None and state.state != "waiting":
            state = state.model_copy(update={"host": known.host})
        del steps[place]
    steps[place] = state


def _details(run: _Run) -> dict[str, Any]:
    latest_first = [step for step in reversed(run.steps.values()) if step.state in ORDER]
    shown = sorted(latest_first, key=lambda step: ORDER.index(step.state))[:SHOWN]
    others = Counter(step.state for step in run.steps.values())
    others.subtract(step.state for step in shown)
    return {
        "last": run.last and _printable(run.last.model_dump(exclude={"run"})),
        "steps": [_printable(step.model_dump(exclude={"run"})) for step in shown],
        "known": len(run.steps),
        "others": {state: count for state, count in others.items() if count},
    }


def _printable(state: dict[str, Any]) -> dict[str, Any]:
    return {name: printable(value) if isinstance(value, str) else value for name, value in state.items()}
