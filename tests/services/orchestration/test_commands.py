"""Single commands against a newer OSM, which returns parameters of operations as JSON strings, and Release 8."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from typer.testing import CliRunner

from scan2sim.flows.commands.orchestrate import app
from scan2sim.pipeline.core.errors import StepError
from scan2sim.services.orchestration import description, operations
from scan2sim.services.orchestration.lifecycle import WaitPolicy
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.package import build
from scan2sim.services.orchestration.settings import Connection
from scan2sim.services.qos.requirements import Environment
from tests.fakes.osm import FakeOsm, OsmState

Command = Callable[..., str]


@pytest.fixture(params=[True, False], ids=["current OSM", "OSM 8"])
def fake(request: pytest.FixtureRequest) -> Iterator[FakeOsm]:
    with FakeOsm(OsmState(seconds=0.02, as_json=request.param)) as made:
        yield made


@pytest.fixture
def detect(osm: Osm) -> str:
    """Id of the network service of an onboarded detector."""
    made = build(description.read("detect"), Environment.EDGE, "container")
    operations.onboard(osm, [made.function, made.service])
    return made.service.descriptor.id


@pytest.fixture
def command(fake: FakeOsm) -> Command:
    """Runs `scan2sim orchestrate` and returns its output."""

    def run(*words: object) -> str:
        done = CliRunner().invoke(app, [*map(str, words), "--osm", fake.address], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return done.output

    return run


@pytest.fixture
def start(command: Command, detect: str) -> Callable[[], str]:
    """Instantiates the detector as `one`, with two replicas and a value."""
    words = ("instantiate", "one", detect, "--cluster", "edge-cluster", "--replicas", 2, "--value", "level=info")
    return lambda: command(*words, "--wait")


def sent(fake: FakeOsm) -> list[tuple[str, Any]]:
    """Kind and chart values of each operation, as sent."""
    found = []
    for one in fake.state.operations.values():
        params = one["operationParams"]
        charts = [chart for vnf in params.get("additionalParamsForVnf", ()) for chart in vnf["additionalParamsForKdu"]]
        upgrade = {k: v for k, v in params.get("primitive_params", {}).items() if k != "kdu_reset_values"}
        found.append((one["lcmOperationType"], upgrade or charts[0]["additionalParams"]))
    return found


VALUES = {"level": "info", "replicaCount": 2}


def test_instantiate_waits_until_the_instance_runs(fake: FakeOsm, start: Callable[[], str]) -> None:
    assert "one runs" in start()
    assert sent(fake) == [("instantiate", VALUES)]


def test_repeated_instantiate_changes_nothing(fake: FakeOsm, start: Callable[[], str]) -> None:
    start()
    assert "one runs" in start()
    assert sent(fake) == [("instantiate", VALUES)]


def test_repeated_instantiate_with_other_values_upgrades_the_chart(
    fake: FakeOsm, start: Callable[[], str], command: Command, detect: str
) -> None:
    start()
    command("instantiate", "one", detect, "--cluster", "edge-cluster", "--value", "level=debug", "--wait")
    assert sent(fake)[1:] == [("action", {"level": "debug", "replicaCount": 1})]


def test_scale_keeps_the_other_values(fake: FakeOsm, start: Callable[[], str], command: Command) -> None:
    start()
    for count in (5, 5, 3):
        command("scale", "one", count, "--wait")
    assert sent(fake)[1:] == [("action", VALUES | {"replicaCount": 5}), ("action", VALUES | {"replicaCount": 3})]


def test_heal_applies_the_last_values_again(fake: FakeOsm, start: Callable[[], str], command: Command) -> None:
    start()
    command("heal", "one", "--wait")
    command("scale", "one", 4, "--wait")
    command("heal", "one", "--wait")
    assert [values["replicaCount"] for _, values in sent(fake)] == [2, 2, 4, 4]


@pytest.mark.parametrize("returned", ["{", "no JSON", "[1]", "[{}, 2]", '"text"', "3", 3, [3], {"replicaCount": 1}])
def test_unreadable_parameters_are_an_error_and_the_instance_can_be_deleted(
    fake: FakeOsm, start: Callable[[], str], command: Command, monkeypatch: pytest.MonkeyPatch, returned: object
) -> None:
    start()
    operation = next(iter(fake.state.operations.values()))
    broken = operation | {"operationParams": {"additionalParamsForVnf": returned, "secret": "hush"}}
    with monkeypatch.context() as patched, Osm(Connection(osm=fake.address)) as osm:
        patched.setattr(fake.state, "returned_operations", lambda: {operation["_id"]: broken})
        for act in (operations.heal, lambda *given: operations.scale(given[0], given[1], 3, *given[2:])):
            with pytest.raises(StepError, match=r"one: .*additionalParamsForVnf.* can't be read") as caught:
                act(osm, "one", WaitPolicy(60), lambda _: None)
            assert "scan2sim orchestrate delete" in caught.value.remedy and "hush" not in str(caught.value)
    command("delete", "one")
    assert not fake.state.instances


def test_the_fake_returns_parameters_like_each_release(fake: FakeOsm, start: Callable[[], str]) -> None:
    start()
    with Osm(Connection(osm=fake.address)) as osm:
        (operation,) = osm.operations(osm.instances()[0].record)
    assert operation.params
    returned: Any = operation.params.functions
    (function,) = json.loads(returned) if fake.state.as_json else returned
    assert function["additionalParamsForKdu"] == [{"kdu_name": "detect", "additionalParams": VALUES}]


def test_lists_are_printed_as_json(fake: FakeOsm, start: Callable[[], str], command: Command, detect: str) -> None:
    start()
    found = json.loads(command("list", "--json"))
    assert {one["kind"] for one in found["packages"]} == {"function", "network service"}
    (one,) = found["instances"]
    assert (one["name"], one["network service"], one["state"]) == ("one", detect, "ready")
    (vim,) = json.loads(command("vim", "list", "--json"))
    assert (vim["name"], vim["kind"], vim["state"]) == ("edge-site", "openstack", "enabled") and vim[
        "id"
    ] in fake.state.vims
    assert json.loads(command("cluster", "list", "--json"))[0]["name"] == "edge-cluster"
    for words in (("repo", "list"), ("slice", "list"), ("slice", "templates")):
        assert json.loads(command(*words, "--json")) == []
