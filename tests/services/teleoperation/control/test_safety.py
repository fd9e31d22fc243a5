"""Whatever becomes of commands on their way, the vehicle keeps the rules of `safety`."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

import pytest

from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command
from scan2sim.services.teleoperation.control.safety import DOUBLE, FUTURE, LATE, MS, OLD, OTHER, Safety

LIMIT, PERIOD = 200, 5
GO = Controls(0.25, throttle=0.5, gear=Gear.FORWARD)
REST = Controls(gear=Gear.FORWARD)


class Drive:
    """A vehicle and its driver; times are milliseconds."""

    def __init__(self) -> None:
        self.safety = Safety(LIMIT)
        self.number = 0
        self.safety.begin("driver")

    def say(self, now: float, command: Command, age: float = 10, session: str = "driver") -> bool:
        self.number += 1
        return self.safety.hear(session, self.number, command, int((now - age) * MS), int(now * MS))

    def start(self, now: float) -> None:
        self.say(now, Command(REST, self.safety.stop))
        self.say(now, Command(REST, self.safety.stop, agree=True))
        assert not self.safety.standing

    def moves(self, now: float) -> bool:
        controls = self.safety.check(int(now * MS))
        assert controls.brake == 1 or not self.safety.standing
        return controls.throttle > 0


@dataclass(frozen=True)
class Sent:
    """A command, and what becomes of it; times are milliseconds.

    Attributes:
        stop: that it names, from the vehicle's last one on.
        delays: one for each time that it arrives; none: it is lost.
    """

    number: int
    driver: int
    made: int
    throttle: float
    stop: int
    agree: bool
    delays: tuple[int, ...]


def a_drive(chance: Random) -> tuple[list[Sent], set[int]]:
    """Commands of two drivers, and moments (ms) at which the vehicle's watchdog hangs."""
    sent, now = [], 0
    for number in range(chance.randint(5, 60)):
        now += chance.choice([5, 20, 20, 20, 20, 50, 250])
        delays = (chance.randint(0, chance.choice([60, 60, 600])) for _ in range(chance.choice([0, 1, 1, 1, 2, 3])))
        driver, stop = chance.choice([0, 0, 0, 0, 1]), chance.choice([0, 0, 0, 0, -1, 1])
        throttle = chance.choice([0.0, 0.0, 0.5])
        sent.append(Sent(number, driver, now, throttle, stop, chance.random() < 0.5, tuple(delays)))
    return sent, {PERIOD * chance.randint(0, now // PERIOD) for _ in range(chance.randint(0, 50))}


def test_whatever_comes_the_vehicle_never_moves_on_what_is_old_and_never_starts_unasked() -> None:
    drove = [keeps_the_rules(*a_drive(Random(seed))) for seed in range(500)]
    assert sum(drove) > 300


def keeps_the_rules(sent: list[Sent], hangs: set[int]) -> bool:
    """Assert it of a drive; whether the vehicle drove at all."""
    safety = Safety(LIMIT)
    safety.begin(0)
    arrivals: list[tuple[int, Sent, Command]] = []
    confirmed: set[int] = set()
    newest, last_made, last = -1, -LIMIT - 1, STOP
    moments = {one.made for one in sent} | {one.made + delay for one in sent for delay in one.delays}
    for now in sorted(moments | set(range(0, max(moments) + LIMIT + 2 * PERIOD, PERIOD))):
        for one in sent:
            if one.made == now:  # a station knows of the vehicle's stop what it was told
                command = Command(Controls(one.number / 100, one.throttle), safety.stop + one.stop, one.agree)
                arrivals += [(now + delay, one, command) for delay in one.delays]
        for at, one, command in arrivals:
            if at != now:
                continue
            stood, stop = safety.standing, safety.stop
            good = safety.hear(one.driver, one.number, command, one.made * MS, now * MS)
            assert good == (one.driver == 0 and one.number > newest and now - one.made <= LIMIT)
            if good:
                newest, last_made, last = one.number, one.made, command.controls
            if stood and not safety.standing:
                assert good and command.agree and command.stop == stop and command.controls.throttle == 0
                assert stop not in confirmed
                confirmed.add(stop)
        if now % PERIOD == 0 and now not in hangs:
            controls = safety.check(now * MS)
            assert safety.standing or now - last_made <= LIMIT
            assert (controls.brake, controls.throttle) == (1, 0) if safety.standing else controls == last
    assert safety.standing
    return bool(confirmed)


def test_it_stops_one_period_after_the_limit_and_not_before() -> None:
    drive = Drive()
    drive.start(0)
    drive.say(20, Command(GO), age=0)
    assert drive.moves(20 + LIMIT)
    assert not drive.moves(20 + LIMIT + PERIOD)
    assert "200 ms" in drive.safety.reason


def test_a_vehicle_that_hung_has_stopped_although_a_fresh_command_comes_first() -> None:
    drive = Drive()
    drive.start(0)
    drive.say(20, Command(GO))
    drive.say(500, Command(GO, drive.safety.stop))
    assert drive.safety.standing


@pytest.mark.parametrize(
    ("commands", "leaves"),
    [
        ([(0, False, REST), (0, True, REST)], True),
        ([(0, True, REST)], False),  # a button that is stuck
        ([(0, True, REST), (0, True, REST)], False),
        ([(0, False, REST), (0, True, GO)], False),
        ([(0, False, REST), (0, True, GO), (0, True, REST)], True),  # the foot comes off
        ([(-1, False, REST), (0, True, REST)], False),  # the driver hasn't seen this one
        ([(0, False, REST), (-1, True, REST)], False),
        ([(0, False, REST), (1, True, REST)], False),
        ([(0, False, REST), (0, False, GO)], False),
    ],
)
def test_a_stop_is_left_when_the_driver_confirms_it(commands: list[tuple[int, bool, Controls]], leaves: bool) -> None:
    drive = Drive()
    drive.start(0)
    drive.moves(1000)
    assert drive.safety.standing
    for number, (stop, agree, controls) in enumerate(commands):
        drive.say(1000 + 20 * number, Command(controls, drive.safety.stop + stop, agree))
    assert drive.safety.standing != leaves


def test_a_confirmation_of_an_earlier_stop_is_none_of_a_later_one() -> None:
    drive = Drive()
    first = drive.safety.stop
    drive.say(0, Command(REST, first))
    drive.safety.halt("the door is open")
    drive.say(20, Command(REST, first, agree=True))
    assert drive.safety.standing and drive.safety.stop == first + 1
    drive.start(40)


def test_a_hindrance_keeps_it_standing() -> None:
    drive = Drive()
    drive.safety.hindrance = "the clocks aren't tied"
    drive.say(0, Command(REST, drive.safety.stop))
    drive.say(20, Command(REST, drive.safety.stop, agree=True))
    assert drive.safety.standing
    drive.safety.hindrance = ""
    drive.say(40, Command(REST, drive.safety.stop, agree=True))
    assert not drive.safety.standing


def test_another_driver_is_obeyed_after_the_takeover_and_the_first_no_longer() -> None:
    drive = Drive()
    drive.start(0)
    assert not drive.say(10, Command(GO), session="other") and drive.safety.command == 2
    drive.safety.begin("other")
    drive.say(20, Command(REST, drive.safety.stop))
    drive.say(20, Command(REST, drive.safety.stop, agree=True))
    assert drive.safety.standing and not drive.moves(20)
    drive.number = 0  # the other station counts for itself
    drive.say(30, Command(REST, drive.safety.stop), session="other")
    drive.say(40, Command(REST, drive.safety.stop, agree=True), session="other")
    assert not drive.safety.standing
    drive.safety.end("released")
    drive.say(50, Command(REST, drive.safety.stop), session="other")
    drive.say(60, Command(REST, drive.safety.stop, agree=True), session="other")
    assert drive.safety.standing and drive.safety.reason == "released"


def test_what_is_dropped_is_counted_by_why() -> None:
    drive = Drive()
    command = Command(REST)
    for number, made in ((5, 1000), (5, 1000), (4, 1000), (6, 799), (7, 1201), (8, 800), (9, 1200)):
        drive.safety.hear("driver", number, command, made * MS, 1000 * MS)
    drive.safety.hear("intruder", 10, command, 1000 * MS, 1000 * MS)
    assert drive.safety.dropped == {DOUBLE: 1, LATE: 1, OLD: 1, FUTURE: 1, OTHER: 1}


def test_a_command_from_the_future_lasts_no_longer_than_one_of_now() -> None:
    drive = Drive()
    drive.start(0)
    drive.say(20, Command(GO), age=-150)
    assert drive.moves(20 + LIMIT) and not drive.moves(20 + LIMIT + PERIOD)


def test_it_brakes_in_the_bend_that_it_was_in_and_stays_seen() -> None:
    drive = Drive()
    drive.start(0)
    drive.say(20, Command(Controls(0.7, 1.0, 0.0, Gear.FORWARD, horn=True, lights=True)))
    controls = drive.safety.check(1000 * MS)
    assert controls == Controls(0.7, 0.0, 1.0, Gear.NEUTRAL, horn=False, lights=True)
