"""A custom step: one file, and one line in a pipeline definition."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.planning import Reason, plan
from scan2sim.flows.pipelines.graph import Output, Task, TaskId, required_tasks
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import STEPS, build_graph
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.io.tile import read_tile

FILE = '''
"""Lift: moves the cloud up."""

from dataclasses import replace

from pydantic import Field

from scan2sim.pipeline.core.step import Done, Params, Step
from scan2sim.pipeline.core.types import PointCloud


class LiftParams(Params):
    metres: float = Field(1.0, ge=0, le=100)


def lift(inputs, params, out, report):
    cloud = PointCloud.load(inputs["cloud"])
    replace(cloud, xyz=cloud.xyz + (0, 0, params.metres)).save(out / "cloud.npz")
    return Done({"cloud": out / "cloud.npz"}, {"highest": float(cloud.xyz[:, 2].max()) + params.metres})


LIFT = Step("lift", 1, lift, LiftParams)
'''


def test_custom_step_needs_one_file_and_one_line(
    small_street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lifting.py").write_text(FILE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    step = importlib.import_module("lifting").LIFT
    tile, store = read_tile(small_street), Store(tmp_path / "steps")

    def run(*assignments: str) -> tuple[float, dict[str, Reason | None]]:
        settings = Settings.read(None, assignments)
        settings.check((*STEPS, step))
        line = Task(step, settings.params(step), {"cloud": Output(TaskId("ingest"), "cloud")})
        planned = plan(required_tasks([*build_graph(tile, Settings()), line], [line.id]), store)
        outcome = execute(planned, store, jobs=1, on_event=lambda *_: None)
        outcome.check()
        return outcome.of_tile()["lift"].metrics["highest"], {item.task.full_name: item.reason for item in planned}

    low, why = run()
    assert why == {"ingest": Reason.NEW, "lift": Reason.NEW}
    high, why = run("lift.metres=3")
    assert high == pytest.approx(low + 2, abs=1e-3) and why == {"ingest": None, "lift": Reason.CHANGED}
