"""End-to-end test of real nodes: camera events, queue, autoscaler, workers and alarms."""

from __future__ import annotations

import json
import shlex
import time
from pathlib import Path

import pytest

from scan2sim.services.monitoring.example_nodes import worker
from tests.services.conftest import Start

CLI = ("cyclone", "-m", "scan2sim.flows.cli", "monitor")


@pytest.mark.parametrize(
    ("forecast", "workers"),  # the history has quiet days only, so its profile predicts a lower rate
    [
        ((), 3),
        pytest.param(("--forecast", "trend", "--lead", "0.5"), 3, marks=pytest.mark.slow),
        (("--history", "days.csv"), 2),
    ],
)
def test_burst_of_events_is_scaled_up_without_losses(
    forecast: tuple[str, ...], workers: int, tmp_path: Path, start: Start
) -> None:
    # a quiet second, three seconds at 50 events per second, then quiet: one worker processes 20 per second
    times = [0.1, *(1 + number / 50 for number in range(150)), 6.0]
    (tmp_path / "data.csv").write_text("".join(f"{seconds},100000\n" for seconds in times), encoding="utf-8")
    (tmp_path / "rules.toml").write_text(
        "[[rules]]\nname = 'queue'\nmetric = 'queue_length'\nabove = 5\n", encoding="utf-8"
    )
    days = tmp_path / "days.csv"  # one day with an event every ten seconds
    days.write_text("".join(f"{seconds},1000\n" for seconds in range(0, 86_400, 10)), encoding="utf-8")
    options = [days if one == days.name else one for one in forecast]
    serve = shlex.join(worker.command(0.05))
    alarms = start(*CLI, "alarms", tmp_path / "rules.toml")
    scale = start(*CLI, "scale", "--capacity", "20", "--window", "1", "--cool-down", "1", "--max-workers", "3",
                  *options,
                  "--log", tmp_path / "scale.log")  # fmt: skip
    work = start(*CLI, "work", "/cars", serve, "--period", "0.25")
    talker = start(*CLI, "dataset-talker", "/cars", tmp_path / "data.csv", "--subscribers", "1", "--size-as-field")
    assert talker.wait(90) == 0
    end = time.monotonic() + 30
    states: list[dict[str, float]] = []
    while sum(one["done"] for one in states) < len(times) and time.monotonic() < end:
        time.sleep(0.5)
        states = [json.loads(line) for line in (tmp_path / "scale.log").read_text(encoding="utf-8").splitlines()]
    assert sum(one["done"] for one in states) == sum(one["arrived"] for one in states) == len(times)
    assert max(one["wanted"] for one in states) == max(one["workers"] for one in states) >= workers
    alarms.terminate()
    assert "raised queue: /cars" in "".join(alarms.communicate(timeout=30))
    for node in (scale, work):
        node.terminate()
        node.communicate(timeout=30)
