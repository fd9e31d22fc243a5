"""End-to-end test of real nodes: camera events, queue, autoscaler, workers and alarms."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from scan2sim.services.monitoring.example_nodes import worker
from tests.fakes.nodes import end_well, json_lines, wait_for_line
from tests.services.conftest import Start
from tests.waiting import until

CLI = ("cyclone", "-m", "scan2sim.flows.cli", "monitor")


RULES = """
[[rules]]
name = 'queue'
metric = 'queue_length'
above = 5

[[rules]]
name = 'any state'
metric = 'queue_length'
above = -1
"""


@pytest.mark.realtime
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
    (tmp_path / "rules.toml").write_text(RULES, encoding="utf-8")
    days = tmp_path / "days.csv"  # one day with an event every ten seconds
    days.write_text("".join(f"{seconds},1000\n" for seconds in range(0, 86_400, 10)), encoding="utf-8")
    options = [days if one == days.name else one for one in forecast]
    serve = shlex.join(worker.command(0.05))
    alarms = start(*CLI, "alarms", tmp_path / "rules.toml")
    scale = start(*CLI, "scale", "--capacity", "20", "--window", "1", "--cool-down", "5", "--max-workers", "3",
                  *options,
                  "--log", tmp_path / "scale.log")  # fmt: skip
    work = start(*CLI, "work", "/cars", serve, "--period", "0.25")
    log = tmp_path / "scale.log"
    wait_for_line(alarms, "raised any state: /cars, 0")
    until(lambda: json_lines(log))  # both receive the states of the queue
    talker = start(*CLI, "dataset-talker", "/cars", tmp_path / "data.csv", "--subscribers", "1", "--size-as-field")
    wait_for_line(alarms, r"raised queue: /cars, \d+")

    def sums() -> tuple[int, int]:
        return sum(one["arrived"] for one in json_lines(log)), sum(one["done"] for one in json_lines(log))

    def highest() -> tuple[int, int]:
        return max(one["wanted"] for one in json_lines(log)), max(one["workers"] for one in json_lines(log))

    def are_processed() -> bool:
        (wanted, running), (arrived, done) = highest(), sums()
        return wanted == running and arrived == done >= len(times)

    until(are_processed, state=lambda: (highest(), sums()))
    for node in (alarms, scale, work):
        node.terminate()
    end_well(talker, alarms, scale, work)
    assert sums() == (len(times), len(times)) and highest()[0] == highest()[1] >= workers
