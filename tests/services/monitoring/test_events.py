"""Events: custom kinds, validation, deduplicated callbacks."""

from __future__ import annotations

import logging

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.events.schema import Alarm, Body, Event, Events


class Count(Body):
    vehicles: int


def fail(_: object) -> None:
    raise OSError("no disk")


class RecordingOutlet:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def send(self, event: Event) -> None:
        self.lines.append(event.json_line())

    def close(self) -> None:
        pass


def connected() -> tuple[Events, RecordingOutlet, Events]:
    """A sender, its outlet, and another program; both define the kind "count"."""
    sender, other, outlet = Events("counter"), Events("other"), RecordingOutlet()
    sender.outlets.append(outlet)
    for one in (sender, other):
        one.define("count", Count)
    return sender, outlet, other


def test_callbacks_are_called_once_per_event_in_every_program() -> None:
    sender, outlet, other = connected()
    here: list[Count] = []
    there: list[Count] = []
    sender.on("count", here.append)
    other.on("count", there.append)
    sender.send("count", Count(vehicles=3))
    for _ in range(2):  # once over ROS 2, once over Kafka
        sender.receive(outlet.lines[0])
        other.receive(outlet.lines[0].encode())
    assert here == there == [Count(vehicles=3)]


def test_events_that_violate_their_schema_are_ignored(caplog: pytest.LogCaptureFixture) -> None:
    sender, outlet, other = connected()
    got: list[Count] = []
    other.on("count", got.append)
    sender.send("count", Count(vehicles=3))
    caplog.set_level(logging.WARNING)
    wrong = (outlet.lines[0].replace('"vehicles":3', '"vehicles":"many"'), "{", "3", '{"schema": "scan2sim-event-1"}')
    for line in wrong:
        other.receive(line)
    assert got == [] and other.rejections.counts.total() == len(wrong) and len(caplog.records) == 1
    other.receive(outlet.lines[0].replace('"count"', '"unheard of"'))
    assert other.rejections.counts.total() == len(wrong)  # a kind of another program isn't malformed


def test_failing_callback_does_not_prevent_others() -> None:
    sender, _, _ = connected()
    got: list[Alarm] = []
    sender.on("alarm", fail)
    sender.on("alarm", got.append)
    alarm = Alarm(state="raised", rule="r", subject="s", value=1.0, since=0.0)
    sender.send("alarm", alarm)
    assert got == [alarm]


def test_redefined_unknown_and_mismatched_kinds_are_rejected() -> None:
    sender, _, _ = connected()
    sender.define("count", Count)
    for wrong in (lambda: sender.define("count", Alarm), lambda: sender.define("record", Count),
                  lambda: sender.on("counts", print), lambda: sender.send("alarm", Count(vehicles=1))):  # fmt: skip
        with pytest.raises(SettingError):
            wrong()
