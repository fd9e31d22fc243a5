"""A flow and its workers publish the progress of a run on the event bus."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from scan2sim.services import kafka
from scan2sim.services.monitoring.dashboard.state import BusState
from scan2sim.services.monitoring.events.schema import Event
from tests.fakes.broker import Broker
from tests.flows.prefect.conftest import Server, on
from tests.flows.prefect.test_kills import SCRIPT, TILES
from tests.flows.prefect.toy_steps import STEPS


@on("sqlite")
@pytest.mark.parametrize("runner", ["dask", pytest.param("threads", marks=pytest.mark.slow)])
def test_flow_and_workers_publish_the_same_run(runner: str, server: Server, folder: Path, broker: Broker) -> None:
    arguments = ("-c", SCRIPT, str(folder), runner, broker.servers)
    process = server.spawn(*arguments, log=folder / "output", XDG_STATE_HOME=str(folder / "state"))
    bus_state, hosts = BusState(time.time()), set[tuple[str, str]]()
    end = time.monotonic() + 150
    for body in kafka.read(broker.cluster, "bus_events", group="test", from_start=True, wait=0.5):
        if body is not None:
            bus_state.add(body)
            event = Event.model_validate_json(body)
            if event.kind == "step" and event.body["state"] == "done" and event.body["host"]:
                hosts.add((event.body["tile"], event.body["step"]))
        runs = bus_state.state(time.time())["runs"]
        ended = runs and runs[0]["details"]["last"] and runs[0]["details"]["last"]["state"] != "running"
        if (ended and len(hosts) == TILES * len(STEPS)) or time.monotonic() > end:
            break
    assert process.wait(60) == 0, (folder / "output").read_text(encoding="utf-8")
    (run,) = runs
    last = run["details"]["last"]
    assert (last["command"], last["source"], last["state"]) == ("survey", str(folder), "done")
    assert last["done"] == last["steps"] == len(hosts) == TILES * len(STEPS)
    assert all(step["state"] == "done" and step["seconds"] and step["memory"] for step in run["details"]["steps"])
    assert not bus_state.counts
