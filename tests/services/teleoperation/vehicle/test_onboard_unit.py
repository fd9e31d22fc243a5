"""The onboard unit obeys the joined station, reports faults, and stops the vehicle if anything fails."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.teleoperation.control.controls import VehicleState
from scan2sim.services.teleoperation.control.messages import (
    Command,
    CongestionReport,
    KeyFrameRequest,
    Kind,
    Message,
    Nack,
    Telemetry,
    VideoReport,
    VideoStream,
    VideoStreams,
)
from scan2sim.services.teleoperation.control.safety import DROP_OTHER_SESSION, NS_PER_MS
from scan2sim.services.teleoperation.settings import OnboardParams
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from scan2sim.services.teleoperation.vehicle.adapter_protocol import Answer
from scan2sim.services.teleoperation.vehicle.onboard_unit import (
    ADAPTER_SILENT,
    BODY_MAX_BYTES,
    CLOCKS_UNKNOWN,
    DROP_CLOCKS_UNKNOWN,
    MALFORMED,
    NO_STATION,
    OnboardController,
    OnboardUnit,
    pack_fitting,
)
from tests.fakes.driver import GO, REST, FakeClocks, FakeConnection, ScriptedDriver
from tests.fakes.vehicle import RecordingVehicle, adapter_key_file

LIMIT = 200


@dataclass
class FakeCamera:
    stream: VideoStream
    fault: str = ""
    keys: int = 0
    reports: list[VideoReport] = field(default_factory=list)
    retransmitted: list[tuple[int, ...]] = field(default_factory=list)

    def request_key_frame(self) -> None:
        self.keys += 1

    def retransmit(self, source: int, sequences: Sequence[int]) -> None:
        self.retransmitted.append((source, *sequences))

    def adapt(self, report: VideoReport) -> None:
        self.reports.append(report)

    def relieve(self, report: CongestionReport) -> None:
        raise AssertionError("no congestion was reported")


class Desk:
    """An onboard controller with a station and an adapter, in lockstep; times are milliseconds."""

    def __init__(self) -> None:
        self.car, self.now, self.number = OnboardController(LIMIT), 1000, 0
        self.connection = FakeConnection(FakeClocks(now=lambda: self.now * NS_PER_MS))
        self.answer = Answer(0, 1, False, "", VehicleState(2.0))
        self.session = object()
        self.car.join(self.session, self.connection, ())

    def send(self, command: Command, age: float = 10, session: object = None) -> None:
        self.number += 1
        message = Message(Kind.COMMAND, self.number, int((self.now - age) * NS_PER_MS), command.pack())
        self.car.receive(session or self.session, message, self.now * NS_PER_MS)

    def step(self, answered: bool = True) -> Command:
        self.now += 5
        self.car.check_clocks()
        if answered:
            self.answer = Answer(
                self.now, self.answer.stop, self.answer.standing, self.answer.reason, VehicleState(2.0)
            )
            self.car.receive_answer(self.answer, self.now * NS_PER_MS)
        return self.car.watchdog_order(self.now * NS_PER_MS).command

    def telemetry(self) -> Telemetry:
        return self.car.telemetry(self.now * NS_PER_MS)

    def start(self, session: object = None) -> None:
        self.step()
        stop = self.car.safety.stop
        self.send(Command(REST, stop), session=session)
        self.send(Command(REST, stop, agree=True), session=session)


def test_driver_is_obeyed_once_all_conditions_are_met() -> None:
    desk = Desk()
    assert desk.step().controls.brake == 1
    desk.start()
    desk.send(Command(GO))
    assert desk.step().controls == GO
    telemetry = desk.telemetry()
    assert (telemetry.standing, telemetry.command, telemetry.age) == (False, desk.number, 10.0)
    assert telemetry.vehicle.speed == 2.0
    desk.now += LIMIT
    assert desk.step().controls.brake == 1
    assert desk.telemetry().standing and "200 ms" in desk.telemetry().reason


@pytest.mark.parametrize(
    ("clocks", "why"),
    [
        ({"known": False}, CLOCKS_UNKNOWN),
        ({"uncertainty_ms": LIMIT + 1.0}, "uncertain by 201 ms"),
        ({"wall_apart_s": -10.0}, "differ by 10 s: check NTP"),
    ],
)
def test_wrong_clocks_block_driving(clocks: dict[str, Any], why: str) -> None:
    desk = Desk()
    vars(desk.connection.clocks).update(clocks)
    desk.start()
    assert desk.step().controls.brake == 1 and desk.telemetry().standing
    assert why in desk.telemetry().reason
    dropped = desk.telemetry().dropped
    assert DROP_CLOCKS_UNKNOWN not in dropped or dropped[DROP_CLOCKS_UNKNOWN] == 2
    vars(desk.connection.clocks).update(vars(FakeClocks(now=desk.connection.clocks.now)))
    desk.step()
    desk.start()
    assert not desk.telemetry().standing


def test_clock_offset_of_one_station_is_not_used_for_another() -> None:
    desk = Desk()
    desk.start()
    other = object()
    desk.car.join(other, FakeConnection(FakeClocks(known=False)), ())
    stop = desk.car.safety.stop
    desk.car.watchdog_order(desk.now * NS_PER_MS)
    desk.send(Command(REST, stop), session=other)
    desk.send(Command(REST, stop, agree=True), session=other)
    assert desk.telemetry().standing


def test_restarted_station_must_confirm_again() -> None:
    desk = Desk()
    desk.start()
    desk.send(Command(GO))
    desk.number = 0
    desk.car.station_restarted(object())
    assert desk.step().controls == GO
    desk.car.station_restarted(desk.session)
    desk.send(Command(GO, desk.car.safety.stop))
    assert desk.step().controls.brake == 1
    desk.start()
    desk.send(Command(GO))
    assert desk.step().controls == GO


def test_station_that_is_not_joined_does_not_drive() -> None:
    desk = Desk()
    desk.start()
    other = object()
    desk.send(Command(GO), session=other)
    assert desk.step().controls == REST and desk.telemetry().dropped == {DROP_OTHER_SESSION: 1}
    desk.car.join(other, desk.connection, ())
    assert desk.step().controls.brake == 1
    desk.start()
    assert desk.telemetry().standing
    desk.start(other)
    desk.send(Command(GO), session=other)
    assert desk.step().controls == GO
    desk.car.release("the driver has let go")
    desk.start(other)
    assert desk.step().controls.brake == 1
    assert desk.telemetry().reason == f"the driver has let go; {NO_STATION}"


def test_silent_or_stopped_adapter_is_a_stop_that_the_driver_confirms() -> None:
    desk = Desk()
    desk.start()
    for _ in range(LIMIT // 5 + 1):
        desk.send(Command(GO))
        desk.step(answered=False)
    telemetry = desk.telemetry()
    assert telemetry.standing and telemetry.reason == ADAPTER_SILENT
    assert telemetry.vehicle.faults == (ADAPTER_SILENT,)
    stop = telemetry.stop
    desk.send(Command(REST, stop))
    desk.send(Command(REST, stop, agree=True))  # too soon
    desk.step(answered=False)
    assert desk.telemetry().standing
    desk.start()
    assert not desk.telemetry().standing
    desk.answer = Answer(0, 2, True, "the plug is out", VehicleState())
    desk.send(Command(GO))
    assert desk.step().controls.brake == 1
    assert desk.telemetry().reason == "the vehicle adapter stopped: the plug is out"
    assert not desk.step().agree
    desk.start()
    desk.send(Command(GO))
    agreed = desk.step()
    assert agreed.agree and agreed.stop == 2 and agreed.controls.throttle == 0
    desk.answer = Answer(0, 2, False, "", VehicleState())
    assert desk.step().controls == GO


def test_video_messages_reach_their_camera_and_camera_faults_are_reported() -> None:
    desk = Desk()
    cameras = [
        FakeCamera(VideoStream(0, "front", 640, 480, 30.0)),
        FakeCamera(VideoStream(1, "back", 0, 0, 0.0), "unplugged"),
    ]
    desk.car.join(desk.session, desk.connection, cameras)
    desk.step()
    report = VideoReport(1, 10, 0, 20.0, {})
    for kind, body in (
        (Kind.KEY_FRAME_REQUEST, KeyFrameRequest(0).pack()),
        (Kind.KEY_FRAME_REQUEST, KeyFrameRequest(9).pack()),
        (Kind.VIDEO_REPORT, report.pack()),
        (Kind.NACK, Nack(7 << 8 | 1, (5, 65_535)).pack()),
    ):
        desk.car.receive(desk.session, Message(kind, 1, 0, body), 0)
    desk.car.receive(object(), Message(Kind.KEY_FRAME_REQUEST, 1, 0, KeyFrameRequest(0).pack()), 0)
    assert (cameras[0].keys, cameras[1].reports) == (1, [report])
    assert (cameras[0].retransmitted, cameras[1].retransmitted) == ([], [(7 << 8 | 1, 5, 65_535)])
    assert desk.telemetry().vehicle.faults == ("camera back: unplugged",)
    assert desk.car.streams() == VideoStreams((cameras[0].stream, cameras[1].stream))


def test_malformed_messages_are_counted() -> None:
    desk = Desk()
    for kind in (Kind.COMMAND, Kind.KEY_FRAME_REQUEST, Kind.VIDEO_REPORT, Kind.NACK):
        desk.car.receive(desk.session, Message(kind, 1, 0, b"rubbish"), 0)
    assert desk.telemetry().dropped == {MALFORMED: 4}


def test_telemetry_fits_into_a_packet_with_any_number_of_faults() -> None:
    many = Telemetry(VehicleState(faults=tuple("ä" * 50 for _ in range(50))), 1, True, "x" * 200, 1, 1.0, {"old": 1})
    body = pack_fitting(many)
    assert len(body) <= BODY_MAX_BYTES and Telemetry.unpack(body).vehicle.faults


def test_invalid_adapter_address_is_reported() -> None:
    for wrong in ("localhost", "localhost:", ":x", "host:70000"):
        with pytest.raises(SettingError, match="adapter"):
            OnboardParams(adapter=wrong).address()


@pytest.fixture
def running() -> Iterator[tuple[RecordingVehicle, OnboardUnit, ScriptedDriver, FakeConnection, threading.Event]]:
    """A vehicle, its adapter, its onboard unit, and a station."""
    vehicle, ended, connection = RecordingVehicle(VehicleState(3.0)), threading.Event(), FakeConnection()
    adapter_server = AdapterServer(vehicle, AdapterParams(port=0, limit=LIMIT, key=adapter_key_file()))
    adapter = threading.Thread(target=adapter_server.run, args=(ended,))
    adapter.start()
    unit = OnboardUnit(
        OnboardParams(adapter=f"127.0.0.1:{adapter_server.address[1]}", limit=LIMIT, key=adapter_key_file())
    )
    stations: list[ScriptedDriver] = []

    def connect(received: Callable[[Message], None], restarted: Callable[[], None]) -> FakeConnection:
        restarted()
        stations.append(ScriptedDriver(connection, received))
        return connection

    unit.join(connect)
    yield vehicle, unit, stations[0], connection, ended
    stations[0].ended.set()
    stations[0].thread.join()
    unit.close()
    ended.set()
    adapter.join()
    assert unit.failed is None and connection.closed


def test_drive_from_the_driver_to_the_vehicle_and_back(
    running: tuple[RecordingVehicle, OnboardUnit, ScriptedDriver, FakeConnection, threading.Event],
) -> None:
    vehicle, _, station, connection, ended = running
    station.start()
    station.until(lambda: vehicle.controls == GO)
    assert connection.telemetry().vehicle.speed == 3.0 and any(kind == Kind.STREAMS for kind, _ in connection.sent)

    station.ended.set()  # the links are cut
    station.thread.join()
    cut = time.monotonic()
    station.until(lambda: vehicle.controls.brake == 1)
    assert time.monotonic() - cut < LIMIT / 1000 + 0.1
    station.until(lambda: connection.telemetry().standing)

    again = ScriptedDriver(connection, station.received)
    again.number, again.controls = station.number, GO
    time.sleep(0.2)
    assert vehicle.controls.brake == 1  # not before the driver confirms
    again.start()
    again.until(lambda: vehicle.controls == GO)

    vehicle.unreachable = "the plug is out"
    again.until(lambda: "the plug is out" in connection.telemetry().reason)
    vehicle.unreachable = ""
    time.sleep(0.1)
    assert vehicle.controls.brake == 1
    again.start()
    again.until(lambda: vehicle.controls == GO)

    ended.set()  # the adapter ends
    again.until(lambda: connection.telemetry().reason == ADAPTER_SILENT)
    assert vehicle.controls.brake == 1
    again.ended.set()
    again.thread.join()


def test_release_stops_the_vehicle_at_once(
    running: tuple[RecordingVehicle, OnboardUnit, ScriptedDriver, FakeConnection, threading.Event],
) -> None:
    vehicle, unit, station, connection, _ = running
    station.start()
    station.until(lambda: vehicle.controls == GO)
    unit.release("taken back")
    assert connection.closed
    station.until(lambda: vehicle.controls.brake == 1)
    station.agree = True
    time.sleep(0.2)
    assert vehicle.controls.brake == 1


def test_failed_watchdog_is_detected_and_the_vehicle_stops(
    running: tuple[RecordingVehicle, OnboardUnit, ScriptedDriver, FakeConnection, threading.Event],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vehicle, unit, station, _, _ = running
    station.start()
    station.until(lambda: vehicle.controls == GO)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)

    def failing(now: int) -> Any:
        raise RuntimeError("a bug")

    monkeypatch.setattr(unit.car, "watchdog_order", failing)
    station.until(lambda: vehicle.controls.brake == 1)
    assert isinstance(unit.failed, RuntimeError)
    unit.failed = None
