"""A toy pipeline for tests of planning and execution; steps log their runs to a file."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any, Literal

from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.pipeline.core.errors import DataError, ScanError, StepError
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step


class ToyParams(Params):
    """What the toy step does: work, fail, crash, hang, or die with open locks and output; `log` lists its runs.

    With "part", an optional part of its result fails as long as there is a file `broken` beside the log.
    """

    log: Path
    name: str
    does: Literal["work", "fail", "bug", "die", "hang", "litter", "part"] = "work"
    value: int = 0


def toy(inputs: Inputs, params: ToyParams, out: Path, report: Report) -> Done:
    """Write the sum of all inputs and the value."""
    with open(params.log, "a", encoding="utf-8") as file:
        file.write(params.name + "\n")
    params.log.with_name(f"pid_{params.name}").write_text(str(os.getpid()), encoding="utf-8")
    total = params.value + sum(int(path.read_text(encoding="utf-8")) for path in inputs.values())
    (out / "number.txt").write_text(str(total), encoding="utf-8")
    if params.does == "fail":
        raise DataError("toy", "is configured to fail", "Change its settings")
    if params.does == "bug":
        raise ZeroDivisionError("a bug")
    if params.does == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if params.does == "litter":
        locks = [multiprocessing.get_context("forkserver").Lock() for _ in range(3)]
        print(f"{len(locks)} locks are never released", file=sys.stderr, flush=True)
        os.write(2, b"a library says this\n")
        os.kill(os.getpid(), signal.SIGKILL)
    while params.does == "hang":
        time.sleep(60)
    report(1.0, "done")
    part_fails = params.does == "part" and params.log.with_name("broken").exists()
    failed: dict[str, ScanError] = {"part": StepError("part", "fails", "Delete `broken`")} if part_fails else {}
    return Done({"number": out / "number.txt"}, {"total": total}, failed=failed)


TOY = Step("toy", 1, toy, ToyParams)


def chain(source: Path, log: Path, **changes: dict[str, Any]) -> list[Task]:
    """Graph source -> a -> b -> d, a -> c -> d; `changes` are parameters by task name."""

    def task(name: str, inputs: dict[str, Path | Output]) -> Task:
        return Task(Step(name, 1, toy, ToyParams), ToyParams(log=log, name=name, **changes.get(name, {})), inputs)

    return [
        task("a", {"source": source}),
        task("b", {"a": Output(TaskId("a"), "number")}),
        task("c", {"a": Output(TaskId("a"), "number")}),
        task("d", {"b": Output(TaskId("b"), "number"), "c": Output(TaskId("c"), "number")}),
    ]
