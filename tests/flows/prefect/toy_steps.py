"""A toy survey: tiles of three slow steps. Doesn't import Prefect, which every task process would import, too."""

from __future__ import annotations

import multiprocessing
import os
import time
from pathlib import Path

from scan2sim.flows.engine.planning import PlannedTask, plan
from scan2sim.flows.pipelines.graph import Output, Task
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from tests.flows.fork_server import load_only
from tests.flows.toy import ToyParams, toy

STEPS = ("first", "second", "third")
TOYS = "SCAN2SIM_TEST_TOYS"
"""Environment variable of processes that run toy steps only; their fork servers load nothing else."""

if TOYS in os.environ:
    load_only(__name__)


class SlowParams(ToyParams):
    """A toy step that takes `seconds` and then waits until the file `gate` exists before it logs its run."""

    seconds: float = 0.05
    gate: Path | None = None


def slow(inputs: Inputs, params: SlowParams, out: Path, report: Report) -> Done:
    """Like `toy`, but slower; logs its process id and that of its worker to the file `started`."""
    parent = multiprocessing.parent_process()
    with open(params.log.with_name("started"), "a", encoding="utf-8") as file:
        file.write(f"{params.name} {os.getpid()} {parent.pid if parent else 0}\n")
    (out / "half").write_text("made", encoding="utf-8")
    time.sleep(params.seconds)
    while params.gate is not None and not params.gate.exists():
        time.sleep(0.1)
    return toy(inputs, params, out, report)


def planned(folder: Path, tiles: int, gate: Path | None = None) -> list[PlannedTask]:
    """The plan in `folder`: a chain of three steps for each tile, of which the last waits for the file `gate`."""
    tasks = []
    for tile in range(tiles):
        before: Path | Output = folder / "source.txt"
        for name in STEPS:
            params = SlowParams(
                log=folder / "log", name=f"{tile}-{name}", value=1, gate=gate if name == STEPS[-1] else None
            )
            tasks.append(Task(Step(name, 1, slow, SlowParams), params, {"before": before}, tile=str(tile)))
            before = Output(tasks[-1].id, "number")
    return plan(tasks, Store(folder / "steps"))
