"""A toy survey: tiles of three steps that take a moment. Without Prefect, which every step's process would import."""

from __future__ import annotations

import multiprocessing
import os
import time
from pathlib import Path

from scan2sim.flows.engine.planning import Planned, plan
from scan2sim.flows.pipelines.graph import Node, Output
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from tests.flows.toy import ToyParams, toy

STEPS = ("first", "second", "third")


class SlowParams(ToyParams):
    """A toy that takes a moment before it counts its run, and waits until `gate` is there."""

    seconds: float = 0.3
    gate: Path | None = None


def slow(inputs: Inputs, params: SlowParams, out: Path, report: Report) -> Done:
    """As `toy`, later; tells beside the log who runs it: its own process, and the worker that asked for it."""
    parent = multiprocessing.parent_process()
    with open(params.log.with_name("started"), "a", encoding="utf-8") as file:
        file.write(f"{params.name} {os.getpid()} {parent.pid if parent else 0}\n")
    (out / "half").write_text("made", encoding="utf-8")
    time.sleep(params.seconds)
    while params.gate is not None and not params.gate.exists():
        time.sleep(0.1)
    return toy(inputs, params, out, report)


def planned(folder: Path, tiles: int, gate: Path | None = None) -> list[Planned]:
    """What would run in `folder`: three steps, one after the other, of every tile."""
    nodes = []
    for tile in range(tiles):
        before: Path | Output = folder / "source.txt"
        for name in STEPS:
            params = SlowParams(log=folder / "log", name=f"{tile}-{name}", value=1, gate=gate)
            nodes.append(Node(Step(name, 1, slow, SlowParams), params, {"before": before}, tile=str(tile)))
            before = Output(nodes[-1].id, "number")
    return plan(nodes, Store(folder / "steps"))
