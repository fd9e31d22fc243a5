"""Estimates the cost of a plan: steps that run for certain, steps that run if their inputs really change, and times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scan2sim.flows.engine.planning import UNLESS_SAME, PlannedTask, why
from scan2sim.pipeline.core.cache import Store


@dataclass(frozen=True)
class Estimate:
    """What a planned task costs.

    Attributes:
        item: the task.
        why: why it runs, or that its result is cached.
        certain: whether it runs for certain; else it runs only if the results that it reads really change.
        seconds: time that it took before, in this tile or on average in others; None: never run, 0: it doesn't run.
    """

    item: PlannedTask
    why: str
    certain: bool
    seconds: float | None

    @property
    def runs(self) -> bool:
        """Whether it runs, for certain or perhaps."""
        return self.item.reason is not None


def estimates(planned: Sequence[PlannedTask], store: Store) -> list[Estimate]:
    """The cost of each task of a plan, in its order."""
    running = [item for item in planned if item.reason is not None]
    known = {item.task.id: found.seconds for item in running if (found := store.newest(item.task.full_name))}
    elsewhere: dict[str, list[float]] = {}
    for task, took in known.items():
        elsewhere.setdefault(task.name, []).append(took)
    rows = []
    for item in planned:
        text, others = why(item, store), elsewhere.get(item.task.id.name)
        seconds = known.get(item.task.id, sum(others) / len(others) if others else None)
        certain = item.reason is not None and text != UNLESS_SAME
        rows.append(Estimate(item, text, certain, seconds if item.reason is not None else 0.0))
    return rows


def summary(rows: Sequence[Estimate]) -> str:
    """A sentence about a plan's cost: "3 steps run, about 12 s; 40 more if their inputs really change, about 5 min"."""
    certain, others = [row for row in rows if row.certain], [row for row in rows if row.runs and not row.certain]
    if not certain and not others:
        return "nothing to do"
    parts = [f"{len(certain)} of {len(rows)} steps run, {total(certain)}"]
    if others:
        parts.append(f"{len(others)} more if their inputs really change, {total(others)}")
    return "; ".join(parts)


def duration(seconds: float | None) -> str:
    """A time for people: 0.4 s, 12 s, 5 min, 2.5 h; "?" if unknown."""
    if seconds is None:
        return "?"
    if seconds < 99:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 99 * 60 else f"{seconds / 3600:.1f} h"


def total(rows: Sequence[Estimate]) -> str:
    """Sum of the times: "about 12 s and 3 of unknown time"."""
    known = [row.seconds for row in rows if row.seconds is not None]
    if not known:
        return "time unknown"
    unknown = "" if len(known) == len(rows) else f" and {len(rows) - len(known)} of unknown time"
    return f"about {duration(sum(known))}{unknown}"
