"""Vehicle adapters: one interface, one module for each kind of vehicle; the vehicle stops whatever fails around it."""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal
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
import yaml

from scan2sim.pipeline.core.errors import InputError, ScanError, SettingError
from scan2sim.services import transport
from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle import adapters
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from scan2sim.services.teleoperation.vehicle.adapters import VehicleUnreachable
from scan2sim.services.teleoperation.vehicle.adapters import ros as ros_adapter
from scan2sim.services.teleoperation.vehicle.adapters.can import EXAMPLE_DBC
from scan2sim.services.teleoperation.vehicle.adapters.ros import MESSAGE_TYPES, ODOMETRY_TYPE
from tests.conftest import ROOT
from tests.fakes.nav2_nodes import Nodes
from tests.fakes.vehicle import GO, OnboardPeer, RecordingVehicle, adapter_key_file
from tests.waiting import until

LIMIT = 200


Start = Callable[..., tuple[AdapterServer, OnboardPeer]]


@pytest.fixture
def start_adapter() -> Iterator[Start]:
    """Starts an adapter of a vehicle, and an onboard endpoint that talks to it."""
    ended, threads = threading.Event(), []

    def started(vehicle: Any, **params: Any) -> tuple[AdapterServer, OnboardPeer]:
        one = AdapterServer(vehicle, AdapterParams(port=0, limit=LIMIT, key=adapter_key_file(), **params))
        threads.append(threading.Thread(target=one.run, args=(ended,)))
        threads[-1].start()
        return one, OnboardPeer(one.address, adapter_key.read(adapter_key_file()))

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


@pytest.mark.parametrize("key", [b"x" * 32, b""], ids=["another key", "no key"])
def test_malformed_and_foreign_packets_are_not_obeyed(start_adapter: Start, key: bytes) -> None:
    vehicle = RecordingVehicle()
    adapter_server, peer = start_adapter(vehicle, host="0.0.0.0")
    stranger = OnboardPeer(("127.0.0.1", adapter_server.address[1]), key)
    peer.socket.connect(("127.0.0.1", adapter_server.address[1]))
    peer.start()
    for _ in range(20):
        stranger.driven = True
        stranger.exchange()
        stranger.socket.send(os.urandom(40))
        peer.exchange()
    assert vehicle.moves() and stranger.end.answer is None and adapter_server.malformed == 40


def test_adapter_refuses_keys_that_are_missing_short_or_readable_by_others(tmp_path: Path) -> None:
    key = tmp_path / "key"
    for mode, text, reason in ((0o600, "abc\n", "3 bytes"), (0o644, "k" * 32, "accessible to other users")):
        key.write_text(text, encoding="utf-8")
        key.chmod(mode)
        with pytest.raises(InputError, match=reason):
            AdapterServer(RecordingVehicle(), AdapterParams(port=0, key=key))
    key.unlink()
    with pytest.raises(InputError, match="teleop certificates"):
        AdapterServer(RecordingVehicle(), AdapterParams(port=0, key=key))


def test_vehicle_is_stopped_when_its_adapter_ends() -> None:
    vehicle, ended = RecordingVehicle(), threading.Event()
    ended.set()
    AdapterServer(vehicle, AdapterParams(port=0, key=adapter_key_file())).run(ended)
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
params = AdapterParams(port=0, key={str(adapter_key_file())!r})
one = AdapterServer(found.connect(found.Params(file={str(tmp_path / "log")!r})), params)
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
from scan2sim.services.teleoperation.settings import OnboardParams
from scan2sim.services.teleoperation.vehicle.onboard_unit import OnboardUnit
from tests.fakes.driver import FakeConnection, ScriptedDriver
params = OnboardParams(adapter="127.0.0.1:{port}", key={str(adapter_key_file())!r})
unit, connection, stations = OnboardUnit(params), FakeConnection(), []
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
    monkeypatch.setattr(time, "monotonic", lambda: now + 0.3)
    assert (one.state().speed, one.state().faults) == (None, ())
    monkeypatch.setattr(time, "monotonic", lambda: now + 2)
    assert one.state().faults == ("no messages from the vehicle on teleoperation",)
    one.close()


def test_vehicle_without_a_speed_signal_has_an_unknown_speed(vehicle: Any) -> None:
    one = connect(speed="", gear_in="")
    one.obey(STOP)
    assert one.state() == VehicleState(None)
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


def nodes(pythons: dict[str, str]) -> Nodes:
    """Nodes between adapter and vehicle, and the vehicle, which has ROS 2's own client library if it is installed."""
    other = "rclpy" if "rclpy" in pythons else "cyclone"
    return Nodes({"smoother": "cyclone", "monitor": other, "base": other}, pythons)


@pytest.mark.parametrize("hung", ["smoother", "monitor"])
def test_vehicle_stops_when_a_node_between_hangs(
    network: None, pythons: dict[str, str], start_adapter: Start, hung: str
) -> None:
    with nodes(pythons) as chain:  # a vehicle without a timeout of its own
        one = ros_vehicle(topic="cmd_vel_teleop", output="cmd_vel", odometry="odom")
        _, peer = start_adapter(one)
        peer.until(lambda: math.isfinite(one._output._received))  # all are connected
        peer.start()
        peer.until(lambda: chain.moves and (one.state().speed or 0) > 0.9)
        began = chain.hang(hung)
        peer.until(lambda: not chain.moves)
        assert 0 < chain.since - began < 1.5  # 0.3 s on a quiet machine
        peer.until(lambda: not peer.driven)
        answer = peer.end.answer
        assert answer is not None and answer.reason == "nothing is published on /cmd_vel: check the nodes before it"
        chain.wake(hung)
        for _ in range(100):
            peer.exchange()
        assert not chain.moves  # it drives again only when the driver confirms
        peer.start()
        peer.until(lambda: chain.moves)


def test_stop_passes_through_the_nodes_between(network: None, pythons: dict[str, str], start_adapter: Start) -> None:
    with nodes(pythons) as chain:
        one = ros_vehicle(topic="cmd_vel_teleop", output="cmd_vel", joint_states="joint_states", odometry="")
        _, peer = start_adapter(one)
        peer.until(lambda: math.isfinite(one._output._received))  # all are connected
        peer.start()
        peer.until(lambda: (one.state().speed or 0) == pytest.approx(1.0))  # measured by the wheels
        peer.until(lambda: not chain.moves, STOP)
        peer.until(lambda: one.state().speed == 0.0, STOP)
        time.sleep(2.0)  # the monitor ceases to publish
        peer.start()
        peer.until(lambda: chain.moves)


def twist(speed: float) -> Any:
    message = transport.load("cyclone").message("geometry_msgs/msg/Twist")
    message.linear.x = speed
    return message


def test_nodes_that_ignore_a_stop_are_overridden() -> None:
    sent: list[Any] = []

    class Publisher:
        def publish(self, message: Any) -> None:
            sent.append(message)

    params = ros_adapter.Params(topic="a", output="b", stop_within=0.5)
    output, now = ros_adapter.Output(params, Publisher()), time.monotonic()
    output.receive(twist(1.0))
    output.enforce(twist(1.0), now)
    output.enforce(twist(0.0), now + 0.1)
    output.receive(twist(0.9))
    output.enforce(twist(0.0), now + 0.2)
    assert not sent  # it may decelerate
    output.enforce(twist(0.0), now + 0.7)
    output.receive(sent[-1])
    output.enforce(twist(0.0), now + 0.71)
    assert [message.linear.x for message in sent] == [0.0, 0.0]  # until something else is commanded
    output.enforce(twist(1.0), now + 0.72)
    output.receive(twist(0.0))
    assert output.holds(now + 2) and len(sent) == 2  # a collision monitor's stop is reported


def test_commands_and_output_need_different_topics() -> None:
    with pytest.raises(SettingError, match="topic of the commands as well"):
        adapters.find("ros").Params.of("", {"topic": "cmd_vel", "output": "/cmd_vel"})


def test_documented_parameters_of_nav2_connect_adapter_and_vehicle() -> None:
    text = (EXAMPLE_DBC.parent / "nav2.yaml").read_text(encoding="utf-8")
    page = (ROOT / "docs" / "teleoperation-ros.md").read_text(encoding="utf-8")
    assert f"```yaml\n{text}```" in page
    nodes = {name: one["ros__parameters"] for name, one in yaml.safe_load(text).items()}
    monitor, smoother = nodes["collision_monitor"], nodes["velocity_smoother"]
    assert "-r cmd_vel:=cmd_vel_teleop" in page and "--set topic=cmd_vel_teleop --set output=cmd_vel" in page
    assert (monitor["cmd_vel_in_topic"], monitor["cmd_vel_out_topic"]) == ("cmd_vel_smoothed", "cmd_vel")
    assert nodes["lifecycle_manager_teleoperation"]["node_names"] == ["velocity_smoother", "collision_monitor"]
    assert f"`velocity_timeout` | {smoother['velocity_timeout']} s" in page
    assert f"`source_timeout` | {monitor['source_timeout']} s" in page
    full = ros_adapter.Params()
    assert full.speed / -smoother["max_decel"][0] < full.stop_within  # a normal stop isn't overridden
