"""Events: kinds of one's own, checked; what is attached to them is done once."""

from __future__ import annotations

import logging

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.events.schema import Alarm, Body, Event, Events


class Count(Body):
    vehicles: int


def fail(_: object) -> None:
    raise OSError("no disk")


class Wire:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def send(self, told: Event) -> None:
        self.lines.append(told.json_line())

    def close(self) -> None:
        pass


def joined() -> tuple[Events, Wire, Events]:
    """A sender, what it sent, and another program; both know of counts."""
    sender, other, wire = Events("counter"), Events("other"), Wire()
    sender.outlets.append(wire)
    for one in (sender, other):
        one.define("count", Count)
    return sender, wire, other


def test_what_is_attached_to_a_kind_is_done_once_here_and_there() -> None:
    sender, wire, other = joined()
    here: list[Count] = []
    there: list[Count] = []
    sender.on("count", here.append)
    other.on("count", there.append)
    sender.send("count", Count(vehicles=3))
    for _ in range(2):  # over ROS 2 and over Kafka
        sender.take(wire.lines[0])
        other.take(wire.lines[0].encode())
    assert here == there == [Count(vehicles=3)]


def test_what_is_not_of_a_schema_is_left(caplog: pytest.LogCaptureFixture) -> None:
    sender, wire, other = joined()
    got: list[Count] = []
    other.on("count", got.append)
    sender.send("count", Count(vehicles=3))
    caplog.set_level(logging.WARNING)
    wrong = (wire.lines[0].replace('"vehicles":3', '"vehicles":"many"'), "{", "3", '{"schema": "scan2sim-event-1"}')
    for line in wrong:
        other.take(line)
    assert got == [] and other.malformed == len(wrong) and len(caplog.records) == 1
    other.take(wire.lines[0].replace('"count"', '"unheard of"'))
    assert other.malformed == len(wrong)  # another program's


def test_an_action_that_fails_keeps_no_other_from_its_own() -> None:
    sender, _, _ = joined()
    got: list[Alarm] = []
    sender.on("alarm", fail)
    sender.on("alarm", got.append)
    alarm = Alarm(state="raised", rule="r", subject="s", value=1.0, since=0.0)
    sender.send("alarm", alarm)
    assert got == [alarm]


def test_kinds_are_defined_once() -> None:
    sender, _, _ = joined()
    sender.define("count", Count)
    for wrong in (lambda: sender.define("count", Alarm), lambda: sender.define("record", Count),
                  lambda: sender.on("counts", print), lambda: sender.send("alarm", Count(vehicles=1))):  # fmt: skip
        with pytest.raises(SettingError):
            wrong()
