"""The vehicle keeps the safety rules, whatever happens to commands on their way."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

import pytest

from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command
from scan2sim.services.teleoperation.control.safety import (
    DROP_DUPLICATE,
    DROP_FROM_FUTURE,
    DROP_OTHER_SESSION,
    DROP_OUT_OF_ORDER,
    DROP_TOO_OLD,
    EMERGENCY_STOP,
    NS_PER_MS,
    SafetyMonitor,
)

LIMIT, PERIOD = 200, 5
GO = Controls(0.25, throttle=0.5, gear=Gear.FORWARD)
REST = Controls(gear=Gear.FORWARD)


class Drive:
    """A vehicle's safety monitor and its driver; times are milliseconds."""

    def __init__(self) -> None:
        self.safety = SafetyMonitor(LIMIT)
        self.number = 0
        self.safety.begin("driver")

    def send(self, now: float, command: Command, age: float = 10, session: str = "driver") -> bool:
        self.number += 1
        return self.safety.receive(session, self.number, command, int((now - age) * NS_PER_MS), int(now * NS_PER_MS))

    def start(self, now: float) -> None:
        self.send(now, Command(REST, self.safety.stop))
        self.send(now, Command(REST, self.safety.stop, agree=True))
        assert not self.safety.standing

    def moves(self, now: float) -> bool:
        controls = self.safety.check(int(now * NS_PER_MS))
        assert controls.brake == 1 or not self.safety.standing
        return controls.throttle > 0


@dataclass(frozen=True)
class Sent:
    """A command and how it arrives; times are milliseconds.

    Attributes:
        stop: stop that it names, relative to the vehicle's last one.
        delays: one for each arrival; empty: it is lost.
    """

    number: int
    driver: int
    created: int
    throttle: float
    stop: int
    agree: bool
    delays: tuple[int, ...]


def random_drive(chance: Random) -> tuple[list[Sent], set[int]]:
    """Commands of two drivers, and times (ms) at which the vehicle's watchdog hangs."""
    sent, now = [], 0
    for number in range(chance.randint(5, 60)):
        now += chance.choice([5, 20, 20, 20, 20, 50, 250])
        delays = (chance.randint(0, chance.choice([60, 60, 600])) for _ in range(chance.choice([0, 1, 1, 1, 2, 3])))
        driver, stop = chance.choice([0, 0, 0, 0, 1]), chance.choice([0, 0, 0, 0, -1, 1])
        throttle = chance.choice([0.0, 0.0, 0.5])
        sent.append(Sent(number, driver, now, throttle, stop, chance.random() < 0.5, tuple(delays)))
    return sent, {PERIOD * chance.randint(0, now // PERIOD) for _ in range(chance.randint(0, 50))}


def test_vehicle_never_moves_on_an_old_command_and_never_starts_unconfirmed() -> None:
    drove = [keeps_the_rules(*random_drive(Random(seed))) for seed in range(500)]
    assert sum(drove) > 300


def keeps_the_rules(sent: list[Sent], hangs: set[int]) -> bool:
    """Check the rules for one drive; returns whether the vehicle drove at all."""
    safety = SafetyMonitor(LIMIT)
    safety.begin(0)
    arrivals: list[tuple[int, Sent, Command]] = []
    confirmed: set[int] = set()
    newest, last_created, last = -1, -LIMIT - 1, STOP
    moments = {one.created for one in sent} | {one.created + delay for one in sent for delay in one.delays}
    for now in sorted(moments | set(range(0, max(moments) + LIMIT + 2 * PERIOD, PERIOD))):
        for one in sent:
            if one.created == now:  # a station knows the vehicle's stop from telemetry
                command = Command(Controls(one.number / 100, one.throttle), safety.stop + one.stop, one.agree)
                arrivals += [(now + delay, one, command) for delay in one.delays]
        for at, one, command in arrivals:
            if at != now:
                continue
            was_standing, stop = safety.standing, safety.stop
            valid = safety.receive(one.driver, one.number, command, one.created * NS_PER_MS, now * NS_PER_MS)
            assert valid == (one.driver == 0 and one.number > newest and now - one.created <= LIMIT)
            if valid:
                newest, last_created, last = one.number, one.created, command.controls
            if was_standing and not safety.standing:
                assert valid and command.agree and command.stop == stop and command.controls.throttle == 0
                assert stop not in confirmed
                confirmed.add(stop)
        if now % PERIOD == 0 and now not in hangs:
            controls = safety.check(now * NS_PER_MS)
            assert safety.standing or now - last_created <= LIMIT
            assert (controls.brake, controls.throttle) == (1, 0) if safety.standing else controls == last
    assert safety.standing
    return bool(confirmed)


def test_stops_one_period_after_the_limit_and_not_before() -> None:
    drive = Drive()
    drive.start(0)
    drive.send(20, Command(GO), age=0)
    assert drive.moves(20 + LIMIT)
    assert not drive.moves(20 + LIMIT + PERIOD)
    assert "200 ms" in drive.safety.reason


def test_vehicle_that_hung_has_stopped_even_if_a_fresh_command_arrives_first() -> None:
    drive = Drive()
    drive.start(0)
    drive.send(20, Command(GO))
    drive.send(500, Command(GO, drive.safety.stop))
    assert drive.safety.standing


@pytest.mark.parametrize(
    ("commands", "leaves"),
    [
        ([(0, False, REST), (0, True, REST)], True),
        ([(0, True, REST)], False),  # a button that is stuck
        ([(0, True, REST), (0, True, REST)], False),
        ([(0, False, REST), (0, True, GO)], False),
        ([(0, False, REST), (0, True, GO), (0, True, REST)], True),  # the throttle is released
        ([(-1, False, REST), (0, True, REST)], False),  # the driver hasn't seen this one
        ([(0, False, REST), (-1, True, REST)], False),
        ([(0, False, REST), (1, True, REST)], False),
        ([(0, False, REST), (0, False, GO)], False),
    ],
)
def test_stop_is_left_when_the_driver_confirms_it(commands: list[tuple[int, bool, Controls]], leaves: bool) -> None:
    drive = Drive()
    drive.start(0)
    drive.moves(1000)
    assert drive.safety.standing
    for number, (stop, agree, controls) in enumerate(commands):
        drive.send(1000 + 20 * number, Command(controls, drive.safety.stop + stop, agree))
    assert drive.safety.standing != leaves


def test_confirmation_of_an_earlier_stop_does_not_confirm_a_later_one() -> None:
    drive = Drive()
    first = drive.safety.stop
    drive.send(0, Command(REST, first))
    drive.safety.halt("the door is open")
    drive.send(20, Command(REST, first, agree=True))
    assert drive.safety.standing and drive.safety.stop == first + 1
    drive.start(40)


def test_blocked_vehicle_stays_stopped() -> None:
    drive = Drive()
    drive.safety.blocked_by = "the clocks are not synchronized"
    drive.send(0, Command(REST, drive.safety.stop))
    drive.send(20, Command(REST, drive.safety.stop, agree=True))
    assert drive.safety.standing
    drive.safety.blocked_by = ""
    drive.send(40, Command(REST, drive.safety.stop, agree=True))
    assert not drive.safety.standing


def test_takeover_obeys_the_new_driver_only() -> None:
    drive = Drive()
    drive.start(0)
    assert not drive.send(10, Command(GO), session="other") and drive.safety.command == 2
    drive.safety.begin("other")
    drive.send(20, Command(REST, drive.safety.stop))
    drive.send(20, Command(REST, drive.safety.stop, agree=True))
    assert drive.safety.standing and not drive.moves(20)
    drive.number = 0  # the other station counts for itself
    drive.send(30, Command(REST, drive.safety.stop), session="other")
    drive.send(40, Command(REST, drive.safety.stop, agree=True), session="other")
    assert not drive.safety.standing
    drive.safety.end("released")
    drive.send(50, Command(REST, drive.safety.stop), session="other")
    drive.send(60, Command(REST, drive.safety.stop, agree=True), session="other")
    assert drive.safety.standing and drive.safety.reason == "released"


def test_dropped_messages_are_counted_by_reason() -> None:
    drive = Drive()
    command = Command(REST)
    for number, created in ((5, 1000), (5, 1000), (4, 1000), (6, 799), (7, 1201), (8, 800), (9, 1200)):
        drive.safety.receive("driver", number, command, created * NS_PER_MS, 1000 * NS_PER_MS)
    drive.safety.receive("intruder", 10, command, 1000 * NS_PER_MS, 1000 * NS_PER_MS)
    assert drive.safety.dropped == {
        DROP_DUPLICATE: 1,
        DROP_OUT_OF_ORDER: 1,
        DROP_TOO_OLD: 1,
        DROP_FROM_FUTURE: 1,
        DROP_OTHER_SESSION: 1,
    }


def test_command_from_the_future_is_not_valid_for_longer() -> None:
    drive = Drive()
    drive.start(0)
    drive.send(20, Command(GO), age=-150)
    assert drive.moves(20 + LIMIT) and not drive.moves(20 + LIMIT + PERIOD)


def test_stop_keeps_steering_and_lights() -> None:
    drive = Drive()
    drive.start(0)
    drive.send(20, Command(Controls(0.7, 1.0, 0.0, Gear.FORWARD, horn=True, lights=True)))
    controls = drive.safety.check(1000 * NS_PER_MS)
    assert controls == Controls(0.7, 0.0, 1.0, Gear.NEUTRAL, horn=False, lights=True)


def test_emergency_command_stops_until_confirmed() -> None:
    monitor = SafetyMonitor(200)
    monitor.begin("s")
    drive = Controls(throttle=0.5, gear=Gear.FORWARD)
    monitor.receive("s", 1, Command(Controls(), monitor.stop), 0, 0)
    monitor.receive("s", 2, Command(Controls(), monitor.stop, agree=True), 0, 0)
    monitor.receive("s", 3, Command(drive), 0, 0)
    assert not monitor.standing and monitor.check(0) == drive
    monitor.receive("s", 4, Command(drive, monitor.stop, agree=True, emergency=True), 0, 0)
    assert monitor.standing and monitor.reason == EMERGENCY_STOP and monitor.check(0).brake == 1
    monitor.receive("s", 5, Command(drive, monitor.stop), 0, 0)
    monitor.receive("s", 6, Command(Controls(), monitor.stop, agree=True, emergency=True), 0, 0)
    assert monitor.standing, "no emergency command confirms"
    monitor.receive("s", 7, Command(Controls(), monitor.stop, agree=True), 0, 0)
    assert not monitor.standing
