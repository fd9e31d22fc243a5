"""The cost of a plan: what runs for certain, what only if inputs really change, and times of earlier runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from scan2sim.flows.engine.estimate import duration, estimates, summary
from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.planning import plan
from scan2sim.flows.pipelines.graph import Task
from scan2sim.pipeline.core.cache import Store
from tests.flows.toy import chain


def tasks(source: Path, log: Path, tile: str = "") -> list[Task]:
    return [replace(task, tile=tile) for task in chain(source, log)] if tile else chain(source, log)


def test_changed_source_costs_its_reader_for_certain_and_the_others_perhaps(tmp_path: Path) -> None:
    source, log, store = tmp_path / "source.txt", tmp_path / "log", Store(tmp_path / "store")
    source.write_text("1", encoding="utf-8")
    first = estimates(plan(tasks(source, log), store), store)
    assert all(row.certain and row.seconds is None for row in first)
    assert "time unknown" in summary(first)
    execute(plan(tasks(source, log), store), store, jobs=1, on_event=lambda *_: None).check()
    assert summary(estimates(plan(tasks(source, log), store), store)) == "nothing to do"
    source.write_text("2", encoding="utf-8")
    rows = estimates(plan(tasks(source, log), store), store)
    took = {}
    for path in (tmp_path / "store").glob("*/*/manifest.json"):
        body = json.loads(path.read_text(encoding="utf-8"))
        took[body["label"]] = body["seconds"]
    readers = {row.item.task.full_name for row in rows if source in row.item.task.inputs.values()}
    assert {row.item.task.full_name for row in rows if row.certain} == readers
    assert all(row.seconds == took[row.item.task.full_name] for row in rows if row.runs)
    assert "if their inputs really change" in summary(rows)


@pytest.mark.parametrize(
    "seconds, text", [(None, "?"), (0.43, "0.4 s"), (12.4, "12 s"), (300.0, "5 min"), (9000.0, "2.5 h")]
)
def test_duration_is_readable(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text
