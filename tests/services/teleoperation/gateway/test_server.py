"""Vehicles and stations at a real gateway, over TLS: joined, told again, refused; the gateway starts anew meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")

from scan2sim.services.teleoperation.gateway.client import Membership
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.identity import Identity
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.gateway.protocol import (
    Address,
    Ask,
    Driving,
    Hello,
    Join,
    LinkStatus,
    Refused,
    Release,
    Status,
)
from scan2sim.services.teleoperation.gateway.server import Gateway


def until(true: Callable[[], object], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "never true"
        time.sleep(0.02)


class Told:
    """A party that does what it is told."""

    def __init__(self, folder: Path, port: int, listening: tuple[Address, ...] = ()) -> None:
        self.orders: list[Join | Release | Refused] = []
        self.driving: Driving | None = None
        self._listening = listening
        self.identity = Identity.read(folder)
        self.membership = Membership(self.identity, Address(host="127.0.0.1", port=port), self, lambda _: None)

    def hello(self) -> Hello:
        return Hello(listening=self._listening, driving=self.driving)

    def status(self) -> Status:
        return Status(links=(LinkStatus(name="lte", up=True, round_trip=41.0),), speed=1.5)

    def obey(self, order: Join | Release | Refused) -> None:
        self.orders.append(order)
        if isinstance(order, Join):
            self.driving = Driving(pair=order.pair, other=order.other.name)
        elif isinstance(order, Release):
            self.driving = None


@pytest.fixture(scope="module")
def parties(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parties")
    certify(folder, ["127.0.0.1"], ["car"], ["desk", "other"], 1, False)
    return folder


@pytest.fixture
def gateway(parties: Path, tmp_path: Path) -> Iterator[Callable[[int], tuple[Gateway, Fleet]]]:
    """Starts a gateway on a port, in place of the one before; all have one state."""
    made: list[Gateway] = []

    def start(port: int) -> tuple[Gateway, Fleet]:
        for one in made:
            one.close()
        fleet = Fleet(tmp_path / "state")
        made.append(Gateway(Identity.read(parties / "gateway"), "127.0.0.1", port, fleet, lambda _: None))
        return made[-1], fleet

    yield start
    for one in made:
        one.close()


def test_a_pair_outlives_its_gateway(parties: Path, gateway: Callable[[int], tuple[Gateway, Fleet]]) -> None:
    first, fleet = gateway(0)
    listening = (Address(host="192.0.2.1", port=7444),)
    car = Told(parties / "vehicle-car", first.port)
    desk = Told(parties / "station-desk", first.port, listening)
    try:
        until(lambda: car.orders and desk.orders)
        desk.membership.ask(Ask(what="join", vehicle="car"))
        until(lambda: isinstance(car.orders[-1], Join) and isinstance(desk.orders[-1], Join))
        told = car.orders[-1]
        assert isinstance(told, Join) and told.listening == listening
        assert told.other.fingerprint == desk.identity.me.fingerprint
        until(lambda: fleet.facts()["vehicles"][0]["links"], 5)
        assert fleet.facts()["vehicles"][0]["speed"] == 1.5
        before = len(car.orders)
        _, again = gateway(first.port)
        until(lambda: len(car.orders) > before and car.membership.connected())
        assert car.orders[-1] == told and all(isinstance(one, Join) for one in car.orders[before:])
        assert again.facts()["vehicles"][0]["other"] == "desk"
    finally:
        car.membership.close()
        desk.membership.close()


def test_what_is_not_done_is_told_to_who_asked(parties: Path, gateway: Callable[[int], tuple[Gateway, Fleet]]) -> None:
    made, _ = gateway(0)
    desk = Told(parties / "station-desk", made.port)
    try:
        until(lambda: desk.orders)
        desk.membership.ask(Ask(what="join", vehicle="car"))
        until(lambda: isinstance(desk.orders[-1], Refused))
        refused = desk.orders[-1]
        assert isinstance(refused, Refused) and "no vehicle that is connected" in refused.cause
    finally:
        desk.membership.close()
