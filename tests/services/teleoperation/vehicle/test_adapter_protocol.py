"""Car unit and translator each stop the vehicle when the other is gone, and start it only together."""

from __future__ import annotations

import os
from random import Random

import pytest

from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import Command, Malformed
from scan2sim.services.teleoperation.control.safety import MS, OLD, OTHER
from scan2sim.services.teleoperation.vehicle.adapter_protocol import LARGEST, Answer, CarEnd, Order, TranslatorEnd

LIMIT = 200
GO = Controls(0.5, throttle=1.0, gear=Gear.FORWARD)
KEY = bytes(range(32))
STATE = VehicleState(1.5, (2.0, -3.0), 0.5, Gear.REVERSE, ("a tyre is flat", "it rains"))
ORDER = Order(7, 8, 9, 10, 11.5, Command(GO, 3, agree=True))


class Pair:
    """A car unit and a translator on a wire; times are milliseconds of the car unit's clock."""

    def __init__(self) -> None:
        self.car, self.translator = CarEnd(LIMIT), TranslatorEnd(LIMIT)
        self.driven, self.stops = False, 0
        self.now = 5000.0

    def send(self, controls: Controls = GO, age: float = 0.0) -> Order:
        return self.car.order(controls if self.driven else STOP, age, self.driven, int(self.now * MS))

    def deliver(self, order: Order, late: float = 0.0) -> bool:
        now = int((self.now + late + 10**6) * MS)  # another clock
        good = self.translator.hear(order, now)
        answer = self.translator.answer(STATE, now)
        if self.car.hear(answer, int((self.now + late) * MS)):
            self.driven, self.stops = False, self.stops + 1
        return good

    def exchange(self, times: int = 1, controls: Controls = GO, age: float = 0.0) -> None:
        for _ in range(times):
            self.now += 10
            self.deliver(self.send(controls, age))

    def start(self) -> None:
        self.exchange(3)
        self.driven = True
        self.exchange(3)

    def doing(self) -> Controls:
        return self.translator.check(int((self.now + 10**6) * MS))


def test_what_is_said_is_understood_with_and_without_key() -> None:
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
    long = Answer(1, 1, True, "no order", VehicleState(faults=("ä" * 5000,)))
    assert len(long.pack(KEY)) <= LARGEST and Answer.unpack(long.pack(KEY), KEY).reason == "no order"


def test_the_vehicle_moves_once_the_driver_has_confirmed_and_the_translator_knows() -> None:
    pair = Pair()
    pair.exchange(10)
    assert pair.doing().brake == 1
    pair.driven = True
    pair.exchange(3)
    assert pair.doing() == GO


def test_without_orders_the_translator_stops_and_tells_the_car_unit_which_stops_too() -> None:
    pair = Pair()
    pair.start()
    pair.now += LIMIT + 15
    assert pair.doing().brake == 1
    stops = pair.stops
    pair.exchange(5)
    assert pair.stops == stops + 1 and not pair.driven and pair.doing().brake == 1
    pair.exchange(50)
    assert pair.stops == stops + 1  # told once
    pair.start()
    assert pair.doing() == GO


def test_a_driver_s_command_that_is_old_in_the_car_unit_is_old_in_the_translator() -> None:
    pair = Pair()
    pair.start()
    pair.exchange(1, age=150)
    pair.now += 45
    assert pair.doing() == GO
    pair.now += 10
    assert pair.doing().brake == 1


def test_an_order_that_lay_in_a_queue_is_old() -> None:
    pair = Pair()
    pair.start()
    order, dropped = pair.send(), pair.translator.safety.dropped
    before = dropped[OLD]
    pair.now += LIMIT + 5  # the translator hung, and reads it now
    assert not pair.deliver(order) and dropped[OLD] == before + 1
    assert pair.doing().brake == 1


def test_recorded_orders_do_not_move_a_translator_that_was_started_anew() -> None:
    pair = Pair()
    pair.start()
    recorded = []
    for _ in range(20):
        pair.now += 10
        recorded.append(pair.send())
        pair.deliver(recorded[-1])
    pair.translator = TranslatorEnd(LIMIT)
    for order in recorded:
        assert not pair.deliver(order)
    assert pair.doing().brake == 1


def test_a_translator_started_anew_waits_for_the_driver() -> None:
    pair = Pair()
    pair.start()
    pair.translator = TranslatorEnd(LIMIT)
    pair.exchange(40)  # it is heard at once, or after silence, as its stamps may seem older
    assert pair.doing().brake == 1 and not (pair.driven and pair.car.silent(int(pair.now * MS)))
    pair.driven = False
    pair.start()
    assert pair.doing() == GO


def test_a_second_car_unit_is_not_obeyed_while_the_first_speaks() -> None:
    pair = Pair()
    pair.start()
    first, pair.car = pair.car, CarEnd(LIMIT)
    pair.exchange(3)
    assert pair.doing() == GO and pair.translator.safety.dropped[OTHER] == 3
    pair.car = first
    pair.exchange(1)
    pair.car, pair.driven = CarEnd(LIMIT), False
    pair.now += LIMIT + 10
    pair.start()
    assert pair.doing() == GO


def test_whatever_is_lost_late_or_twice_on_the_wire_the_vehicle_never_moves_on_what_is_old() -> None:
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
            for at, made, order in [one for one in sent if one[0] <= pair.now]:
                if pair.deliver(order):
                    newest = max(newest, made)
                    assert pair.now - made <= LIMIT
                if chance.random() < 0.8:
                    sent.remove((at, made, order))
            doing = pair.doing()
            assert doing.brake == 1 or pair.now - newest <= LIMIT
            moved += doing.throttle > 0
    assert moved > 1000
