"""Reconciliation of OSM with `services.toml`, with all kinds of failures, leaves nothing behind."""

from __future__ import annotations

import itertools
import logging
import math
import random
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

from scan2sim.pipeline.core.errors import InputError, ScanError, SettingError, StepError, UnavailableError
from scan2sim.services.orchestration import apply, deployment, operations
from scan2sim.services.orchestration import osm as osm_client
from scan2sim.services.orchestration.apply import ApplyResult, Change
from scan2sim.services.orchestration.instance import Action, DesiredInstance, Instance, next_action
from scan2sim.services.orchestration.lifecycle import WaitPolicy
from scan2sim.services.orchestration.osm import HTTP_ERRORS, Osm, OsmError
from scan2sim.services.orchestration.package import Packages, build
from scan2sim.services.orchestration.records import OperationRecord
from scan2sim.services.orchestration.settings import ApplyParams, Connection
from scan2sim.services.qos.requirements import Environment
from tests.fakes import odd_answers
from tests.fakes.osm import CUT_AFTER, CUT_BEFORE, FakeOsm, OsmState
from tests.services.orchestration.conftest import TOWN

QUIET: Callable[[str], None] = lambda text: None  # noqa: E731


def apply_file(fake: FakeOsm, path: Path, *, timeout: float = 60.0, wait: bool = True) -> ApplyResult:
    params = ApplyParams(osm=fake.address, wait=wait, timeout=timeout)
    with Osm(params) as osm:
        state = apply.load_state(osm, deployment.read(path), path.parent)
        return apply.apply(osm, state, params, lambda fraction, message="": None)


def plan_changes(fake: FakeOsm, path: Path) -> list[Change]:
    with Osm(Connection(osm=fake.address)) as osm:
        return apply.plan(apply.load_state(osm, deployment.read(path), path.parent))


def states(fake: FakeOsm) -> dict[str, str]:
    return {one["name"]: one["nsState"] for one in fake.state.instances.values()}


DESIRED = DesiredInstance("a", "town", "detect", "container", "nsd", "vim")


def operation(kind: str = "action", state: str = "COMPLETED", **params: Any) -> OperationRecord:
    """Record of an operation with its parameters."""
    return OperationRecord.model_validate(
        {"_id": "1", "lcmOperationType": kind, "operationState": state, "operationParams": params}
    )


def observed(
    state: str = "READY", instantiated: bool = True, tag: str = DESIRED.tag, *operations: OperationRecord
) -> Instance:
    started = operation("instantiate", **DESIRED.request("record"))
    return Instance("1", "a", "nsd", tag, state, instantiated, (started, *operations))


@pytest.mark.parametrize(
    ("desired", "found", "action"),
    [
        (None, None, None),
        (DESIRED, None, Action.CREATE),
        (DESIRED, observed(), None),
        (DESIRED, observed("NOT_INSTANTIATED", False), Action.INSTANTIATE),
        (DESIRED, observed("BUILDING", False, DESIRED.tag, operation(state="PROCESSING")), Action.WAIT),
        (None, observed("BUILDING", False, DESIRED.tag, operation(state="PROCESSING")), Action.WAIT),
        (DESIRED, observed("BROKEN"), Action.TERMINATE),
        (None, observed(), Action.TERMINATE),
        (None, observed("NOT_INSTANTIATED", False), Action.DELETE),
        (DESIRED, observed(tag="scan2sim town 000000000000"), Action.TERMINATE),
        (DesiredInstance("a", "town", "detect", "container", "nsd", "vim", replicas=3), observed(), Action.UPGRADE),
    ],
)
def test_next_action_depends_on_desired_and_observed_state(
    desired: DesiredInstance | None, found: Instance | None, action: Action | None
) -> None:
    assert next_action(desired, found) == action


def test_apply_creates_updates_and_removes_instances(fake: FakeOsm, town: Path) -> None:
    assert {one.action for one in plan_changes(fake, town)} == {"onboard", "create"}
    assert not apply_file(fake, town).failed
    assert states(fake) == {"detect-north": "READY", "segment-south": "READY"} and fake.state.orphans() == []
    assert plan_changes(fake, town) == []
    before = len([1 for _, method, path in fake.state.requests if method != "GET" and "tokens" not in path])
    assert apply_file(fake, town) == ApplyResult()
    assert before == len([1 for _, method, path in fake.state.requests if method != "GET" and "tokens" not in path])

    town.write_text(TOWN.replace("replicas = 2", "replicas = 3").replace('"detect"', '"classify"'), encoding="utf-8")
    changes = {(one.name, one.action) for one in plan_changes(fake, town)}
    assert ("detect-north", "recreate") in changes and ("segment-south", "scale out") in changes
    assert not apply_file(fake, town).failed and plan_changes(fake, town) == []
    assert len(fake.state.functions) == 2  # the detector's package was removed

    town.write_text('deployment = "town"', encoding="utf-8")
    assert not apply_file(fake, town).failed
    assert (fake.state.instances, fake.state.services, fake.state.functions) == ({}, {}, {})
    assert not fake.state.resources


def test_instances_of_other_owners_are_not_touched(fake: FakeOsm, osm: Osm, town: Path) -> None:
    made = build_detector("mine")
    operations.onboard(osm, [made.function, made.service])
    policy, nsd = WaitPolicy(60), made.service.descriptor.id
    operations.instantiate(osm, "by-hand", nsd, osm.vim("edge-site"), wait_policy=policy, notify=QUIET)
    apply_file(fake, town)
    town.write_text('deployment = "town"', encoding="utf-8")
    apply_file(fake, town)
    assert states(fake) == {"by-hand": "READY"} and len(fake.state.functions) == 1
    town.write_text(TOWN.replace("detect-north", "by-hand"), encoding="utf-8")
    result = apply_file(fake, town)
    assert "instance of another deployment" in result.failed["by-hand"].cause
    assert states(fake)["segment-south"] == "READY"


def build_detector(prefix: str) -> Packages:
    from scan2sim.services.orchestration import description

    return build(description.read("detect"), Environment.EDGE, "container", prefix)


def test_a_failed_instantiation_is_reported_and_removed(fake: FakeOsm, town: Path) -> None:
    fake.state.outcome = lambda kind, name: "FAILED" if (kind, name) == ("instantiate", "detect-north") else "COMPLETED"
    result = apply_file(fake, town)
    error = result.failed["detect-north"]
    assert "FAILED: no quota" in error.cause and "run again" in error.remedy
    assert states(fake) == {"segment-south": "READY"} and fake.state.orphans() == []
    fake.state.outcome = lambda kind, name: "COMPLETED"
    assert not apply_file(fake, town).failed and len(states(fake)) == 2


def test_the_next_run_waits_for_an_operation_that_timed_out(fake: FakeOsm, town: Path) -> None:
    fake.state.outcome = lambda kind, name: "never" if name == "detect-north" else "COMPLETED"
    result = apply_file(fake, town, timeout=1.0)
    assert "still running after 1 s" in result.failed["detect-north"].cause
    assert any((one.name, one.action) == ("detect-north", "wait") for one in plan_changes(fake, town))
    fake.state.outcome = lambda kind, name: "COMPLETED"
    assert not apply_file(fake, town).failed
    assert states(fake)["detect-north"] == "READY" and len(fake.state.instances) == 2


def test_apply_without_wait_only_starts_operations(fake: FakeOsm, town: Path) -> None:
    fake.state.seconds = 3600
    assert not apply_file(fake, town, wait=False).failed
    assert set(states(fake).values()) == {"BUILDING"}


@pytest.mark.parametrize("status", sorted(HTTP_ERRORS))
def test_every_error_status_has_a_message_and_the_next_run_recovers(fake: FakeOsm, town: Path, status: int) -> None:
    """With each kind of request failing in turn, until the run ends."""
    for failing in ("vnf_packages", "ns_descriptors", "ns_instances", "instantiate"):
        fake.state.faults = lambda method, path, part=failing: status if method != "GET" and part in path else None  # type: ignore[misc]
        try:
            result = apply_file(fake, town)
            errors: list[ScanError] = list(result.failed.values())
        except ScanError as error:
            errors = [error]
        assert errors and all(str(status) in str(e) and e.remedy for e in errors), failing
        fake.state.faults = lambda method, path: None
    assert not apply_file(fake, town).failed
    assert set(states(fake).values()) == {"READY"} and fake.state.orphans() == [] and len(fake.state.instances) == 2


@pytest.mark.parametrize("fault", [CUT_BEFORE, CUT_AFTER, 504])
def test_a_connection_cut_at_any_request_has_no_effect(town: Path, fault: str | int) -> None:
    """The response of each request in turn is lost: the result is the same, with no duplicates."""
    for cut in range(100):
        count = itertools.count()
        with FakeOsm(OsmState(seconds=0.01, faults=lambda method, path: fault if next(count) == cut else None)) as fake:  # noqa: B023
            result = apply_file(fake, town)
            assert not result.failed, (cut, result.failed)
            assert len(fake.state.instances) == 2 and set(states(fake).values()) == {"READY"}, cut
            assert fake.state.orphans() == [] and len(fake.state.functions) == len(fake.state.services) == 2, cut
        if next(count) <= cut:
            return
    pytest.fail("more than 100 requests")


def test_a_revoked_token_is_renewed(fake: FakeOsm, town: Path) -> None:
    count = itertools.count()

    def revoke(method: str, path: str) -> None:
        if next(count) % 7 == 0:
            fake.state.tokens.clear()

    fake.state.faults = revoke
    assert not apply_file(fake, town).failed
    assert sum(path.endswith("tokens") for _, _, path in fake.state.requests) > 3


def test_an_interrupted_run_can_be_completed(town: Path) -> None:
    """Like Ctrl-C: no further action is started, and running operations continue."""
    rng = random.Random(0)
    with FakeOsm(OsmState(seconds=0.02)) as fake:
        apply_file(fake, town)
        whole = fake.state.summary()
    for _ in range(8):
        with FakeOsm(OsmState(seconds=0.05)) as fake:
            stop = threading.Event()
            params = ApplyParams(osm=fake.address, wait=True)
            threading.Timer(rng.uniform(0, 0.4), stop.set).start()
            with Osm(params) as osm:
                state = apply.load_state(osm, deployment.read(town), town.parent)
                apply.apply(osm, state, params, lambda fraction, message="": None, stop)
            apply_file(fake, town)
            assert fake.state.summary() == whole and fake.state.orphans() == []


def test_scale_heal_terminate_and_delete(fake: FakeOsm, osm: Osm) -> None:
    wait_policy, made = WaitPolicy(60), build_detector("mine")
    nsd = made.service.descriptor.id
    with pytest.raises(InputError, match="neither given nor in OSM"):
        operations.onboard(osm, [made.service])
    with pytest.raises(InputError, match="two packages"):
        operations.onboard(osm, [made.function, made.function])
    operations.onboard(osm, [made.service, made.function])
    site = osm.cluster("edge-cluster")
    operations.instantiate(osm, "one", nsd, site, replicas=2, wait_policy=wait_policy, notify=QUIET)
    operations.scale(osm, "one", 5, wait_policy, QUIET)
    kinds = [one["lcmOperationType"] for one in fake.state.operations.values()]
    operations.scale(osm, "one", 5, wait_policy, QUIET)  # no change
    assert kinds == ["instantiate", "action"] and len(fake.state.operations) == 2
    operations.heal(osm, "one", wait_policy, QUIET)
    operations.terminate(osm, "one", wait_policy, QUIET)
    with pytest.raises(SettingError, match="not running"):
        operations.scale(osm, "one", 1, wait_policy, QUIET)
    operations.delete(osm, [made.function, made.service], wait_policy, QUIET)
    assert not fake.state.instances and not fake.state.functions and not fake.state.services
    with pytest.raises(SettingError, match="no such"):
        operations.delete_packages(osm, ["gone"])


def test_an_instance_is_deleted_only_after_its_operation_has_ended(fake: FakeOsm, osm: Osm) -> None:
    """Otherwise OSM would forget the operation, and its resources would become orphans."""
    made = build_detector("mine")
    operations.onboard(osm, [made.service, made.function])
    nsd = made.service.descriptor.id
    fake.state.seconds = 0.5
    operations.instantiate(osm, "one", nsd, osm.vim("edge-site"), wait_policy=WaitPolicy(wait=False), notify=QUIET)
    operations.delete_instance(osm, "one", WaitPolicy(60), QUIET)
    assert not fake.state.resources and fake.state.orphans() == []


def test_unknown_sites_keys_and_names_are_rejected_before_anything_is_sent(fake: FakeOsm, town: Path) -> None:
    for old, new, expected in (
        ('"edge-cluster"', '"moon"', "Available: edge-cluster"),
        ('"segment-south"', '"detect-north"', "duplicate service name"),
        ('vim = "edge-site"', 'vim = "edge-site"\nssh_keys = ["gone.pub"]', "gone.pub"),
        ('service = "detect"', 'service = "../detect"', "one of: classify"),
        ('name = "detect-north"', 'name = "Nord Süd"', "name"),
        ('cluster = "edge-cluster"', "", "give `vim` or `cluster`"),
    ):
        town.write_text(TOWN.replace(old, new), encoding="utf-8")
        with pytest.raises(ScanError, match=expected.replace(".", r"\.")):
            apply_file(fake, town)
    assert not fake.state.functions and not fake.state.instances
    (town.parent / "id").write_text("-----BEGIN OPENSSH PRIVATE KEY-----", encoding="utf-8")
    town.write_text(TOWN.replace('vim = "edge-site"', 'vim = "edge-site"\nssh_keys = ["id"]'), encoding="utf-8")
    with pytest.raises(InputError, match="private key"):
        apply_file(fake, town)


def test_secrets_are_not_logged(
    fake: FakeOsm, town: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.DEBUG)
    apply_file(fake, town)
    monkeypatch.setenv("OSM_PASSWORD", "hush-hush-123")
    with pytest.raises(StepError) as caught:
        apply_file(fake, town)
    token = next(iter(fake.state.tokens))
    assert "hush-hush-123" not in caplog.text + str(caught.value) and token not in caplog.text


def test_addresses_without_tls_are_rejected() -> None:
    for address in (
        "http://osm.example.org",
        "http://user:hunter2@osm.example.org",
        "https://user:hunter2@osm.example.org",
        "https://:hunter2@osm.example.org",
        "ftp://x",
        "https://x/other",
    ):
        with pytest.raises(SettingError) as caught:
            Connection(osm=address).northbound_url()
        assert "hunter2" not in str(caught.value)
    assert Connection(osm="osm.example.org").northbound_url() == "https://osm.example.org:9999"
    with Osm(Connection(osm="http://127.0.0.1:9")) as osm, pytest.raises(UnavailableError, match="can't connect"):
        osm.instances()


def test_values_that_are_removed_from_the_file_leave_the_cluster(fake: FakeOsm, town: Path) -> None:
    """OSM merges values unless a request resets them; the plan compares with what runs."""
    gpu = 'values = { variables = { LEVEL = "debug", EXTRA = "1" }, resources = { limits = { "nvidia.com/gpu" = 1 } } }'
    values = {"variables": {"LEVEL": "debug", "EXTRA": "1"}, "resources": {"limits": {"nvidia.com/gpu": 1}}}
    town.write_text(TOWN.replace('cluster = "edge-cluster"', f'cluster = "edge-cluster"\n{gpu}'), encoding="utf-8")
    assert not apply_file(fake, town).failed
    (key,) = (one["_id"] for one in fake.state.instances.values() if one["name"] == "detect-north")
    assert fake.state.releases[key] == values | {"replicaCount": 2}
    merging = {"member_vnf_index": "1", "kdu_name": "detect", "primitive": "upgrade", "primitive_params": {"x": 1}}
    with Osm(Connection(osm=fake.address)) as osm:  # an upgrade by somebody else, without a reset
        osm.start_operation(key, "action", merging)
    fake.state.complete_due(at=math.inf)
    town.write_text(TOWN, encoding="utf-8")
    assert [(one.name, one.action) for one in plan_changes(fake, town)][-1] == ("detect-north", "upgrade")
    assert not apply_file(fake, town).failed
    assert fake.state.releases[key] == {"replicaCount": 2} and plan_changes(fake, town) == []


def test_values_follow_the_merges_of_upgrades() -> None:
    chart = {"additionalParams": {"a": {"b": 1, "c": 2}}}
    first: dict[str, Any] = {"additionalParamsForVnf": [{"additionalParamsForKdu": [chart]}]}
    started = operation("instantiate", **first)
    merged = operation("action", primitive="upgrade", primitive_params='{"a": {"b": 3}, "d": 4, "kdu_model": "x"}')
    removed = operation("action", primitive="upgrade", primitive_params={"d": None})
    reset = operation("action", primitive="upgrade", primitive_params={"e": 5, "kdu_reset_values": "True"})
    failed = operation("action", "FAILED", primitive="upgrade", primitive_params={"f": 6})

    def values(*operations: OperationRecord) -> dict[str, object]:
        return Instance("1", "a", "nsd", "", "READY", True, operations).values

    assert values(started, merged) == {"a": {"b": 3, "c": 2}, "d": 4}
    assert values(started, merged, removed) == {"a": {"b": 1, "c": 2}}
    assert values(started, merged, reset, failed) == {"e": 5}
    assert values(started, reset, started) == {"a": {"b": 1, "c": 2}}


def test_machines_are_counted_since_the_last_instantiation() -> None:
    out = operation("scale", scaleVnfData={"scaleVnfType": "SCALE_OUT"})
    again = operation("instantiate")
    assert Instance("1", "a", "nsd", "", "READY", True, (again, out, out)).machine_count == 3
    assert Instance("1", "a", "nsd", "", "READY", True, (again, out, out, again, out)).machine_count == 2


def test_a_refused_package_leaves_no_record(fake: FakeOsm, town: Path) -> None:
    for status in (400, 409, 413, 422):
        fake.state.faults = lambda method, path: status if path.endswith("package_content") else None  # noqa: B023
        assert apply_file(fake, town).failed
        assert fake.state.functions == {} and fake.state.instances == {}
    fake.state.faults = lambda method, path: None


def test_an_old_osm_is_recognized(fake: FakeOsm, town: Path) -> None:
    fake.state.sol006 = False
    with pytest.raises(StepError, match="older than Release 9") as caught:
        raise apply.failure(apply_file(fake, town)) or AssertionError
    assert "docs/orchestration.md" in caught.value.remedy and fake.state.functions == {}


def test_an_unknown_project_is_named(fake: FakeOsm) -> None:
    with Osm(Connection(osm=fake.address, project="tow")) as osm, pytest.raises(OsmError, match="project tow"):
        osm.instances()


def test_refused_connections_are_retried_after_osm_has_answered(
    fake: FakeOsm, town: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OSM is down at every fourth request: nothing is done twice."""
    count, params = itertools.count(), ApplyParams(osm=fake.address, wait=True, timeout=60)
    with Osm(params) as osm:
        transport = osm._client._transport
        send = transport.handle_request

        def flaky(request: httpx.Request) -> httpx.Response:
            if next(count) % 4 == 3:
                raise httpx.ConnectError("Connection refused")
            return send(request)

        monkeypatch.setattr(transport, "handle_request", flaky)
        deployed = apply.load_state(osm, deployment.read(town), town.parent)
        result = apply.apply(osm, deployed, params, lambda fraction, message="": None)
    assert not result.failed, result.failed
    assert set(states(fake).values()) == {"READY"} and len(states(fake)) == 2 and fake.state.orphans() == []
    assert len(fake.state.operations) == 3  # two instantiations and a scaling


def test_a_redirect_is_explained(fake: FakeOsm) -> None:
    fake.state.answer = odd_answers.KINDS["a redirect to another server"]
    with Osm(Connection(osm=fake.address)) as osm, pytest.raises(OsmError, match=r"redirects to .*elsewhere") as caught:
        osm.instances()
    assert "--osm" in caught.value.remedy and len(fake.state.requests) == 2


def test_a_slow_server_is_reported(fake: FakeOsm, monkeypatch: pytest.MonkeyPatch) -> None:
    messages, reported = list[str](), threading.Event()

    def on_slow(text: str) -> None:
        messages.append(text)
        reported.set()

    with Osm(Connection(osm=fake.address), on_slow=on_slow) as osm:
        osm.instances()  # logs in
        monkeypatch.setattr(osm_client, "SLOW_RESPONSE_S", 0.1)
        fake.state.faults = lambda method, path: None if reported.wait(60) else 500
        assert osm.instances() == []
    assert len(messages) == 1 and "ns_instances" in messages[0]


def test_a_server_that_never_answers_is_given_up(fake: FakeOsm, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()
    monkeypatch.setattr(osm_client, "RESPONSE_TIMEOUT_S", 0.4)
    fake.state.faults = lambda method, path: None if ended.wait(60) else 500
    with Osm(Connection(osm=fake.address)) as osm, pytest.raises(StepError, match=r"didn't answer within 0\.4 s"):
        osm.instances()
    ended.set()


def test_an_answer_that_drips_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each byte comes in time, but the answer never ends."""
    now = 0.0

    def drip() -> Iterator[bytes]:
        nonlocal now
        while True:
            now += osm_client.RESPONSE_TIMEOUT_S / 10
            yield b" "

    monkeypatch.setattr(osm_client, "time", SimpleNamespace(monotonic=lambda: now))
    with pytest.raises(StepError, match="didn't answer"):
        osm_client._read_bounded(httpx.Response(200, content=drip()), "GET /")
    assert now == pytest.approx(1.1 * osm_client.RESPONSE_TIMEOUT_S)
