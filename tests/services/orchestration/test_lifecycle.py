"""What runs is brought to what a file says, whatever OSM answers, and nothing is left over."""

from __future__ import annotations

import itertools
import logging
import random
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import InputError, ScanError, SettingError, StepError, UnavailableError
from scan2sim.services.orchestration import apply, deployment, operations
from scan2sim.services.orchestration.apply import Applied, Change
from scan2sim.services.orchestration.instance import Action, Instance, Wanted, next_action
from scan2sim.services.orchestration.lifecycle import Patience
from scan2sim.services.orchestration.osm import FAULTS, Osm
from scan2sim.services.orchestration.package import Packages, build
from scan2sim.services.orchestration.settings import ApplyParams, Connection
from scan2sim.services.qos.requirements import Environment
from tests.fakes.osm import CUT_AFTER, CUT_BEFORE, Fake, State
from tests.services.orchestration.conftest import TOWN

QUIET: Callable[[str], None] = lambda text: None  # noqa: E731


def bring_about(fake: Fake, path: Path, *, timeout: float = 20.0, wait: bool = True) -> Applied:
    params = ApplyParams(osm=fake.address, wait=wait, timeout=timeout)
    with Osm(params) as osm:
        there = apply.target(osm, deployment.read(path), path.parent)
        return apply.apply(osm, there, params, lambda fraction, message="": None)


def planned(fake: Fake, path: Path) -> list[Change]:
    with Osm(Connection(osm=fake.address)) as osm:
        return apply.plan(apply.target(osm, deployment.read(path), path.parent))


def states(fake: Fake) -> dict[str, str]:
    return {one["name"]: one["nsState"] for one in fake.state.instances.values()}


WANTED = Wanted("a", "town", "detect", "container", "nsd", "vim")


def seen(state: str = "READY", instantiated: bool = True, mark: str = WANTED.mark, **operation: str) -> Instance:
    started = {
        "lcmOperationType": "instantiate",
        "operationState": "COMPLETED",
        "operationParams": WANTED.request("record"),
    }
    return Instance("1", "a", "nsd", mark, state, instantiated, (started, operation) if operation else (started,))


@pytest.mark.parametrize(
    ("wanted", "there", "action"),
    [
        (None, None, None),
        (WANTED, None, Action.CREATE),
        (WANTED, seen(), None),
        (WANTED, seen("NOT_INSTANTIATED", False), Action.INSTANTIATE),
        (WANTED, seen("BUILDING", False, operationState="PROCESSING"), Action.FOLLOW),
        (None, seen("BUILDING", False, operationState="PROCESSING"), Action.FOLLOW),
        (WANTED, seen("BROKEN"), Action.TERMINATE),
        (None, seen(), Action.TERMINATE),
        (None, seen("NOT_INSTANTIATED", False), Action.DELETE),
        (WANTED, seen(mark="scan2sim town 000000000000"), Action.TERMINATE),
        (Wanted("a", "town", "detect", "container", "nsd", "vim", replicas=3), seen(), Action.UPGRADE),
    ],
)
def test_what_is_done_next_is_told_by_what_is_there(
    wanted: Wanted | None, there: Instance | None, action: Action | None
) -> None:
    assert next_action(wanted, there) == action


def test_a_file_is_brought_about_once_changed_and_undone(fake: Fake, town: Path) -> None:
    assert {one.what for one in planned(fake, town)} == {"onboard", "create"}
    assert not bring_about(fake, town).failed
    assert states(fake) == {"detect-north": "READY", "segment-south": "READY"} and fake.state.orphans() == []
    assert planned(fake, town) == []
    before = len([1 for _, method, path in fake.state.asked if method != "GET" and "tokens" not in path])
    assert bring_about(fake, town) == Applied()
    assert before == len([1 for _, method, path in fake.state.asked if method != "GET" and "tokens" not in path])

    town.write_text(TOWN.replace("replicas = 2", "replicas = 3").replace('"detect"', '"classify"'), encoding="utf-8")
    told = {(one.name, one.what) for one in planned(fake, town)}
    assert ("detect-north", "make anew") in told and ("segment-south", "scale out") in told
    assert not bring_about(fake, town).failed and planned(fake, town) == []
    assert len(fake.state.functions) == 2  # the detector's is gone

    town.write_text('deployment = "town"', encoding="utf-8")
    assert not bring_about(fake, town).failed
    assert (fake.state.instances, fake.state.services, fake.state.functions) == ({}, {}, {})
    assert not fake.state.resources


def test_what_isnt_the_deployments_stays(fake: Fake, osm: Osm, town: Path) -> None:
    made = build_detect("mine")
    operations.onboard(osm, [made.function, made.service])
    hand = Patience(10)
    operations.instantiate(osm, "by-hand", made.service.descriptor.id, osm.vim("edge-site"), patience=hand, say=QUIET)
    bring_about(fake, town)
    town.write_text('deployment = "town"', encoding="utf-8")
    bring_about(fake, town)
    assert states(fake) == {"by-hand": "READY"} and len(fake.state.functions) == 1
    town.write_text(TOWN.replace("detect-north", "by-hand"), encoding="utf-8")
    applied = bring_about(fake, town)
    assert "isn't this deployment's" in applied.failed["by-hand"].cause and states(fake)["segment-south"] == "READY"


def build_detect(prefix: str) -> Packages:
    from scan2sim.services.orchestration import description

    return build(description.read("detect"), Environment.EDGE, "container", prefix)


def test_an_operation_that_fails_is_told_and_leaves_nothing(fake: Fake, town: Path) -> None:
    fake.state.outcome = lambda kind, name: "FAILED" if (kind, name) == ("instantiate", "detect-north") else "COMPLETED"
    applied = bring_about(fake, town)
    error = applied.failed["detect-north"]
    assert "FAILED: no quota" in error.cause and "run again" in error.remedy
    assert states(fake) == {"segment-south": "READY"} and fake.state.orphans() == []
    fake.state.outcome = lambda kind, name: "COMPLETED"
    assert not bring_about(fake, town).failed and len(states(fake)) == 2


def test_an_operation_that_never_ends_is_left_and_followed_by_the_next_run(fake: Fake, town: Path) -> None:
    fake.state.outcome = lambda kind, name: "never" if name == "detect-north" else "COMPLETED"
    applied = bring_about(fake, town, timeout=1.0)
    assert "isn't over after 1 s" in applied.failed["detect-north"].cause
    assert any((one.name, one.what) == ("detect-north", "follow") for one in planned(fake, town))
    fake.state.outcome = lambda kind, name: "COMPLETED"
    assert not bring_about(fake, town).failed
    assert states(fake)["detect-north"] == "READY" and len(fake.state.instances) == 2


def test_nothing_is_waited_for_unless_asked(fake: Fake, town: Path) -> None:
    fake.state.seconds = 3600
    begun = time.monotonic()
    assert not bring_about(fake, town, wait=False).failed
    assert time.monotonic() - begun < 10 and set(states(fake).values()) == {"BUILDING"}


@pytest.mark.parametrize("status", sorted(FAULTS))
def test_every_refusal_is_a_sentence_and_the_next_run_goes_on(fake: Fake, town: Path, status: int) -> None:
    """At each kind of request in turn, again and again until the run ends."""
    for refused in ("vnf_packages", "ns_descriptors", "ns_instances", "instantiate"):
        fake.state.faults = lambda method, path, part=refused: status if method != "GET" and part in path else None  # type: ignore[misc]
        try:
            applied = bring_about(fake, town)
            errors: list[ScanError] = list(applied.failed.values())
        except ScanError as error:
            errors = [error]
        assert errors and all(str(status) in str(e) and e.remedy for e in errors), refused
        fake.state.faults = lambda method, path: None
    assert not bring_about(fake, town).failed
    assert set(states(fake).values()) == {"READY"} and fake.state.orphans() == [] and len(fake.state.instances) == 2


@pytest.mark.parametrize("fault", [CUT_BEFORE, CUT_AFTER, 504])
def test_a_connection_cut_at_any_request_costs_nothing(town: Path, fault: str | int) -> None:
    """Each request in turn is the one whose answer is lost: all ends as if none were, with nothing made twice."""
    for cut in range(100):
        count = itertools.count()
        with Fake(State(seconds=0.01, faults=lambda method, path: fault if next(count) == cut else None)) as fake:  # noqa: B023
            applied = bring_about(fake, town)
            assert not applied.failed, (cut, applied.failed)
            assert len(fake.state.instances) == 2 and set(states(fake).values()) == {"READY"}, cut
            assert fake.state.orphans() == [] and len(fake.state.functions) == len(fake.state.services) == 2, cut
        if next(count) <= cut:
            return
    pytest.fail("there is no end of requests")


def test_a_token_that_is_taken_back_is_renewed(fake: Fake, town: Path) -> None:
    count = itertools.count()

    def forget(method: str, path: str) -> None:
        if next(count) % 7 == 0:
            fake.state.tokens.clear()

    fake.state.faults = forget
    assert not bring_about(fake, town).failed
    assert sum(path.endswith("tokens") for _, _, path in fake.state.asked) > 3


def test_stopped_at_any_moment_it_goes_on_to_the_same_end(town: Path) -> None:
    """As Ctrl-C stops it: nothing more is begun, and what is begun stays as it is."""
    rng = random.Random(0)
    with Fake(State(seconds=0.02)) as fake:
        bring_about(fake, town)
        whole = fake.state.summary()
    for _ in range(8):
        with Fake(State(seconds=0.05)) as fake:
            stop = threading.Event()
            params = ApplyParams(osm=fake.address, wait=True)
            threading.Timer(rng.uniform(0, 0.4), stop.set).start()
            with Osm(params) as osm:
                there = apply.target(osm, deployment.read(town), town.parent)
                apply.apply(osm, there, params, lambda fraction, message="": None, stop)
            bring_about(fake, town)
            assert fake.state.summary() == whole and fake.state.orphans() == []


def test_scaling_healing_and_removing_by_hand(fake: Fake, osm: Osm) -> None:
    patience, made = Patience(10), build_detect("mine")
    nsd = made.service.descriptor.id
    with pytest.raises(InputError, match="neither given nor in OSM"):
        operations.onboard(osm, [made.service])
    with pytest.raises(InputError, match="two packages"):
        operations.onboard(osm, [made.function, made.function])
    operations.onboard(osm, [made.service, made.function])
    operations.instantiate(osm, "one", nsd, osm.cluster("edge-cluster"), replicas=2, patience=patience, say=QUIET)
    operations.resize(osm, "one", 5, patience, QUIET)
    kinds = [one["lcmOperationType"] for one in fake.state.operations.values()]
    operations.resize(osm, "one", 5, patience, QUIET)  # nothing more
    assert kinds == ["instantiate", "action"] and len(fake.state.operations) == 2
    operations.heal(osm, "one", patience, QUIET)
    operations.terminate(osm, "one", patience, QUIET)
    with pytest.raises(SettingError, match="isn't running"):
        operations.resize(osm, "one", 1, patience, QUIET)
    operations.delete(osm, [made.function, made.service], patience, QUIET)
    assert not fake.state.instances and not fake.state.functions and not fake.state.services
    with pytest.raises(SettingError, match="no such"):
        operations.delete_packages(osm, ["gone"])


def test_an_instance_is_deleted_only_when_its_operation_is_over(fake: Fake, osm: Osm) -> None:
    """OSM would forget the operation, and what it makes would run on, nobody's."""
    made = build_detect("mine")
    operations.onboard(osm, [made.service, made.function])
    nsd = made.service.descriptor.id
    fake.state.seconds = 0.5
    operations.instantiate(osm, "one", nsd, osm.vim("edge-site"), patience=Patience(wait=False), say=QUIET)
    operations.delete_instance(osm, "one", Patience(10), QUIET)
    assert not fake.state.resources and fake.state.orphans() == []


def test_sites_keys_and_names_that_arent_there_are_refused_before_anything_is_sent(fake: Fake, town: Path) -> None:
    for old, new, said in (
        ('"edge-cluster"', '"moon"', "There are: edge-cluster"),
        ('"segment-south"', '"detect-north"', "two services are called"),
        ('vim = "edge-site"', 'vim = "edge-site"\nssh_keys = ["gone.pub"]', "gone.pub"),
        ('service = "detect"', 'service = "../detect"', "one of: classify"),
        ('name = "detect-north"', 'name = "Nord Süd"', "name"),
        ('cluster = "edge-cluster"', "", "give `vim` or `cluster`"),
    ):
        town.write_text(TOWN.replace(old, new), encoding="utf-8")
        with pytest.raises(ScanError, match=said.replace(".", r"\.")):
            bring_about(fake, town)
    assert not fake.state.functions and not fake.state.instances
    (town.parent / "id").write_text("-----BEGIN OPENSSH PRIVATE KEY-----", encoding="utf-8")
    town.write_text(TOWN.replace('vim = "edge-site"', 'vim = "edge-site"\nssh_keys = ["id"]'), encoding="utf-8")
    with pytest.raises(InputError, match="private key"):
        bring_about(fake, town)


def test_secrets_are_never_told(
    fake: Fake, town: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.DEBUG)
    bring_about(fake, town)
    monkeypatch.setenv("OSM_PASSWORD", "hush-hush-123")
    with pytest.raises(StepError) as caught:
        bring_about(fake, town)
    token = next(iter(fake.state.tokens))
    assert "hush-hush-123" not in caplog.text + str(caught.value) and token not in caplog.text


def test_addresses_without_tls_are_refused() -> None:
    for address in (
        "http://osm.example.org",
        "http://user:hunter2@osm.example.org",
        "https://user:hunter2@osm.example.org",
        "https://:hunter2@osm.example.org",
        "ftp://x",
        "https://x/other",
    ):
        with pytest.raises(SettingError) as caught:
            Connection(osm=address).northbound()
        assert "hunter2" not in str(caught.value)
    assert Connection(osm="osm.example.org").northbound() == "https://osm.example.org:9999"
    with Osm(Connection(osm="http://127.0.0.1:9")) as osm, pytest.raises(UnavailableError, match="can't be reached"):
        osm.instances()
