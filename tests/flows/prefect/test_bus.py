"""A flow and its workers publish the progress of a run on the event bus."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from scan2sim.services.monitoring.dashboard.state import BusState
from scan2sim.services.monitoring.events.schema import Event
from tests.fakes.broker import Broker
from tests.flows.bus_events import read_events
from tests.flows.prefect.conftest import Server, on
from tests.flows.prefect.test_kills import SCRIPT, TILES
from tests.flows.prefect.toy_steps import STEPS


@on("sqlite")
@pytest.mark.parametrize("runner", ["dask", pytest.param("threads", marks=pytest.mark.slow)])
def test_flow_and_workers_publish_the_same_run(
    runner: str, server: Server, folder: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(folder / "state"))
    (folder / "gate").touch()
    arguments = ("-c", SCRIPT, str(folder), runner, str(folder / "gate"), broker.servers)
    process = server.spawn(*arguments, log=folder / "output", XDG_STATE_HOME=str(folder / "state"))
    assert process.wait() == 0, (folder / "output").read_text(encoding="utf-8")

    def hosts(events: list[Event]) -> set[tuple[str, str]]:
        done = [event.body for event in events if event.kind == "step" and event.body["state"] == "done"]
        return {(body["tile"], body["step"]) for body in done if body["host"]}

    def complete(events: list[Event]) -> bool:
        ended = any(event.kind == "run" and event.body["state"] != "running" for event in events)
        return ended and len(hosts(events)) == TILES * len(STEPS)

    bus_state = BusState(time.time())
    for event in (events := read_events(broker, complete)):
        bus_state.add(event.model_dump_json().encode())
    (run,) = bus_state.state(time.time())["runs"]
    last = run["details"]["last"]
    assert (last["command"], last["source"], last["state"]) == ("survey", str(folder), "done")
    assert last["done"] == last["steps"] == len(hosts(events)) == TILES * len(STEPS)
    assert all(step["state"] == "done" and step["seconds"] and step["memory"] for step in run["details"]["steps"])
    assert not bus_state.rejections.counts
