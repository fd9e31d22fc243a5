"""The car unit obeys the station that it is joined to, tells what is wrong, and stands when anything is."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.control.messages import (
    Command,
    Kind,
    Lacking,
    Message,
    Report,
    Stream,
    Streams,
    Telemetry,
    Wanted,
)
from scan2sim.services.teleoperation.control.safety import MS, OTHER
from scan2sim.services.teleoperation.vehicle.adapter import TranslateParams, Translating
from scan2sim.services.teleoperation.vehicle.adapter_protocol import Answer
from scan2sim.services.teleoperation.vehicle.adapters import Unreachable
from scan2sim.services.teleoperation.vehicle.onboard_unit import (
    MALFORMED,
    NOBODY,
    ROOM,
    SILENT,
    UNTIED,
    Car,
    CarParams,
    CarUnit,
    fitting,
)

LIMIT = 200
GO = Controls(0.5, throttle=1.0, gear=Gear.FORWARD)
REST = Controls(gear=Gear.FORWARD)


@dataclass
class FakeClocks:
    """The station's clock is the vehicle's."""

    known: bool = True
    uncertainty_ms: float = 5.0
    wall_apart_s: float = 0.0
    now: Callable[[], int] = time.monotonic_ns

    @property
    def wall_wrong(self) -> bool:
        return abs(self.wall_apart_s) > 1

    def age_ms(self, sent: int) -> float:
        return (self.now() - sent) / MS if self.known else math.inf


@dataclass
class FakeBundle:
    clocks: FakeClocks = field(default_factory=FakeClocks)
    sent: list[tuple[Kind, bytes]] = field(default_factory=list)
    closed: bool = False

    def send(self, kind: Kind, body: bytes) -> int:
        self.sent.append((kind, body))
        return len(self.sent)

    def close(self) -> None:
        self.closed = True

    def telemetry(self) -> Telemetry:
        return next(Telemetry.unpack(body) for kind, body in reversed(self.sent) if kind == Kind.TELEMETRY)


@dataclass
class FakeCamera:
    stream: Stream
    fault: str = ""
    keys: int = 0
    reports: list[Report] = field(default_factory=list)
    again: list[tuple[int, ...]] = field(default_factory=list)

    def want_key(self) -> None:
        self.keys += 1

    def send_again(self, source: int, sequences: Sequence[int]) -> None:
        self.again.append((source, *sequences))

    def adapt(self, report: Report) -> None:
        self.reports.append(report)


class Desk:
    """A car with a station and a translator in step; times are milliseconds."""

    def __init__(self) -> None:
        self.car, self.now, self.number = Car(LIMIT), 1000, 0
        self.bundle = FakeBundle(FakeClocks(now=lambda: self.now * MS))
        self.answer = Answer(0, 1, False, "", VehicleState(2.0))
        self.session = object()
        self.car.join(self.session, self.bundle, ())

    def say(self, command: Command, age: float = 10, session: object = None) -> None:
        self.number += 1
        message = Message(Kind.COMMAND, self.number, int((self.now - age) * MS), command.pack())
        self.car.hear(session or self.session, message, self.now * MS)

    def look(self, answered: bool = True) -> Command:
        self.now += 5
        self.car.doubt()
        if answered:
            self.answer = Answer(
                self.now, self.answer.stop, self.answer.standing, self.answer.reason, VehicleState(2.0)
            )
            self.car.answered(self.answer, self.now * MS)
        return self.car.look(self.now * MS).command

    def telemetry(self) -> Telemetry:
        return self.car.telemetry(self.now * MS)

    def start(self, session: object = None) -> None:
        self.look()
        stop = self.car.safety.stop
        self.say(Command(REST, stop), session=session)
        self.say(Command(REST, stop, agree=True), session=session)


def test_a_driver_is_obeyed_once_everything_is_well() -> None:
    desk = Desk()
    assert desk.look().controls.brake == 1
    desk.start()
    desk.say(Command(GO))
    assert desk.look().controls == GO
    told = desk.telemetry()
    assert (told.standing, told.command, told.age, told.vehicle.speed) == (False, desk.number, 10.0, 2.0)
    desk.now += LIMIT
    assert desk.look().controls.brake == 1
    assert desk.telemetry().standing and "200 ms" in desk.telemetry().reason


@pytest.mark.parametrize(
    ("clocks", "why"),
    [
        ({"known": False}, UNTIED),
        ({"uncertainty_ms": LIMIT + 1.0}, "known to 201 ms only"),
        ({"wall_apart_s": -10.0}, "10 s apart: does NTP run"),
    ],
)
def test_driving_does_not_begin_with_clocks_that_are_wrong(clocks: dict[str, Any], why: str) -> None:
    desk = Desk()
    vars(desk.bundle.clocks).update(clocks)
    desk.start()
    assert desk.look().controls.brake == 1 and desk.telemetry().standing
    assert why in desk.telemetry().reason
    assert UNTIED not in desk.telemetry().dropped or desk.telemetry().dropped[UNTIED] == 2
    vars(desk.bundle.clocks).update(vars(FakeClocks(now=desk.bundle.clocks.now)))
    desk.look()
    desk.start()
    assert not desk.telemetry().standing


def test_what_was_known_of_one_station_s_clock_says_nothing_of_another_s() -> None:
    desk = Desk()
    desk.start()
    other = object()
    desk.car.join(other, FakeBundle(FakeClocks(known=False)), ())
    stop = desk.car.safety.stop
    desk.car.look(desk.now * MS)
    desk.say(Command(REST, stop), session=other)
    desk.say(Command(REST, stop, agree=True), session=other)
    assert desk.telemetry().standing


def test_a_station_that_was_started_anew_is_heard_and_its_driver_confirms_again() -> None:
    desk = Desk()
    desk.start()
    desk.say(Command(GO))
    desk.number = 0
    desk.car.began(object())
    assert desk.look().controls == GO
    desk.car.began(desk.session)
    desk.say(Command(GO, desk.car.safety.stop))
    assert desk.look().controls.brake == 1
    desk.start()
    desk.say(Command(GO))
    assert desk.look().controls == GO


def test_a_station_that_is_not_joined_does_not_drive() -> None:
    desk = Desk()
    desk.start()
    other = object()
    desk.say(Command(GO), session=other)
    assert desk.look().controls == REST and desk.telemetry().dropped == {OTHER: 1}
    desk.car.join(other, desk.bundle, ())
    assert desk.look().controls.brake == 1
    desk.start()
    assert desk.telemetry().standing
    desk.start(other)
    desk.say(Command(GO), session=other)
    assert desk.look().controls == GO
    desk.car.release("the driver has let go")
    desk.start(other)
    assert desk.look().controls.brake == 1
    assert desk.telemetry().reason == f"the driver has let go; {NOBODY}"


def test_a_translator_that_is_gone_or_has_stopped_is_a_stop_that_the_driver_confirms() -> None:
    desk = Desk()
    desk.start()
    for _ in range(LIMIT // 5 + 1):
        desk.say(Command(GO))
        desk.look(answered=False)
    told = desk.telemetry()
    assert told.standing and told.reason == SILENT and told.vehicle.faults == (SILENT,)
    stop = told.stop
    desk.say(Command(REST, stop))
    desk.say(Command(REST, stop, agree=True))  # too soon
    desk.look(answered=False)
    assert desk.telemetry().standing
    desk.start()
    assert not desk.telemetry().standing
    desk.answer = Answer(0, 2, True, "the plug is out", VehicleState())
    desk.say(Command(GO))
    assert desk.look().controls.brake == 1
    assert desk.telemetry().reason == "the translator stopped: the plug is out"
    assert not desk.look().agree
    desk.start()
    desk.say(Command(GO))
    agreed = desk.look()
    assert agreed.agree and agreed.stop == 2 and agreed.controls.throttle == 0
    desk.answer = Answer(0, 2, False, "", VehicleState())
    assert desk.look().controls == GO


def test_cameras_hear_what_is_theirs_and_their_faults_are_told() -> None:
    desk = Desk()
    cameras = [FakeCamera(Stream(0, "front", 640, 480, 30.0)), FakeCamera(Stream(1, "back", 0, 0, 0.0), "unplugged")]
    desk.car.join(desk.session, desk.bundle, cameras)
    desk.look()
    report = Report(1, 10, 0, 20.0, {})
    for kind, body in (
        (Kind.WANTED, Wanted(0).pack()),
        (Kind.WANTED, Wanted(9).pack()),
        (Kind.REPORT, report.pack()),
        (Kind.LACKING, Lacking(7 << 8 | 1, (5, 65_535)).pack()),
    ):
        desk.car.hear(desk.session, Message(kind, 1, 0, body), 0)
    desk.car.hear(object(), Message(Kind.WANTED, 1, 0, Wanted(0).pack()), 0)
    assert (cameras[0].keys, cameras[1].reports) == (1, [report])
    assert (cameras[0].again, cameras[1].again) == ([], [(7 << 8 | 1, 5, 65_535)])
    assert desk.telemetry().vehicle.faults == ("the camera back: unplugged",)
    assert desk.car.streams() == Streams((cameras[0].stream, cameras[1].stream))


def test_what_is_no_message_is_counted() -> None:
    desk = Desk()
    for kind in (Kind.COMMAND, Kind.WANTED, Kind.REPORT, Kind.LACKING):
        desk.car.hear(desk.session, Message(kind, 1, 0, b"rubbish"), 0)
    assert desk.telemetry().dropped == {MALFORMED: 4}


def test_a_telemetry_fits_into_a_packet_however_many_faults_there_are() -> None:
    many = Telemetry(VehicleState(faults=tuple("ä" * 50 for _ in range(50))), 1, True, "x" * 200, 1, 1.0, {"old": 1})
    body = fitting(many)
    assert len(body) <= ROOM and Telemetry.unpack(body).vehicle.faults


def test_no_address_is_told() -> None:
    for wrong in ("localhost", "localhost:", ":x", "host:70000"):
        with pytest.raises(SettingError, match="translator"):
            CarParams(translator=wrong).address()


class Vehicle:
    def __init__(self) -> None:
        self.controls: list[Controls] = []
        self.unreachable = False

    def obey(self, controls: Controls) -> None:
        if self.unreachable:
            raise Unreachable("the plug is out")
        self.controls.append(controls)

    def state(self) -> VehicleState:
        return VehicleState(3.0)

    def close(self) -> None:
        pass


class Station:
    """A driver at work, fifty commands a second."""

    def __init__(self, bundle: FakeBundle, received: Callable[[Message], None]) -> None:
        self.bundle, self.received = bundle, received
        self.controls, self.agree, self.number, self.ended = REST, False, 0, threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        while not self.ended.wait(0.02):
            told = self.bundle.telemetry() if any(kind == Kind.TELEMETRY for kind, _ in self.bundle.sent) else None
            self.number += 1
            command = Command(self.controls, told.stop if told else 0, self.agree)
            self.received(Message(Kind.COMMAND, self.number, time.monotonic_ns(), command.pack()))

    def until(self, what: Callable[[], bool]) -> None:
        end = time.monotonic() + 20
        while not what():
            assert time.monotonic() < end, self.bundle.telemetry()
            time.sleep(0.005)

    def start(self) -> None:
        """As drivers do: foot off, press the button until it drives, foot down."""
        self.controls, self.agree = REST, False
        time.sleep(0.15)
        self.agree = True
        self.until(lambda: not self.bundle.telemetry().standing)
        self.controls, self.agree = GO, False


@pytest.fixture
def at_work() -> Iterator[tuple[Vehicle, CarUnit, Station, FakeBundle, threading.Event]]:
    """A vehicle, its translator, its car unit and a station."""
    vehicle, ended, bundle = Vehicle(), threading.Event(), FakeBundle()
    translating = Translating(vehicle, TranslateParams(port=0, limit=LIMIT))
    translator = threading.Thread(target=translating.run, args=(ended,))
    translator.start()
    unit = CarUnit(CarParams(translator=f"127.0.0.1:{translating.address[1]}", limit=LIMIT))
    stations: list[Station] = []

    def dial(received: Callable[[Message], None], began: Callable[[], None]) -> FakeBundle:
        began()
        stations.append(Station(bundle, received))
        return bundle

    unit.join(dial)
    yield vehicle, unit, stations[0], bundle, ended
    stations[0].ended.set()
    stations[0].thread.join()
    unit.close()
    ended.set()
    translator.join()
    assert unit.failed is None and bundle.closed


def test_from_the_driver_to_the_vehicle_and_back(
    at_work: tuple[Vehicle, CarUnit, Station, FakeBundle, threading.Event],
) -> None:
    vehicle, _, station, bundle, ended = at_work
    station.start()
    station.until(lambda: vehicle.controls[-1] == GO)
    assert bundle.telemetry().vehicle.speed == 3.0 and any(kind == Kind.STREAMS for kind, _ in bundle.sent)

    station.ended.set()  # the links are cut
    station.thread.join()
    cut = time.monotonic()
    station.until(lambda: vehicle.controls[-1].brake == 1)
    assert time.monotonic() - cut < LIMIT / 1000 + 0.1
    station.until(lambda: bundle.telemetry().standing)

    again = Station(bundle, station.received)
    again.number, again.controls = station.number, GO
    time.sleep(0.2)
    assert vehicle.controls[-1].brake == 1  # not before the driver confirms
    again.start()
    again.until(lambda: vehicle.controls[-1] == GO)

    vehicle.unreachable = True
    again.until(lambda: "the plug is out" in bundle.telemetry().reason)
    vehicle.unreachable = False
    time.sleep(0.1)
    assert vehicle.controls[-1].brake == 1
    again.start()
    again.until(lambda: vehicle.controls[-1] == GO)

    ended.set()  # the translator ends
    again.until(lambda: bundle.telemetry().reason == SILENT)
    assert vehicle.controls[-1].brake == 1
    again.ended.set()
    again.thread.join()


def test_a_release_has_the_vehicle_stand_at_once(
    at_work: tuple[Vehicle, CarUnit, Station, FakeBundle, threading.Event],
) -> None:
    vehicle, unit, station, bundle, _ = at_work
    station.start()
    station.until(lambda: vehicle.controls[-1] == GO)
    unit.release("taken back")
    assert bundle.closed
    station.until(lambda: vehicle.controls[-1].brake == 1)
    station.agree = True
    time.sleep(0.2)
    assert vehicle.controls[-1].brake == 1


def test_a_watchdog_that_fails_is_noticed_and_the_vehicle_stands(
    at_work: tuple[Vehicle, CarUnit, Station, FakeBundle, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle, unit, station, _, _ = at_work
    station.start()
    station.until(lambda: vehicle.controls[-1] == GO)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)

    def failing(now: int) -> Any:
        raise RuntimeError("a bug")

    monkeypatch.setattr(unit.car, "look", failing)
    station.until(lambda: vehicle.controls[-1].brake == 1)
    assert isinstance(unit.failed, RuntimeError)
    unit.failed = None
