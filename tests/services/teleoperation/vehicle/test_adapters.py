"""Vehicle adapters: one interface, one module for each kind of vehicle; the vehicle stops whatever fails around it."""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import pytest

from scan2sim.pipeline.core.errors import InputError, ScanError, SettingError
from scan2sim.services import transport
from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle import adapters
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from scan2sim.services.teleoperation.vehicle.adapter_protocol import Answer, OnboardEndpoint
from scan2sim.services.teleoperation.vehicle.adapters import VehicleUnreachable
from scan2sim.services.teleoperation.vehicle.adapters.can import EXAMPLE_DBC
from scan2sim.services.teleoperation.vehicle.adapters.ros import MESSAGE_TYPES, ODOMETRY_TYPE
from tests.conftest import ROOT
from tests.fakes.vehicle import RecordingVehicle
from tests.waiting import until

GO = Controls(0.5, throttle=1.0, gear=Gear.FORWARD, lights=True)
LIMIT = 200


class OnboardPeer:
    """A running onboard endpoint, driven by the test."""

    def __init__(self, address: tuple[str, int], key: bytes = b"") -> None:
        self.end, self.key, self.driven = OnboardEndpoint(LIMIT), key, False
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(address)
        self.socket.settimeout(0.01)

    def exchange(self, controls: Controls = GO) -> None:
        order = self.end.order(controls if self.driven else STOP, 0.0, self.driven, time.monotonic_ns())
        self.socket.send(order.pack(self.key))
        try:
            while True:
                answer = Answer.unpack(self.socket.recv(2000), self.key)
                if self.end.receive(answer, time.monotonic_ns()):
                    self.driven = False
        except (TimeoutError, ConnectionRefusedError):
            pass

    def until(self, what: Callable[[], bool], controls: Controls = GO, seconds: float = 20.0) -> None:
        end = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < end, self.end.answer
            self.exchange(controls)

    def start(self) -> None:
        self.until(lambda: self.end.answer is not None)
        for _ in range(5):
            self.exchange()
        self.driven = True
        self.until(lambda: self.end.answer is not None and not self.end.answer.standing)


Start = Callable[..., tuple[AdapterServer, OnboardPeer]]


@pytest.fixture
def start_adapter() -> Iterator[Start]:
    """Starts an adapter of a vehicle, and an onboard endpoint that talks to it."""
    ended, threads = threading.Event(), []

    def started(vehicle: Any, **params: Any) -> tuple[AdapterServer, OnboardPeer]:
        one = AdapterServer(vehicle, AdapterParams(port=0, limit=LIMIT, **params))
        threads.append(threading.Thread(target=one.run, args=(ended,)))
        threads[-1].start()
        key = params["key"].read_bytes() if "key" in params else b""
        return one, OnboardPeer(one.address, key)

    yield started
    ended.set()
    for thread in threads:
        thread.join()


def test_vehicle_stops_when_the_onboard_unit_falls_silent(start_adapter: Start) -> None:
    vehicle = RecordingVehicle()
    _, peer = start_adapter(vehicle)
    peer.until(lambda: len(vehicle.received) > 10)
    assert all(controls.brake == 1 for _, controls in vehicle.received)
    peer.start()
    peer.until(vehicle.moves)
    assert vehicle.received[-1][1] == GO
    silent = time.monotonic()
    time.sleep(2 * LIMIT / 1000)
    stopped = next(at for at, controls in vehicle.received if at > silent and controls.brake == 1)
    slowest = max(later - at for (at, _), (later, _) in zip(vehicle.received, vehicle.received[1:], strict=False))
    assert stopped - silent < LIMIT / 1000 + slowest + 0.02  # this machine may be busy
    peer.until(lambda: not peer.driven)  # the onboard unit is notified, and requires a confirmation
    for _ in range(20):
        peer.exchange()
    assert not vehicle.moves()
    peer.start()
    peer.until(vehicle.moves)


def test_unreachable_vehicle_is_a_stop_that_the_driver_confirms(start_adapter: Start) -> None:
    vehicle = RecordingVehicle()
    _, peer = start_adapter(vehicle)
    peer.start()
    vehicle.unreachable = "the plug is out"
    peer.until(lambda: not peer.driven)
    assert peer.end.answer is not None and peer.end.answer.reason == "the plug is out"
    peer.driven = True  # the driver confirms too soon
    for _ in range(20):
        peer.exchange()
    vehicle.unreachable = ""
    peer.driven = False
    for _ in range(20):
        peer.exchange()
    assert not vehicle.moves() and vehicle.received[-1][1].brake == 1
    peer.start()
    peer.until(vehicle.moves)


def test_malformed_and_foreign_packets_are_not_obeyed(start_adapter: Start, tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(b"k" * 32)
    vehicle = RecordingVehicle()
    adapter_server, peer = start_adapter(vehicle, key=key, host="0.0.0.0")
    stranger = OnboardPeer(("127.0.0.1", adapter_server.address[1]), b"x" * 32)
    peer.socket.connect(("127.0.0.1", adapter_server.address[1]))
    peer.start()
    for _ in range(20):
        stranger.driven = True
        stranger.exchange()
        stranger.socket.send(os.urandom(40))
        peer.exchange()
    assert vehicle.moves() and stranger.end.answer is None and adapter_server.malformed == 40


def test_listening_beyond_loopback_requires_a_key(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="--key"):
        AdapterServer(RecordingVehicle(), AdapterParams(host="0.0.0.0", port=0))
    (tmp_path / "short").write_text("abc\n", encoding="utf-8")
    with pytest.raises(InputError, match="3 bytes"):
        AdapterServer(RecordingVehicle(), AdapterParams(port=0, key=tmp_path / "short"))


def test_vehicle_is_stopped_when_its_adapter_ends() -> None:
    vehicle, ended = RecordingVehicle(), threading.Event()
    ended.set()
    AdapterServer(vehicle, AdapterParams(port=0)).run(ended)
    assert vehicle.received[-1][1] == STOP and vehicle.closed


NEW = """
from scan2sim.pipeline.core import step
from scan2sim.services.teleoperation.control.controls import VehicleState

class Params(step.Params):
    "Settings of a boat."
    file: str

class Boat:
    def __init__(self, file):
        self.file, self.rudder = open(file, "a"), 0.0
    def obey(self, controls):
        print(controls.throttle * controls.gear, controls.brake, file=self.file, flush=True)
    def state(self):
        return VehicleState()
    def close(self):
        self.file.close()

def connect(params):
    return Boat(params.file)
"""


@pytest.fixture
def boat(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """An adapter of a new vehicle, one module, as a process."""
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "boat.py").write_text(NEW, encoding="utf-8")
    program = f"""
import sys, threading
from scan2sim.services import transport
from scan2sim.services.teleoperation.vehicle import adapters
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
adapters.__path__.append({str(tmp_path / "more")!r})
found = adapters.find("boat")
one = AdapterServer(found.connect(found.Params(file={str(tmp_path / "log")!r})), AdapterParams(port=0))
print(one.address[1], flush=True)
one.run(threading.Event())
"""
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    yield process
    process.kill()
    process.communicate()


def test_new_vehicle_is_one_module_and_stops_when_its_onboard_unit_hangs(
    boat: subprocess.Popen[str], tmp_path: Path
) -> None:
    assert boat.stdout is not None
    port = int(boat.stdout.readline())
    hanging = f"""
from scan2sim.services.teleoperation.vehicle.onboard_unit import OnboardParams, OnboardUnit
from tests.fakes.driver import FakeConnection, ScriptedDriver
unit, connection, stations = OnboardUnit(OnboardParams(translator="127.0.0.1:{port}")), FakeConnection(), []
unit.join(lambda received, restarted: stations.append(ScriptedDriver(connection, received)) or connection)
stations[0].start()
print("drives", flush=True)
"""
    unit = subprocess.Popen(
        [sys.executable, "-c", hanging], stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    try:
        assert unit.stdout is not None and unit.stdout.readline() == "drives\n"
        log = tmp_path / "log"
        until(lambda: log.read_text(encoding="utf-8").endswith("1.0 0.0\n"))
        unit.send_signal(signal.SIGSTOP)
        until(lambda: log.read_text(encoding="utf-8").endswith("0.0 1.0\n"))
        unit.send_signal(signal.SIGCONT)  # it continues, with the throttle still pressed
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            assert log.read_text(encoding="utf-8").splitlines()[-1] == "0.0 1.0"
    finally:
        unit.kill()
        unit.communicate()


def test_unknown_adapter_lists_available_ones() -> None:
    with pytest.raises(SettingError, match="unknown value 'tram'") as caught:
        adapters.find("tram")
    assert all(name in caught.value.remedy for name in ("can", "ros", "simulated"))


# CAN


@pytest.fixture
def vehicle() -> Iterator[Any]:
    """The other end of a virtual bus."""
    with can.Bus("teleoperation", interface="virtual") as bus:
        yield bus


def connect(**params: Any) -> Any:
    found = adapters.find("can")
    return found.connect(found.Params.of("", {"interface": "virtual", "channel": "teleoperation"} | params))


def newest_signals(bus: Any, dbc: Path = EXAMPLE_DBC) -> dict[str, Any]:
    """Newest value of each signal."""
    described: Any = cantools.database.load_file(dbc)
    found: dict[str, Any] = {}
    while (message := bus.recv(0)) is not None:
        found |= described.decode_message(message.arbitration_id, message.data)
    return found


@pytest.mark.parametrize(
    ("controls", "expected"),
    [
        (GO, {"Steering": 0.3, "Throttle": 100, "Brake": 0, "Gear": "Forward", "Horn": 0, "Lights": 1}),
        (
            Controls(-1.0, 0.5, 0.25, Gear.REVERSE, horn=True),
            {"Steering": -0.6, "Throttle": 50, "Brake": 25, "Gear": "Reverse", "Horn": 1, "Lights": 0},
        ),
        (STOP, {"Steering": 0, "Throttle": 0, "Brake": 100, "Gear": "Neutral", "Horn": 0, "Lights": 0}),
    ],
)  # fmt: skip
def test_controls_are_encoded_as_signals_of_the_dbc_file(
    vehicle: Any, controls: Controls, expected: dict[str, Any]
) -> None:
    one = connect()
    one.obey(controls)
    first = newest_signals(vehicle)
    one.obey(controls)
    second = newest_signals(vehicle)
    assert {name: first[name] for name in expected} == expected
    assert second["Counter"] == first["Counter"] + 1
    for _ in range(20):
        one.obey(controls)
    assert newest_signals(vehicle)["Counter"] <= 15
    one.close()


def test_vehicle_reports_speed_and_gear_or_its_silence(vehicle: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    one = connect()
    described: Any = cantools.database.load_file(EXAMPLE_DBC)
    vehicle.send(can.Message(arbitration_id=99, data=b"123", is_extended_id=False))
    vehicle.send(can.Message(arbitration_id=512, data=b"1", is_extended_id=False))
    data = described.encode_message("Motion", {"Speed": -18.0, "GearIn": "Reverse"})
    vehicle.send(can.Message(arbitration_id=512, data=data, is_extended_id=False))
    one.obey(STOP)
    assert one.state() == VehicleState(-5.0, gear=Gear.REVERSE)
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 2)
    assert one.state().faults == ("no messages from the vehicle on teleoperation",)
    one.close()


def test_lost_bus_is_reported_and_opened_again(vehicle: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    one = connect()
    one.obey(GO)
    newest_signals(vehicle)
    one._bus.shutdown()
    with monkeypatch.context() as patched:

        def fail(*_: Any, **__: Any) -> None:
            raise can.CanInitializationError("no such device")

        patched.setattr(can, "Bus", fail)
        for _ in range(3):
            with pytest.raises(VehicleUnreachable, match="teleoperation is not available"):
                one.obey(GO)
        assert one.state().faults == ("the CAN bus teleoperation is not available",)
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 2)
    one.obey(STOP)
    assert newest_signals(vehicle)["Brake"] == 100
    one.close()


def test_stop_reaches_the_bus_when_the_onboard_unit_falls_silent(vehicle: Any, start_adapter: Start) -> None:
    _, peer = start_adapter(connect())
    peer.start()
    peer.until(lambda: newest_signals(vehicle).get("Throttle") == 100)
    time.sleep(2 * LIMIT / 1000)
    last = newest_signals(vehicle)
    assert (last["Throttle"], last["Brake"]) == (0, 100)


@pytest.mark.parametrize(
    ("change", "params", "cause", "remedy"),
    [
        ((" SG_ Steering", " SG_ Angle"), {}, "no signal 'Steering'", "--set steering=.*Angle"),
        (("DriveCommand", "Drive"), {}, "no message 'DriveCommand'", "--set .*BodyCommand, Drive, Motion"),
        (('"km/h"', '"furlong/h"'), {}, "furlong/h", "km/h"),
        (('VAL_ 256 Gear 0 "Neutral" 1 "Forward" 2', 'VAL_ 256 Gear 0 "N" 1 "D" 2'), {}, "'Neutral'", "D, N, Reverse"),
        (("[-0.6|0.6]", "[0|0]"), {}, "no range", r"\[-0.6\|0.6\]"),
        (("[0|15]", "[0|7]"), {"gear": "", "throttle": ""}, "is needed to drive", "MESSAGE.SIGNAL"),
        (("BO_ 256", "BO_ what"), {}, "not a DBC file", "DBC"),
    ],
)  # fmt: skip
def test_dbc_file_with_something_missing_is_reported(
    tmp_path: Path, change: tuple[str, str], params: dict[str, Any], cause: str, remedy: str
) -> None:
    text = EXAMPLE_DBC.read_text(encoding="utf-8")
    assert change[0] in text
    path = tmp_path / "other.dbc"
    path.write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(ScanError, match=cause) as caught:
        connect(dbc=path, **params)
    assert re.search(remedy, caught.value.remedy)
    assert caught.value.where in (str(path), "throttle")


def test_missing_file_and_unknown_interface_are_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        connect(dbc=tmp_path / "nowhere.dbc")
    with pytest.raises(SettingError, match="carrier_pigeon"):
        connect(interface="carrier_pigeon")


def test_other_signal_names_and_inverted_steering(vehicle: Any, tmp_path: Path) -> None:
    path = tmp_path / "other.dbc"
    path.write_text(EXAMPLE_DBC.read_text(encoding="utf-8").replace("Steering", "Lenkung"), encoding="utf-8")
    one = connect(dbc=path, steering="-DriveCommand.Lenkung", gear="", counter="", horn="", gear_in="")
    one.obey(GO)
    expected = newest_signals(vehicle, path)
    assert (
        expected["Lenkung"] == pytest.approx(-0.3)
        and expected["Gear"] == "Neutral"
        and one.state().gear == Gear.FORWARD
    )
    one.close()


# ROS 2


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch, domain: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    monkeypatch.setenv("SCAN2SIM_TRANSPORT", "cyclone")


def ros_vehicle(**params: Any) -> Any:
    found = adapters.find("ros")
    return found.connect(found.Params.of("", params))


@pytest.mark.parametrize(
    ("message", "read_command"),
    [
        ("twist", lambda m: (m.linear.x, m.angular.z)),
        ("twist_stamped", lambda m: (m.twist.linear.x, m.twist.angular.z)),
        ("ackermann", lambda m: (m.drive.speed, m.drive.steering_angle)),
    ],
)
def test_controls_are_published_as_ros_messages(
    network: None, message: str, read_command: Callable[[Any], tuple[float, float]]
) -> None:
    one = ros_vehicle(message=message, speed=2.0, angle=0.5, wheelbase=1.0)
    with pytest.raises(VehicleUnreachable, match="nothing subscribes to /cmd_vel"):
        one.obey(STOP)
    ros = transport.load()
    robot = ros.Node("robot")
    newest_signals: list[Any] = []
    robot.create_subscription(ros.message_type(MESSAGE_TYPES[message]), "cmd_vel", newest_signals.append, 10)
    odometry = robot.create_publisher(ros.message_type(ODOMETRY_TYPE), "odom", 10)
    expected = ros.message(ODOMETRY_TYPE)
    expected.pose.pose.position.x, expected.pose.pose.orientation.z, expected.pose.pose.orientation.w = 3.0, 1.0, 0.0
    expected.twist.twist.linear.x = -1.5

    def received(controls: Controls) -> tuple[float, float]:
        newest_signals.clear()
        end = time.monotonic() + 20
        while not newest_signals or one.state().position is None:
            assert time.monotonic() < end
            odometry.publish(expected)
            with contextlib.suppress(VehicleUnreachable):
                one.obey(controls)
            ros.spin_once(robot, 0.01)
        return read_command(newest_signals[-1])

    turn = 0.25 if message == "ackermann" else math.tan(0.25) * -1.0
    reverse = Controls(0.5, 0.5, 0.0, Gear.REVERSE)
    assert received(reverse) == pytest.approx((-1.0, turn))
    assert received(Controls(0.5, 0.5, 0.5, Gear.REVERSE))[0] == pytest.approx(-0.5)
    assert received(STOP)[0] == 0.0
    state = one.state()
    assert (state.speed, state.position, state.faults) == (-1.5, (3.0, 0.0), ())
    assert state.heading is not None and abs(state.heading) == pytest.approx(math.pi)
    robot.destroy_node()
    one.close()


def test_missing_odometry_is_reported(network: None, monkeypatch: pytest.MonkeyPatch) -> None:
    one = ros_vehicle()
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 2)
    assert one.state().faults == ("no odometry on /odom",)
    one.close()
