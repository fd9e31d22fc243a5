"""The fleet: who drives whom is decided once, kept, told to both, and told again to whoever comes back."""

from __future__ import annotations

import json
import random
from functools import partial
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import BusyError, InputError, ScanError, SettingError, SpaceError
from scan2sim.services.teleoperation.gateway.fleet import Fleet, Order
from scan2sim.services.teleoperation.gateway.identity import Peer, Role
from scan2sim.services.teleoperation.gateway.protocol import Ask, Driving, Hello, Join, Release, Status


class Party:
    """A vehicle or a station as the fleet sees it; keeps its orders."""

    def __init__(self, role: Role, name: str) -> None:
        self.peer = Peer(role, name, f"{hash((role, name)) & 0xFF:02x}" * 32)
        self.orders: list[Order] = []

    def send(self, order: Order) -> None:
        self.orders.append(order)

    def comes(self, fleet: Fleet, driving: Driving | None = None) -> Party:
        fleet.came(self.peer, Hello(driving=driving), "10.0.0.1", self.send)
        return self

    def pair(self) -> int | None:
        """What the last order says that it is in."""
        last = self.orders[-1]
        return last.pair if isinstance(last, Join) else None


def there(fleet: Fleet) -> tuple[Party, Party, Party]:
    car, desk, other = Party(Role.VEHICLE, "car"), Party(Role.STATION, "desk"), Party(Role.STATION, "other")
    for party in (car, desk, other):
        party.comes(fleet)
        assert isinstance(party.orders[-1], Release)
    return car, desk, other


def test_a_pair_is_told_to_both_with_the_other_ones_certificate(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car, desk, _ = there(fleet)
    pair = fleet.join("car", "desk", "operator")
    for party, other in ((car, desk), (desk, car)):
        order = party.orders[-1]
        assert isinstance(order, Join) and order.pair == pair.number
        assert (order.other.name, order.other.fingerprint) == (other.peer.name, other.peer.fingerprint)
    shown = fleet.facts()
    assert shown["vehicles"][0]["other"] == "desk" and shown["stations"][0]["other"] == "car"


def test_two_stations_never_drive_one_vehicle(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car, desk, other = there(fleet)
    fleet.join("car", "desk", "operator")
    with pytest.raises(BusyError, match="driven from desk"):
        fleet.join("car", "other", "operator")
    with pytest.raises(BusyError, match="driven from desk"):
        fleet.asked(other.peer, Ask(what="release", vehicle="car"))
    with pytest.raises(BusyError):
        fleet.asked(other.peer, Ask(what="join", vehicle="car"))
    assert isinstance(other.orders[-1], Release) and car.pair() == desk.pair() == 1


def test_a_station_drives_one_vehicle_at_a_time_and_only_what_is_there(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    _, _, _ = there(fleet)
    Party(Role.VEHICLE, "second").comes(fleet)
    fleet.join("car", "desk", "operator")
    with pytest.raises(BusyError, match="drives car"):
        fleet.join("second", "desk", "operator")
    for vehicle, station in (("third", "other"), ("second", "nobody"), ("desk", "second")):
        with pytest.raises(SettingError, match="connected"):
            fleet.join(vehicle, station, "operator")


def test_a_vehicle_is_handed_over_taken_back_and_released(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car, desk, other = there(fleet)
    fleet.join("car", "desk", "operator")
    fleet.hand_over("car", "other", "operator")
    assert car.pair() == other.pair() == 2 and isinstance(desk.orders[-1], Release)
    fleet.take_back("car", "operator")
    assert car.pair() == desk.pair() == 3 and isinstance(other.orders[-1], Release)
    fleet.release("car", "operator")
    assert isinstance(car.orders[-1], Release) and isinstance(desk.orders[-1], Release)
    with pytest.raises(SettingError, match="by nobody"):
        fleet.release("car", "operator")
    told = [(one["what"], one["pair"], one["by"]) for one in fleet.audit.newest]
    assert told == [
        (what, n, "operator") for what, n in (("join", 1), ("hand over", 2), ("hand over", 3), ("release", 3))
    ]


def test_a_gateway_that_starts_anew_finds_its_pairs(tmp_path: Path) -> None:
    first = Fleet(tmp_path)
    there(first)
    first.join("car", "desk", "operator")
    again = Fleet(tmp_path)
    car = Party(Role.VEHICLE, "car").comes(again, Driving(pair=1, other="desk"))
    desk = Party(Role.STATION, "desk").comes(again)
    assert car.pair() == desk.pair() == 1
    assert len(again.audit.newest) == 1


def test_a_gateway_that_lost_everything_finds_a_pair_that_both_tell_of(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car = Party(Role.VEHICLE, "car").comes(fleet, Driving(pair=7, other="desk"))
    assert car.pair() is None, "a vehicle's word alone is none"
    desk = Party(Role.STATION, "desk").comes(fleet, Driving(pair=7, other="car"))
    assert car.pair() == desk.pair() == 7 and fleet.audit.newest[-1]["by"] == "gateway"
    Party(Role.STATION, "liar").comes(fleet, Driving(pair=9, other="car"))
    assert car.pair() == 7


def test_what_a_full_disk_keeps_from_the_audit_is_not_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(tmp_path)
    car, desk, _ = there(fleet)
    fleet.join("car", "desk", "operator")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", full)
        with pytest.raises(SpaceError):
            fleet.hand_over("car", "other", "operator")
    assert car.pair() == desk.pair() == 1, "who drives goes on driving"
    fleet.hand_over("car", "other", "operator")
    lines = (tmp_path / "audit.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["pair"] for line in lines] == [1, 2]


def test_an_audit_that_a_crash_cut_short_goes_on(tmp_path: Path) -> None:
    (tmp_path / "audit.jsonl").write_text('{"what": "join", "pair": 1}\n{"wha', encoding="utf-8")
    fleet = Fleet(tmp_path)
    there(fleet)
    fleet.join("car", "desk", "operator")
    lines = (tmp_path / "audit.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(lines[-1])["what"] == "join" and len(Fleet(tmp_path).audit.newest) == 2


def test_a_damaged_state_is_refused_in_words(tmp_path: Path) -> None:
    (tmp_path / "fleet.json").write_text("[1, {]", encoding="utf-8")
    with pytest.raises(InputError, match="found again"):
        Fleet(tmp_path)


def test_a_party_that_comes_again_while_its_old_connection_lingers(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    car, _, _ = there(fleet)
    fleet.join("car", "desk", "operator")
    again = Party(Role.VEHICLE, "car").comes(fleet)
    fleet.left(car.peer, car.send)
    assert again.pair() == 1 and fleet.facts()["vehicles"][0]["there"]
    fleet.told(again.peer, Status(pair=1, speed=2.0))
    assert fleet.facts()["vehicles"][0]["speed"] == 2.0


def test_whatever_is_asked_no_vehicle_and_no_station_is_in_two_pairs(tmp_path: Path) -> None:
    random.seed(0)
    fleet = Fleet(tmp_path)
    cars = [Party(Role.VEHICLE, f"car{n}").comes(fleet) for n in range(3)]
    desks = [Party(Role.STATION, f"desk{n}").comes(fleet) for n in range(3)]
    for _ in range(400):
        vehicle, station = random.choice(cars).peer.name, random.choice(desks).peer.name
        acts = (
            partial(fleet.join, vehicle, station, "x"),
            partial(fleet.hand_over, vehicle, station, "x"),
            partial(fleet.take_back, vehicle, "x"),
            partial(fleet.release, vehicle, "x"),
        )
        try:
            random.choice(acts)()
        except ScanError:
            continue
        shown = fleet.facts()
        pairs = {one["pair"]: (one["name"], one["other"]) for one in shown["vehicles"] if one["pair"]}
        assert len({other for _, other in pairs.values()}) == len(pairs)
        assert {one["pair"]: (one["other"], one["name"]) for one in shown["stations"] if one["pair"]} == pairs
        for car in cars:
            mine = next((pair for pair, (name, _) in pairs.items() if name == car.peer.name), None)
            assert car.pair() == mine
