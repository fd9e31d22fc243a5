"""The fleet: pairs are decided once, stored, sent to both parties, and sent again to a party that reconnects."""

from __future__ import annotations

import json
import random
from functools import partial
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import BusyError, InputError, ScanError, SettingError, SpaceError
from scan2sim.services.teleoperation.gateway.fleet import Fleet, Order
from scan2sim.services.teleoperation.gateway_protocol import CurrentPair, DriverRequest, Hello, Join, Release, Status
from scan2sim.services.teleoperation.identity import Peer, Role


class Party:
    """A vehicle or station as the fleet sees it; records its orders."""

    def __init__(self, role: Role, name: str) -> None:
        self.peer = Peer(role, name, f"{hash((role, name)) & 0xFF:02x}" * 32)
        self.orders: list[Order] = []

    def send(self, order: Order) -> None:
        self.orders.append(order)

    def connect(self, fleet: Fleet, driving: CurrentPair | None = None) -> Party:
        fleet.connected(self.peer, Hello(driving=driving), "10.0.0.1", self.send)
        return self

    def pair(self) -> int | None:
        """Number of the pair in the last order."""
        last = self.orders[-1]
        return last.pair if isinstance(last, Join) else None


def connected_parties(fleet: Fleet) -> tuple[Party, Party, Party]:
    car, desk, other = Party(Role.VEHICLE, "car"), Party(Role.STATION, "desk"), Party(Role.STATION, "other")
    for party in (car, desk, other):
        party.connect(fleet)
        assert isinstance(party.orders[-1], Release)
    return car, desk, other


def test_pair_is_sent_to_both_parties_with_the_other_certificate(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car, desk, _ = connected_parties(fleet)
    pair = fleet.join("car", "desk", "operator")
    for party, other in ((car, desk), (desk, car)):
        order = party.orders[-1]
        assert isinstance(order, Join) and order.pair == pair.number
        assert (order.other.name, order.other.fingerprint) == (other.peer.name, other.peer.fingerprint)
    state = fleet.snapshot()
    assert state["vehicles"][0]["other"] == "desk" and state["stations"][0]["other"] == "car"


def test_vehicle_has_one_station_at_most(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car, desk, other = connected_parties(fleet)
    fleet.join("car", "desk", "operator")
    with pytest.raises(BusyError, match="driven from desk"):
        fleet.join("car", "other", "operator")
    with pytest.raises(BusyError, match="driven from desk"):
        fleet.handle_request(other.peer, DriverRequest(what="release", vehicle="car"))
    with pytest.raises(BusyError):
        fleet.handle_request(other.peer, DriverRequest(what="join", vehicle="car"))
    assert isinstance(other.orders[-1], Release) and car.pair() == desk.pair() == 1


def test_station_drives_one_connected_vehicle_at_a_time(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    _, _, _ = connected_parties(fleet)
    Party(Role.VEHICLE, "second").connect(fleet)
    fleet.join("car", "desk", "operator")
    with pytest.raises(BusyError, match="drives car"):
        fleet.join("second", "desk", "operator")
    for vehicle, station in (("third", "other"), ("second", "nobody"), ("desk", "second")):
        with pytest.raises(SettingError, match="connected"):
            fleet.join(vehicle, station, "operator")


def test_vehicle_is_handed_over_taken_back_and_released(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car, desk, other = connected_parties(fleet)
    fleet.join("car", "desk", "operator")
    fleet.hand_over("car", "other", "operator")
    assert car.pair() == other.pair() == 2 and isinstance(desk.orders[-1], Release)
    fleet.take_back("car", "operator")
    assert car.pair() == desk.pair() == 3 and isinstance(other.orders[-1], Release)
    fleet.release("car", "operator")
    assert isinstance(car.orders[-1], Release) and isinstance(desk.orders[-1], Release)
    with pytest.raises(SettingError, match="not driven by any station"):
        fleet.release("car", "operator")
    entries = [(one["what"], one["pair"], one["by"]) for one in fleet.audit.newest]
    assert entries == [
        (what, n, "operator") for what, n in (("join", 1), ("hand over", 2), ("hand over", 3), ("release", 3))
    ]


def test_restarted_gateway_restores_its_pairs(tmp_path: Path) -> None:
    first = Fleet(tmp_path)
    connected_parties(first)
    first.join("car", "desk", "operator")
    again = Fleet(tmp_path)
    car = Party(Role.VEHICLE, "car").connect(again, CurrentPair(pair=1, other="desk"))
    desk = Party(Role.STATION, "desk").connect(again)
    assert car.pair() == desk.pair() == 1
    assert len(again.audit.newest) == 1


def test_lost_state_is_restored_from_a_pair_that_both_parties_report(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car = Party(Role.VEHICLE, "car").connect(fleet, CurrentPair(pair=7, other="desk"))
    assert car.pair() is None, "the report of one party is not sufficient"
    desk = Party(Role.STATION, "desk").connect(fleet, CurrentPair(pair=7, other="car"))
    assert car.pair() == desk.pair() == 7 and fleet.audit.newest[-1]["by"] == "gateway"
    Party(Role.STATION, "liar").connect(fleet, CurrentPair(pair=9, other="car"))
    assert car.pair() == 7


def test_action_is_not_done_if_the_audit_trail_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = Fleet(tmp_path)
    car, desk, _ = connected_parties(fleet)
    fleet.join("car", "desk", "operator")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", full)
        with pytest.raises(SpaceError):
            fleet.hand_over("car", "other", "operator")
    assert car.pair() == desk.pair() == 1, "the current pair keeps driving"
    fleet.hand_over("car", "other", "operator")
    lines = (tmp_path / "audit.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["pair"] for line in lines] == [1, 2]


def test_audit_trail_truncated_by_a_crash_is_continued(tmp_path: Path) -> None:
    (tmp_path / "audit.jsonl").write_text('{"what": "join", "pair": 1}\n{"wha', encoding="utf-8")
    fleet = Fleet(tmp_path)
    connected_parties(fleet)
    fleet.join("car", "desk", "operator")
    lines = (tmp_path / "audit.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(lines[-1])["what"] == "join" and len(Fleet(tmp_path).audit.newest) == 2


def test_damaged_state_reports_how_to_fix_it(tmp_path: Path) -> None:
    (tmp_path / "fleet.json").write_text("[1, {]", encoding="utf-8")
    with pytest.raises(InputError, match="restored when both parties reconnect"):
        Fleet(tmp_path)


def test_party_reconnects_while_its_old_connection_lingers(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car, _, _ = connected_parties(fleet)
    fleet.join("car", "desk", "operator")
    again = Party(Role.VEHICLE, "car").connect(fleet)
    fleet.disconnected(car.peer, car.send)
    assert again.pair() == 1 and fleet.snapshot()["vehicles"][0]["connected"]
    fleet.update_status(again.peer, Status(pair=1, speed=2.0))
    assert fleet.speeds()["car"]["speed"] == 2.0


def test_random_requests_never_put_a_party_into_two_pairs(tmp_path: Path) -> None:
    random.seed(0)
    fleet = Fleet(tmp_path)
    cars = [Party(Role.VEHICLE, f"car{n}").connect(fleet) for n in range(3)]
    desks = [Party(Role.STATION, f"desk{n}").connect(fleet) for n in range(3)]
    for _ in range(400):
        vehicle, station = random.choice(cars).peer.name, random.choice(desks).peer.name
        actions = (
            partial(fleet.join, vehicle, station, "x"),
            partial(fleet.hand_over, vehicle, station, "x"),
            partial(fleet.take_back, vehicle, "x"),
            partial(fleet.release, vehicle, "x"),
        )
        try:
            random.choice(actions)()
        except ScanError:
            continue
        state = fleet.snapshot()
        pairs = {one["pair"]: (one["name"], one["other"]) for one in state["vehicles"] if one["pair"]}
        assert len({other for _, other in pairs.values()}) == len(pairs)
        assert {one["pair"]: (one["other"], one["name"]) for one in state["stations"] if one["pair"]} == pairs
        for car in cars:
            own_pair = next((pair for pair, (name, _) in pairs.items() if name == car.peer.name), None)
            assert car.pair() == own_pair


def test_fleet_knows_who_drives_and_since_when(tmp_path: Path) -> None:
    now = [1000.0]
    fleet = Fleet(tmp_path, now=lambda: now[0])
    _, desk, _ = connected_parties(fleet)
    fleet.join("car", "desk", "operator")

    def drivers() -> list[tuple[str, float | None]]:
        state = fleet.snapshot()
        vehicle, station = state["vehicles"][0], next(one for one in state["stations"] if one["name"] == "desk")
        assert "held" not in vehicle
        return [(one["driver"], one["driver_since"]) for one in (vehicle, station)]

    def report(driver: str, held: float) -> None:
        fleet.update_status(desk.peer, Status(pair=1, driver=driver, held=held))

    assert drivers() == [("", None), ("", None)]
    report("anna", 20.0)  # the gateway was restarted while she drove
    now[0] += 5.0
    report("anna", 25.0)
    assert drivers() == [("anna", 980.0), ("anna", 980.0)]
    report("anna", 1.0)  # she released control, and took it again
    assert drivers()[0] == ("anna", 1004.0)
    report("ben", 2.0)
    assert drivers()[0] == ("ben", 1003.0)
    report("", 0.0)
    assert drivers() == [("", None), ("", None)]
    report("ben", 1.0)
    fleet.disconnected(desk.peer, desk.send)
    assert drivers()[0] == ("", None)
