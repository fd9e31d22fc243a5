"""Translators: one contract, one file a vehicle, and a vehicle that stands whatever fails around it."""

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
from scan2sim.services.teleoperation.vehicle.adapter import TranslateParams, Translating
from scan2sim.services.teleoperation.vehicle.adapter_protocol import Answer, CarEnd
from scan2sim.services.teleoperation.vehicle.adapters import Unreachable
from scan2sim.services.teleoperation.vehicle.adapters.can import EXAMPLE
from scan2sim.services.teleoperation.vehicle.adapters.ros import ODOMETRY, TYPES
from tests.conftest import ROOT

GO = Controls(0.5, throttle=1.0, gear=Gear.FORWARD, lights=True)
LIMIT = 200


class Toy:
    """A vehicle that keeps what it is told, with the time."""

    def __init__(self) -> None:
        self.told: list[tuple[float, Controls]] = []
        self.unreachable = ""
        self.closed = False

    def obey(self, controls: Controls) -> None:
        if self.unreachable:
            raise Unreachable(self.unreachable)
        self.told.append((time.monotonic(), controls))

    def state(self) -> VehicleState:
        return VehicleState(1.0)

    def close(self) -> None:
        self.closed = True

    def moves(self) -> bool:
        return bool(self.told) and self.told[-1][1].throttle > 0


class Wheel:
    """A car unit's end at work, in the test's own time."""

    def __init__(self, address: tuple[str, int], key: bytes = b"") -> None:
        self.end, self.key, self.driven = CarEnd(LIMIT), key, False
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(address)
        self.socket.settimeout(0.01)

    def exchange(self, controls: Controls = GO) -> None:
        order = self.end.order(controls if self.driven else STOP, 0.0, self.driven, time.monotonic_ns())
        self.socket.send(order.pack(self.key))
        try:
            while True:
                answer = Answer.unpack(self.socket.recv(2000), self.key)
                if self.end.hear(answer, time.monotonic_ns()):
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


At = Callable[..., tuple[Translating, Wheel]]


@pytest.fixture
def at_work() -> Iterator[At]:
    """Starts a translator of a vehicle, and a car unit that talks to it."""
    ended, threads = threading.Event(), []

    def started(vehicle: Any, **params: Any) -> tuple[Translating, Wheel]:
        one = Translating(vehicle, TranslateParams(port=0, limit=LIMIT, **params))
        threads.append(threading.Thread(target=one.run, args=(ended,)))
        threads[-1].start()
        key = params["key"].read_bytes() if "key" in params else b""
        return one, Wheel(one.address, key)

    yield started
    ended.set()
    for thread in threads:
        thread.join()


def test_a_vehicle_is_driven_and_stands_when_the_car_unit_falls_silent(at_work: At) -> None:
    toy = Toy()
    _, wheel = at_work(toy)
    wheel.until(lambda: len(toy.told) > 10)
    assert all(controls.brake == 1 for _, controls in toy.told)
    wheel.start()
    wheel.until(toy.moves)
    assert toy.told[-1][1] == GO
    silent = time.monotonic()
    time.sleep(2 * LIMIT / 1000)
    stopped = next(at for at, controls in toy.told if at > silent and controls.brake == 1)
    slowest = max(later - at for (at, _), (later, _) in zip(toy.told, toy.told[1:], strict=False))
    assert stopped - silent < LIMIT / 1000 + slowest + 0.02  # this machine may be busy
    wheel.until(lambda: not wheel.driven)  # the car unit is told, and has the driver confirm
    for _ in range(20):
        wheel.exchange()
    assert not toy.moves()
    wheel.start()
    wheel.until(toy.moves)


def test_a_vehicle_that_cannot_be_told_is_a_stop_that_the_driver_confirms(at_work: At) -> None:
    toy = Toy()
    _, wheel = at_work(toy)
    wheel.start()
    toy.unreachable = "the plug is out"
    wheel.until(lambda: not wheel.driven)
    assert wheel.end.answer is not None and wheel.end.answer.reason == "the plug is out"
    wheel.driven = True  # the driver confirms too soon
    for _ in range(20):
        wheel.exchange()
    toy.unreachable = ""
    wheel.driven = False
    for _ in range(20):
        wheel.exchange()
    assert not toy.moves() and toy.told[-1][1].brake == 1
    wheel.start()
    wheel.until(toy.moves)


def test_rubbish_and_strangers_are_not_obeyed(at_work: At, tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(b"k" * 32)
    toy = Toy()
    translating, wheel = at_work(toy, key=key, host="0.0.0.0")
    stranger = Wheel(("127.0.0.1", translating.address[1]), b"x" * 32)
    wheel.socket.connect(("127.0.0.1", translating.address[1]))
    wheel.start()
    for _ in range(20):
        stranger.driven = True
        stranger.exchange()
        stranger.socket.send(os.urandom(40))
        wheel.exchange()
    assert toy.moves() and stranger.end.answer is None and translating.malformed == 40


def test_others_machines_are_listened_to_with_a_key_only(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="--key"):
        Translating(Toy(), TranslateParams(host="0.0.0.0", port=0))
    (tmp_path / "short").write_text("abc\n", encoding="utf-8")
    with pytest.raises(InputError, match="3 bytes"):
        Translating(Toy(), TranslateParams(port=0, key=tmp_path / "short"))


def test_a_vehicle_is_told_to_stand_when_its_translator_ends() -> None:
    toy, ended = Toy(), threading.Event()
    ended.set()
    Translating(toy, TranslateParams(port=0)).run(ended)
    assert toy.told[-1][1] == STOP and toy.closed


def until(what: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not what():
        assert time.monotonic() < end
        time.sleep(0.005)


NEW = """
from scan2sim.pipeline import step
from scan2sim.services.teleoperation.control.controls import VehicleState

class Params(step.Params):
    "Of a boat."
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
    """A translator of a new vehicle, one file, as a process."""
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "boat.py").write_text(NEW, encoding="utf-8")
    program = f"""
import sys, threading
from scan2sim.services import transport
from scan2sim.services.teleoperation import translators
from scan2sim.services.teleoperation.vehicle.adapter import Translating, TranslateParams
translators.__path__.append({str(tmp_path / "more")!r})
found = translators.find("boat")
one = Translating(found.connect(found.Params(file={str(tmp_path / "log")!r})), TranslateParams(port=0))
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


def test_a_new_vehicle_is_one_file_and_stops_when_its_car_unit_hangs(
    boat: subprocess.Popen[str], tmp_path: Path
) -> None:
    assert boat.stdout is not None
    port = int(boat.stdout.readline())
    hanging = f"""
from scan2sim.services.teleoperation.vehicle.onboard_unit import CarParams, CarUnit
from tests.services.teleoperation.vehicle.test_onboard_unit import FakeBundle, Station
unit, bundle, stations = CarUnit(CarParams(translator="127.0.0.1:{port}")), FakeBundle(), []
unit.join(lambda received, began: stations.append(Station(bundle, received)) or bundle)
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
        unit.send_signal(signal.SIGCONT)  # it goes on, its driver's foot still down
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            assert log.read_text(encoding="utf-8").splitlines()[-1] == "0.0 1.0"
    finally:
        unit.kill()
        unit.communicate()


def test_there_is_no_such_translator() -> None:
    with pytest.raises(SettingError, match="no 'tram'") as caught:
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


def heard(bus: Any, dbc: Path = EXAMPLE) -> dict[str, Any]:
    """What is newest of each signal."""
    described: Any = cantools.database.load_file(dbc)
    found: dict[str, Any] = {}
    while (message := bus.recv(0)) is not None:
        found |= described.decode_message(message.arbitration_id, message.data)
    return found


@pytest.mark.parametrize(
    ("controls", "said"),
    [
        (GO, {"Steering": 0.3, "Throttle": 100, "Brake": 0, "Gear": "Forward", "Horn": 0, "Lights": 1}),
        (
            Controls(-1.0, 0.5, 0.25, Gear.REVERSE, horn=True),
            {"Steering": -0.6, "Throttle": 50, "Brake": 25, "Gear": "Reverse", "Horn": 1, "Lights": 0},
        ),
        (STOP, {"Steering": 0, "Throttle": 0, "Brake": 100, "Gear": "Neutral", "Horn": 0, "Lights": 0}),
    ],
)  # fmt: skip
def test_controls_are_signals_of_the_dbc_file(vehicle: Any, controls: Controls, said: dict[str, Any]) -> None:
    one = connect()
    one.obey(controls)
    first = heard(vehicle)
    one.obey(controls)
    second = heard(vehicle)
    assert {name: first[name] for name in said} == said
    assert second["Counter"] == first["Counter"] + 1
    for _ in range(20):
        one.obey(controls)
    assert heard(vehicle)["Counter"] <= 15
    one.close()


def test_a_vehicle_tells_its_speed_and_gear_or_that_it_is_silent(vehicle: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    one = connect()
    described: Any = cantools.database.load_file(EXAMPLE)
    vehicle.send(can.Message(arbitration_id=99, data=b"123", is_extended_id=False))
    vehicle.send(can.Message(arbitration_id=512, data=b"1", is_extended_id=False))
    data = described.encode_message("Motion", {"Speed": -18.0, "GearIn": "Reverse"})
    vehicle.send(can.Message(arbitration_id=512, data=data, is_extended_id=False))
    one.obey(STOP)
    assert one.state() == VehicleState(-5.0, gear=Gear.REVERSE)
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 2)
    assert one.state().faults == ("the vehicle says nothing on teleoperation",)
    one.close()


def test_a_bus_that_goes_away_is_told_and_found_again(vehicle: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    one = connect()
    one.obey(GO)
    heard(vehicle)
    one._bus.shutdown()
    with monkeypatch.context() as patched:

        def gone(*_: Any, **__: Any) -> None:
            raise can.CanInitializationError("no such device")

        patched.setattr(can, "Bus", gone)
        for _ in range(3):
            with pytest.raises(Unreachable, match="teleoperation is gone"):
                one.obey(GO)
        assert one.state().faults == ("the CAN bus teleoperation is gone",)
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 2)
    one.obey(STOP)
    assert heard(vehicle)["Brake"] == 100
    one.close()


def test_a_stop_reaches_the_bus_when_a_car_unit_falls_silent(vehicle: Any, at_work: At) -> None:
    _, wheel = at_work(connect())
    wheel.start()
    wheel.until(lambda: heard(vehicle).get("Throttle") == 100)
    time.sleep(2 * LIMIT / 1000)
    last = heard(vehicle)
    assert (last["Throttle"], last["Brake"]) == (0, 100)


@pytest.mark.parametrize(
    ("change", "params", "cause", "remedy"),
    [
        ((" SG_ Steering", " SG_ Angle"), {}, "no signal 'Steering'", "--set steering=.*Angle"),
        (("DriveCommand", "Drive"), {}, "no message 'DriveCommand'", "--set .*BodyCommand, Drive, Motion"),
        (('"km/h"', '"furlong/h"'), {}, "furlong/h", "km/h"),
        (('VAL_ 256 Gear 0 "Neutral" 1 "Forward" 2', 'VAL_ 256 Gear 0 "N" 1 "D" 2'), {}, "'Neutral'", "D, N, Reverse"),
        (("[-0.6|0.6]", "[0|0]"), {}, "no range", r"\[-0.6\|0.6\]"),
        (("[0|15]", "[0|7]"), {"gear": "", "throttle": ""}, "no signal", "MESSAGE.SIGNAL"),
        (("BO_ 256", "BO_ what"), {}, "no DBC file", "DBC"),
    ],
)  # fmt: skip
def test_a_dbc_file_that_lacks_something_is_told(
    tmp_path: Path, change: tuple[str, str], params: dict[str, Any], cause: str, remedy: str
) -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    assert change[0] in text
    path = tmp_path / "other.dbc"
    path.write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(ScanError, match=cause) as caught:
        connect(dbc=path, **params)
    assert re.search(remedy, caught.value.remedy)
    assert caught.value.where in (str(path), "throttle")


def test_a_file_that_is_not_there_and_an_interface_that_is_none_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        connect(dbc=tmp_path / "nowhere.dbc")
    with pytest.raises(SettingError, match="carrier_pigeon"):
        connect(interface="carrier_pigeon")


def test_other_names_and_a_steering_the_other_way(vehicle: Any, tmp_path: Path) -> None:
    path = tmp_path / "other.dbc"
    path.write_text(EXAMPLE.read_text(encoding="utf-8").replace("Steering", "Lenkung"), encoding="utf-8")
    one = connect(dbc=path, steering="-DriveCommand.Lenkung", gear="", counter="", horn="", gear_in="")
    one.obey(GO)
    said = heard(vehicle, path)
    assert said["Lenkung"] == pytest.approx(-0.3) and said["Gear"] == "Neutral" and one.state().gear == Gear.FORWARD
    one.close()


# ROS 2


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch, domain: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    monkeypatch.setenv("SCAN2SIM_TRANSPORT", "cyclone")


def of_ros(**params: Any) -> Any:
    found = adapters.find("ros")
    return found.connect(found.Params.of("", params))


@pytest.mark.parametrize(
    ("message", "asked"),
    [
        ("twist", lambda m: (m.linear.x, m.angular.z)),
        ("twist_stamped", lambda m: (m.twist.linear.x, m.twist.angular.z)),
        ("ackermann", lambda m: (m.drive.speed, m.drive.steering_angle)),
    ],
)
def test_controls_are_messages_of_ros(network: None, message: str, asked: Callable[[Any], tuple[float, float]]) -> None:
    one = of_ros(message=message, speed=2.0, angle=0.5, wheelbase=1.0)
    with pytest.raises(Unreachable, match="nobody listens on /cmd_vel"):
        one.obey(STOP)
    ros = transport.load()
    robot = ros.Node("robot")
    heard: list[Any] = []
    robot.create_subscription(ros.message_type(TYPES[message]), "cmd_vel", heard.append, 10)
    odometry = robot.create_publisher(ros.message_type(ODOMETRY), "odom", 10)
    said = ros.message(ODOMETRY)
    said.pose.pose.position.x, said.pose.pose.orientation.z, said.pose.pose.orientation.w = 3.0, 1.0, 0.0
    said.twist.twist.linear.x = -1.5

    def told(controls: Controls) -> tuple[float, float]:
        heard.clear()
        end = time.monotonic() + 20
        while not heard or one.state().position is None:
            assert time.monotonic() < end
            odometry.publish(said)
            with contextlib.suppress(Unreachable):
                one.obey(controls)
            ros.spin_once(robot, 0.01)
        return asked(heard[-1])

    turn = 0.25 if message == "ackermann" else math.tan(0.25) * -1.0
    reverse = Controls(0.5, 0.5, 0.0, Gear.REVERSE)
    assert told(reverse) == pytest.approx((-1.0, turn))
    assert told(Controls(0.5, 0.5, 0.5, Gear.REVERSE))[0] == pytest.approx(-0.5)
    assert told(STOP)[0] == 0.0
    state = one.state()
    assert (state.speed, state.position, state.faults) == (-1.5, (3.0, 0.0), ())
    assert state.heading is not None and abs(state.heading) == pytest.approx(math.pi)
    robot.destroy_node()
    one.close()


def test_odometry_that_does_not_come_is_told(network: None, monkeypatch: pytest.MonkeyPatch) -> None:
    one = of_ros()
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 2)
    assert one.state().faults == ("no odometry on /odom",)
    one.close()
