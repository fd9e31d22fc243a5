"""The onboard unit obeys the joined station, reports faults, and stops the vehicle if anything fails."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.teleoperation import adapter_key
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
    WATCHDOG_PERIOD_S,
    OnboardController,
    OnboardJobs,
    OnboardUnit,
    pack_fitting,
)
from tests.fakes.driver import GO, REST, FakeClocks, FakeConnection, RunningDriver, ScriptedDriver
from tests.fakes.vehicle import RecordingVehicle, adapter_key_file
from tests.fakes.virtual_clock import VirtualClock

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


class Drive:
    """Driver, onboard unit, adapter and vehicle in lockstep, in virtual time.

    Attributes:
        hanging: those of "driver", "unit" and "adapter" that do nothing; their packets wait.
    """

    def __init__(self) -> None:
        self.clock, self.hanging = VirtualClock(), set[str]()
        key = adapter_key_file()
        self.vehicle = RecordingVehicle(VehicleState(3.0), clock=self.clock)
        params = AdapterParams(port=0, limit=LIMIT, key=key)
        self.server = AdapterServer(self.vehicle, params, clock=self.clock.ns)
        self.car, self.connection = OnboardController(LIMIT), FakeConnection(FakeClocks(now=self.clock.ns))
        self.orders, self.answers = list[bytes](), list[bytes]()
        self.jobs = OnboardJobs(self.car, adapter_key.read(key), self.orders.append, clock=self.clock.ns)
        self.session, self.steps = object(), 0
        self.driver = ScriptedDriver(self.connection, self._receive, clock=self.clock.ns)
        self.car.join(self.session, self.connection, ())

    def _receive(self, message: Message) -> None:
        self.car.receive(self.session, message, self.clock.ns())

    def step(self) -> None:
        """A period of the watchdog, 5 ms."""
        self.clock.sleep(WATCHDOG_PERIOD_S)
        self.steps += 1
        if "driver" not in self.hanging and self.steps % 4 == 0:
            self.driver.step()
        if "unit" not in self.hanging:
            for packet in _taken(self.answers):
                self.jobs.receive_answer(packet)
            self.jobs.watch()
            if self.steps % 4 == 0:
                self.jobs.send_telemetry(self.connection)
        if "adapter" not in self.hanging:
            self.answers += filter(None, map(self.server.answer, _taken(self.orders)))
            if self.steps % 2 == 0:
                self.server.control()

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / WATCHDOG_PERIOD_S)):
            self.step()

    def until(self, condition: Callable[[], bool]) -> float:
        """Let time pass until a condition is true; returns how long that took, milliseconds."""
        began = self.clock()
        while not condition():
            assert self.clock() < began + 20, self.connection.telemetry()
            self.step()
        return 1e3 * (self.clock() - began)

    def drives(self) -> bool:
        return self.vehicle.controls == GO

    def brakes(self) -> bool:
        return self.vehicle.controls.brake == 1

    def close(self) -> None:
        ended = threading.Event()
        ended.set()
        self.server.run(ended)


def _taken(packets: list[bytes]) -> list[bytes]:
    taken = packets[:]
    packets.clear()
    return taken


@pytest.fixture
def drive() -> Iterator[Drive]:
    """A vehicle that drives."""
    made = Drive()
    made.until(made.drives)
    yield made
    made.close()


def test_driver_who_falls_silent_stops_the_vehicle_until_they_confirm(drive: Drive) -> None:
    drive.pass_time(2)
    assert drive.drives() and drive.connection.telemetry().vehicle.speed == 3.0
    assert sum(kind == Kind.STREAMS for kind, _ in drive.connection.sent) == 3  # once per second
    drive.hanging = {"driver"}  # the links are cut
    assert LIMIT - 20 <= drive.until(drive.brakes) <= LIMIT + 15  # the last command was up to 20 ms old
    drive.until(lambda: drive.connection.telemetry().standing)
    drive.hanging, drive.driver.confirms = set(), False
    drive.pass_time(2)
    assert drive.brakes(), "the driver has not confirmed"
    drive.driver.confirms = True
    drive.until(drive.drives)


def test_unreachable_vehicle_needs_a_confirmation(drive: Drive) -> None:
    drive.vehicle.unreachable, drive.driver.confirms = "the plug is out", False
    drive.until(lambda: "the plug is out" in drive.connection.telemetry().reason)
    drive.vehicle.unreachable = ""
    drive.pass_time(2)
    assert drive.brakes()
    drive.driver.confirms = True
    drive.until(drive.drives)


@pytest.mark.parametrize("seconds", [0.1, 0.18, 0.25, 1.0, 10.0])
def test_stalled_onboard_unit_is_a_stop_if_it_exceeds_the_limit(drive: Drive, seconds: float) -> None:
    drive.hanging, drive.driver.confirms = {"unit"}, False
    if seconds * 1e3 > LIMIT:
        assert drive.until(drive.brakes) <= LIMIT + 25, "the adapter stops the vehicle by itself"
    drive.pass_time(seconds)
    drive.hanging = set()
    drive.pass_time(2)
    assert drive.brakes() if seconds * 1e3 > LIMIT else drive.drives()
    drive.driver.confirms = True
    drive.until(drive.drives)


def test_adapter_that_ends_or_stalls_is_reported_and_stops_the_vehicle(drive: Drive) -> None:
    drive.hanging, drive.driver.confirms = {"adapter"}, False
    took = drive.until(lambda: drive.connection.telemetry().reason == ADAPTER_SILENT)
    assert LIMIT - 15 <= took <= LIMIT + 30
    drive.pass_time(1)
    drive.hanging = set()  # with all packets that waited
    drive.until(drive.brakes)
    drive.pass_time(2)
    assert drive.brakes()
    drive.driver.confirms = True
    drive.until(drive.drives)


def test_released_station_stops_the_vehicle_at_once_and_for_good(drive: Drive) -> None:
    drive.car.release("taken back")
    assert drive.until(drive.brakes) <= 15
    drive.pass_time(2)  # its driver confirms
    assert drive.brakes()


Running = tuple[RecordingVehicle, OnboardUnit, RunningDriver, FakeConnection, Callable[[], None]]


@pytest.fixture
def running() -> Iterator[Running]:
    """A vehicle, its onboard unit, a station and its driver, and what ends the adapter, all running."""
    vehicle, ended, connection = RecordingVehicle(VehicleState(3.0)), threading.Event(), FakeConnection()
    server = AdapterServer(vehicle, AdapterParams(port=0, limit=LIMIT, key=adapter_key_file()))
    adapter = threading.Thread(target=server.run, args=(ended,))
    adapter.start()
    unit = OnboardUnit(OnboardParams(adapter=f"127.0.0.1:{server.address[1]}", limit=LIMIT, key=adapter_key_file()))
    drivers: list[RunningDriver] = []

    def connect(received: Callable[[Message], None], restarted: Callable[[], None]) -> FakeConnection:
        restarted()
        drivers.append(RunningDriver(connection, received))
        return connection

    def end_adapter() -> None:
        ended.set()
        adapter.join()

    unit.join(connect)
    yield vehicle, unit, drivers[0], connection, end_adapter
    drivers[0].end()
    unit.close()
    end_adapter()
    assert unit.failed is None and connection.closed


def test_drive_from_the_driver_to_the_vehicle_and_back(running: Running) -> None:
    vehicle, _, driver, connection, end_adapter = running
    driver.until(lambda: vehicle.controls == GO)
    driver.until(lambda: any(kind == Kind.STREAMS for kind, _ in connection.sent))
    assert connection.telemetry().vehicle.speed == 3.0
    driver.end()  # the links are cut
    driver.until(lambda: vehicle.controls.brake == 1 and connection.telemetry().standing)
    end_adapter()
    driver.until(lambda: connection.telemetry().reason == ADAPTER_SILENT)
    assert vehicle.controls.brake == 1


def test_release_disconnects_and_stops_the_vehicle(running: Running) -> None:
    vehicle, unit, driver, connection, _ = running
    driver.until(lambda: vehicle.controls == GO)
    unit.release("taken back")
    assert connection.closed
    driver.until(lambda: vehicle.controls.brake == 1)


def test_onboard_unit_that_ends_stops_the_vehicle(running: Running) -> None:
    vehicle, unit, driver, _, _ = running
    driver.until(lambda: vehicle.controls == GO)
    unit.close()
    driver.until(lambda: vehicle.controls.brake == 1)


def test_failed_watchdog_is_detected_and_the_vehicle_stops(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle, unit, driver, _, _ = running
    driver.until(lambda: vehicle.controls == GO)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)

    def failing(now: int) -> Any:
        raise RuntimeError("a bug")

    monkeypatch.setattr(unit.car, "watchdog_order", failing)
    driver.until(lambda: vehicle.controls.brake == 1 and unit.failed is not None)
    assert isinstance(unit.failed, RuntimeError)
    unit.failed = None
    monkeypatch.undo()
