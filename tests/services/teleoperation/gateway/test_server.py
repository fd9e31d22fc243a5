"""Vehicles and stations at a running gateway over TLS: joined, rejected, and joined again after its restart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")

from scan2sim.services.teleoperation.gateway.client import GatewayConnection
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.gateway_protocol import (
    PROTOCOL_VERSION,
    Address,
    CurrentPair,
    DriverRequest,
    Hello,
    Join,
    LinkStatus,
    Release,
    RequestRejected,
    Status,
)
from scan2sim.services.teleoperation.identity import Identity
from tests.waiting import until


class ObedientParty:
    """A party that follows its orders."""

    def __init__(self, folder: Path, port: int, listening: tuple[Address, ...] = ()) -> None:
        self.orders: list[Join | Release | RequestRejected] = []
        self.driving: CurrentPair | None = None
        self.messages: list[str] = []
        self._listening = listening
        self.identity = Identity.read(folder)
        self.gateway_connection = GatewayConnection(
            self.identity, Address(host="127.0.0.1", port=port), self, self.messages.append
        )

    def hello(self) -> Hello:
        return Hello(listening=self._listening, driving=self.driving)

    def status(self) -> Status:
        return Status(links=(LinkStatus(name="lte", up=True, round_trip=41.0),), speed=1.5)

    def handle_order(self, order: Join | Release | RequestRejected) -> None:
        self.orders.append(order)
        if isinstance(order, Join):
            self.driving = CurrentPair(pair=order.pair, other=order.other.name)
        elif isinstance(order, Release):
            self.driving = None


@pytest.fixture(scope="module")
def parties(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parties")
    certify(folder, ["127.0.0.1"], ["car"], ["desk", "other"], 1, False)
    return folder


@pytest.fixture
def gateway(parties: Path, tmp_path: Path) -> Iterator[Callable[[int], tuple[Gateway, Fleet]]]:
    """Starts a gateway on a port in place of the previous one; all share one state."""
    started: list[Gateway] = []

    def start(port: int) -> tuple[Gateway, Fleet]:
        for one in started:
            one.close()
        fleet = Fleet(tmp_path / "state")
        started.append(Gateway(Identity.read(parties / "gateway"), "127.0.0.1", port, fleet, lambda _: None))
        return started[-1], fleet

    yield start
    for one in started:
        one.close()


def test_pair_survives_a_restart_of_the_gateway(parties: Path, gateway: Callable[[int], tuple[Gateway, Fleet]]) -> None:
    first, fleet = gateway(0)
    listening = (Address(host="192.0.2.1", port=7444),)
    car = ObedientParty(parties / "vehicle-car", first.port)
    desk = ObedientParty(parties / "station-desk", first.port, listening)
    try:
        until(lambda: car.orders and desk.orders)
        desk.gateway_connection.send_request(DriverRequest(what="join", vehicle="car"))
        until(lambda: isinstance(car.orders[-1], Join) and isinstance(desk.orders[-1], Join))
        order = car.orders[-1]
        assert isinstance(order, Join) and order.listening == listening
        assert order.other.fingerprint == desk.identity.me.fingerprint
        until(lambda: fleet.snapshot()["vehicles"][0]["links"])
        assert fleet.speeds()["car"]["speed"] == 1.5
        before = len(car.orders)
        _, again = gateway(first.port)
        until(lambda: len(car.orders) > before and car.gateway_connection.connected())
        assert car.orders[-1] == order and all(isinstance(one, Join) for one in car.orders[before:])
        assert again.snapshot()["vehicles"][0]["other"] == "desk"
    finally:
        car.gateway_connection.close()
        desk.gateway_connection.close()


def test_rejected_request_is_reported_to_its_sender(
    parties: Path, gateway: Callable[[int], tuple[Gateway, Fleet]]
) -> None:
    started, _ = gateway(0)
    desk = ObedientParty(parties / "station-desk", started.port)
    try:
        until(lambda: desk.orders)
        desk.gateway_connection.send_request(DriverRequest(what="join", vehicle="car"))
        until(lambda: isinstance(desk.orders[-1], RequestRejected))
        answer = desk.orders[-1]
        assert isinstance(answer, RequestRejected) and "not a connected vehicle" in answer.cause
    finally:
        desk.gateway_connection.close()


def test_party_with_another_protocol_version_is_rejected(
    parties: Path, gateway: Callable[[int], tuple[Gateway, Fleet]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ObedientParty, "hello", lambda _: Hello(version=PROTOCOL_VERSION - 1))
    started, fleet = gateway(0)
    car = ObedientParty(parties / "vehicle-car", started.port)
    try:
        until(lambda: car.orders)
        answer = car.orders[0]
        assert isinstance(answer, RequestRejected) and f"protocol version {PROTOCOL_VERSION}" in answer.cause
        assert any(answer.cause in message for message in car.messages)
        assert not fleet.snapshot()["vehicles"]
    finally:
        car.gateway_connection.close()
