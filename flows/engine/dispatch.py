"""A plan handed step by step to whatever runs elsewhere (a cluster, say), and how far its tiles are."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from queue import SimpleQueue
from typing import Any, Protocol

from scan2sim.flows.engine.planning import Planned
from scan2sim.flows.engine.ready_queue import Event, Frontier, Outcome, Watch, unwatched
from scan2sim.flows.pipelines.graph import Node, NodeId
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import DamagedError, ScanError, StepError

PERIOD = 1.0  # seconds between two looks; what shows it may cost a tenth of one


class Future(Protocol):
    """Of a step that runs elsewhere (Prefect's futures are such)."""

    def add_done_callback(self, fn: Callable[[Any], None]) -> None:
        """Have `fn` called once the step has ended."""

    def result(self, *, raise_on_failure: bool) -> Any:
        """What the step returned, or its exception."""


def dispatch(
    planned: Sequence[Planned],
    store: Store,
    submit: Callable[[Planned], Future],
    at_once: int,
    show: Callable[[str, float], None],
    watch: Watch = unwatched,
) -> Outcome:
    """Submit what a plan says is missing as soon as what it reads is there; an `execute.Executor` but for the rest.

    Steps are submitted when they can run, not before: those that wait would take the places of those that could.

    Args:
        submit: has a step run, which leaves its result in the store.
        at_once: steps are submitted and not yet ended at a time.
        show: told a tile's name and how many percent of its steps are done, once a second at most.
        watch: told what else happens, but for what workers know of a step that runs.
    """
    board = Board(planned, show)

    def watching(node: Node, event: Event, fraction: float, message: str) -> None:
        watch(node, event, fraction, message)
        if event != "again":
            board.end(node.id)

    front = Frontier(planned, store, watching)
    running: dict[NodeId, tuple[Planned, Future]] = {}
    ended: SimpleQueue[NodeId] = SimpleQueue()
    while front or running:
        for item in front.ready():
            if len(running) >= at_once:
                break
            front.take(item)
            running[item.node.id] = (item, submit(item))
            running[item.node.id][1].add_done_callback(partial(_notify, ended, item.node.id))
        if running:
            item, future = running.pop(ended.get())
            try:
                outcome = future.result(raise_on_failure=False)
            except Exception as error:  # the runner has given the step up: it took several workers with it
                outcome = error
            if isinstance(outcome, DamagedError):
                front.again(item, outcome)
                continue
            name = item.node.full_name
            manifest = None if isinstance(outcome, BaseException) else store.find(name, item.key)
            if manifest is not None:
                front.end(item, manifest)
            else:
                cause = f"its worker failed ({type(outcome).__name__}: {outcome})"
                lost = StepError(name, cause, "Run again: what is finished is kept; the worker's log tells more")
                front.fail(item, outcome if isinstance(outcome, ScanError) else lost)
    board.flush()
    return front.outcome


def _notify(ended: SimpleQueue[NodeId], node: NodeId, _: object) -> None:
    ended.put(node)


class Board:
    """Counts each tile's steps as they end.

    Args:
        planned: of one tile or several.
        show: told a tile's name and how many percent of its steps are done.
    """

    def __init__(self, planned: Sequence[Planned], show: Callable[[str, float], None]) -> None:
        self._show = show
        self._left: dict[str, set[NodeId]] = {}
        for item in planned:
            self._left.setdefault(item.node.tile, set()).add(item.node.id)
        self._steps = {name: len(nodes) for name, nodes in self._left.items()}
        self._changed: set[str] = set()
        self._next = 0.0

    def end(self, node: NodeId) -> None:
        """A step has ended."""
        self._left[node.tile].discard(node)
        self._changed.add(node.tile)
        if time.monotonic() >= self._next:
            self.flush()

    def flush(self) -> None:
        """Show what has changed."""
        for name in sorted(self._changed):
            self._show(name or "tile", 100.0 * (1 - len(self._left[name]) / self._steps[name]))
        self._changed.clear()
        self._next = time.monotonic() + PERIOD
