"""Onboard unit and vehicle adapter: each stops the vehicle if the other fails; it starts only when both agree."""

from __future__ import annotations

import os
from random import Random

import pytest

from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import Command, Malformed
from scan2sim.services.teleoperation.control.safety import DROP_OTHER_SESSION, DROP_TOO_OLD, NS_PER_MS
from scan2sim.services.teleoperation.vehicle.adapter_protocol import (
    PACKET_MAX_BYTES,
    AdapterEndpoint,
    Answer,
    OnboardEndpoint,
    Order,
)

LIMIT = 200
GO = Controls(0.5, throttle=1.0, gear=Gear.FORWARD)
KEY = bytes(range(32))
STATE = VehicleState(1.5, (2.0, -3.0), 0.5, Gear.REVERSE, ("a tyre is flat", "it rains"))
ORDER = Order(7, 8, 9, 10, 11.5, Command(GO, 3, agree=True))


class Pair:
    """An onboard unit and an adapter, connected; times are milliseconds of the onboard unit's clock."""

    def __init__(self) -> None:
        self.car, self.adapter = OnboardEndpoint(LIMIT), AdapterEndpoint(LIMIT)
        self.driven, self.stops = False, 0
        self.now = 5000.0

    def send(self, controls: Controls = GO, age: float = 0.0) -> Order:
        return self.car.order(controls if self.driven else STOP, age, self.driven, int(self.now * NS_PER_MS))

    def deliver(self, order: Order, late: float = 0.0) -> bool:
        now = int((self.now + late + 10**6) * NS_PER_MS)  # another clock
        valid = self.adapter.receive(order, now)
        answer = self.adapter.answer(STATE, now)
        if self.car.receive(answer, int((self.now + late) * NS_PER_MS)):
            self.driven, self.stops = False, self.stops + 1
        return valid

    def exchange(self, times: int = 1, controls: Controls = GO, age: float = 0.0) -> None:
        for _ in range(times):
            self.now += 10
            self.deliver(self.send(controls, age))

    def start(self) -> None:
        self.exchange(3)
        self.driven = True
        self.exchange(3)

    def controls_now(self) -> Controls:
        return self.adapter.check(int((self.now + 10**6) * NS_PER_MS))


def test_packets_survive_encoding_with_and_without_key() -> None:
    answer = Answer(2**60, 4, True, "no order", STATE)
    for key in (b"", KEY):
        assert Order.unpack(ORDER.pack(key), key) == ORDER
        assert Answer.unpack(answer.pack(key), key) == answer
        for unpack, packet in ((Order.unpack, answer.pack(key)), (Answer.unpack, ORDER.pack(key))):
            with pytest.raises(Malformed):
                unpack(packet, key)
    for data in (b"", os.urandom(10), os.urandom(len(ORDER.pack())), ORDER.pack()[:-1], ORDER.pack() + b"x"):
        with pytest.raises(Malformed):
            Order.unpack(data)
    for key in (bytes(32), KEY[:-1]):
        with pytest.raises(Malformed):
            Order.unpack(ORDER.pack(key), KEY)
    unknown = Answer(1, 1, True, "no order", VehicleState(None))
    assert Answer.unpack(unknown.pack()) == unknown
    long = Answer(1, 1, True, "no order", VehicleState(faults=("ä" * 5000,)))
    assert len(long.pack(KEY)) <= PACKET_MAX_BYTES and Answer.unpack(long.pack(KEY), KEY).reason == "no order"


def test_vehicle_moves_after_the_driver_has_confirmed_to_the_adapter() -> None:
    pair = Pair()
    pair.exchange(10)
    assert pair.controls_now().brake == 1
    pair.driven = True
    pair.exchange(3)
    assert pair.controls_now() == GO


def test_without_orders_the_adapter_stops_and_then_the_onboard_unit() -> None:
    pair = Pair()
    pair.start()
    pair.now += LIMIT + 15
    assert pair.controls_now().brake == 1
    stops = pair.stops
    pair.exchange(5)
    assert pair.stops == stops + 1 and not pair.driven and pair.controls_now().brake == 1
    pair.exchange(50)
    assert pair.stops == stops + 1  # reported once
    pair.start()
    assert pair.controls_now() == GO


def test_age_of_the_driver_command_counts_in_the_adapter() -> None:
    pair = Pair()
    pair.start()
    pair.exchange(1, age=150)
    pair.now += 45
    assert pair.controls_now() == GO
    pair.now += 10
    assert pair.controls_now().brake == 1


def test_queued_order_is_old() -> None:
    pair = Pair()
    pair.start()
    order, dropped = pair.send(), pair.adapter.safety.dropped
    before = dropped[DROP_TOO_OLD]
    pair.now += LIMIT + 5  # the adapter hung, and reads it now
    assert not pair.deliver(order) and dropped[DROP_TOO_OLD] == before + 1
    assert pair.controls_now().brake == 1


def test_order_of_a_caller_that_took_its_time_before_an_answer_arrived_is_sent() -> None:
    pair = Pair()
    pair.start()
    pair.now += 10
    pair.deliver(pair.send(), late=3)  # a thread that took its time 3 ms earlier waits meanwhile
    order = pair.send()
    assert order.held == 0 and Order.unpack(order.pack()).held == 0


def test_recorded_orders_do_not_move_a_restarted_adapter() -> None:
    pair = Pair()
    pair.start()
    recorded = []
    for _ in range(20):
        pair.now += 10
        recorded.append(pair.send())
        pair.deliver(recorded[-1])
    pair.adapter = AdapterEndpoint(LIMIT)
    for order in recorded:
        assert not pair.deliver(order)
    assert pair.controls_now().brake == 1


def test_restarted_adapter_waits_for_the_driver() -> None:
    pair = Pair()
    pair.start()
    pair.adapter = AdapterEndpoint(LIMIT)
    pair.exchange(40)  # it is heard at once, or after a silence, since its timestamps may seem older
    assert pair.controls_now().brake == 1 and not (pair.driven and pair.car.silent(int(pair.now * NS_PER_MS)))
    pair.driven = False
    pair.start()
    assert pair.controls_now() == GO


def test_second_onboard_unit_is_not_obeyed_while_the_first_is_active() -> None:
    pair = Pair()
    pair.start()
    first, pair.car = pair.car, OnboardEndpoint(LIMIT)
    pair.exchange(3)
    assert pair.controls_now() == GO and pair.adapter.safety.dropped[DROP_OTHER_SESSION] == 3
    pair.car = first
    pair.exchange(1)
    pair.car, pair.driven = OnboardEndpoint(LIMIT), False
    pair.now += LIMIT + 10
    pair.start()
    assert pair.controls_now() == GO


def test_vehicle_never_moves_on_an_old_order_whatever_the_network_does() -> None:
    moved = 0
    for seed in range(100):
        chance, pair = Random(seed), Pair()
        pair.start()
        sent: list[tuple[float, float, Order]] = []
        newest = pair.now
        for _ in range(200):
            pair.now += 10
            if chance.random() < 0.05:
                pair.driven = not pair.driven
            if chance.random() < 0.9:
                age = chance.choice([0.0, 0.0, 20.0, 100.0])
                order = pair.send(age=age)
                sent.append((pair.now + chance.choice([0, 0, 0, 30, 400]), pair.now - age, order))
            for at, created, order in [one for one in sent if one[0] <= pair.now]:
                if pair.deliver(order):
                    newest = max(newest, created)
                    assert pair.now - created <= LIMIT
                if chance.random() < 0.8:
                    sent.remove((at, created, order))
            controls_now = pair.controls_now()
            assert controls_now.brake == 1 or pair.now - newest <= LIMIT
            moved += controls_now.throttle > 0
    assert moved > 1000
