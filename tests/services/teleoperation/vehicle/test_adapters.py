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
from types import SimpleNamespace
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
from scan2sim.services.teleoperation.vehicle.adapters.can import EXAMPLE_DBC, REOPEN_DELAY_S, CanVehicle
from scan2sim.services.teleoperation.vehicle.adapters.ros import MESSAGE_TYPES, ODOMETRY_TYPE
from tests.conftest import ROOT
from tests.fakes.nav2_nodes import Nodes
from tests.fakes.vehicle import GO, LockstepPeer, OnboardPeer, RecordingVehicle, adapter_key_file
from tests.fakes.virtual_clock import VirtualClock
from tests.waiting import until

LIMIT = 200


Start = Callable[..., tuple[AdapterServer, OnboardPeer]]


@pytest.fixture
def start_adapter() -> Iterator[Start]:
    """Starts an adapter of a vehicle, and an onboard endpoint that talks to it over the network."""
    ended, threads = threading.Event(), []

    def started(vehicle: Any, **params: Any) -> tuple[AdapterServer, OnboardPeer]:
        one = AdapterServer(vehicle, AdapterParams(port=0, limit=LIMIT, key=adapter_key_file(), **params))
        threads.append(threading.Thread(target=one.run, args=(ended,)))
        threads[-1].start()
        return one, OnboardPeer(("127.0.0.1", one.address[1]), adapter_key.read(adapter_key_file()))

    yield started
    ended.set()
    for thread in threads:
        thread.join()


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def lockstep(clock: VirtualClock) -> Iterator[Callable[[Any], LockstepPeer]]:
    """An onboard endpoint in lockstep with the adapter of a given vehicle, in virtual time."""
    servers: list[AdapterServer] = []

    def connected(vehicle: Any) -> LockstepPeer:
        params = AdapterParams(port=0, limit=LIMIT, key=adapter_key_file())
        servers.append(AdapterServer(vehicle, params, clock=clock.ns))
        return LockstepPeer(servers[-1], adapter_key.read(adapter_key_file()), clock)

    yield connected
    ended = threading.Event()
    ended.set()
    for server in servers:
        server.run(ended)


Lockstep = Callable[[Any], LockstepPeer]


def test_vehicle_stops_when_the_onboard_unit_falls_silent(lockstep: Lockstep, clock: VirtualClock) -> None:
    vehicle = RecordingVehicle(clock=clock)
    peer = lockstep(vehicle)
    peer.until(lambda: len(vehicle.received) > 10)
    assert all(controls.brake == 1 for _, controls in vehicle.received)
    peer.start()
    peer.until(vehicle.moves)
    assert vehicle.received[-1][1] == GO
    silent = clock()
    peer.hang(2 * LIMIT / 1000)
    stopped = next(at for at, controls in vehicle.received if at > silent and controls.brake == 1)
    assert LIMIT / 1000 - 0.02 <= stopped - silent <= LIMIT / 1000 + 0.011  # the last order was up to 20 ms old
    peer.until(lambda: not peer.driven)  # the onboard unit is notified, and requires a confirmation
    for _ in range(200):
        peer.exchange()
    assert not vehicle.moves()
    peer.start()
    peer.until(vehicle.moves)


@pytest.mark.parametrize("seconds", [0.1, 1.0])
def test_stalled_adapter_obeys_no_old_order(lockstep: Lockstep, clock: VirtualClock, seconds: float) -> None:
    vehicle = RecordingVehicle(clock=clock)
    peer = lockstep(vehicle)
    peer.start()
    peer.until(vehicle.moves)
    waiting = []
    for _ in range(round(seconds * 100)):  # its onboard unit continues
        clock.sleep(0.01)
        waiting.append(peer.order(GO))
    for packet in waiting:
        assert peer.server.answer(packet) is not None
    peer.server.control()
    assert vehicle.moves() == (seconds * 1000 < LIMIT)


def test_unreachable_vehicle_is_a_stop_that_the_driver_confirms(lockstep: Lockstep, clock: VirtualClock) -> None:
    vehicle = RecordingVehicle(clock=clock)
    peer = lockstep(vehicle)
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


FOREIGN_KEYS = pytest.mark.parametrize("key", [b"x" * 32, b""], ids=["another key", "no key"])


@FOREIGN_KEYS
def test_malformed_and_foreign_packets_are_not_obeyed(lockstep: Lockstep, clock: VirtualClock, key: bytes) -> None:
    vehicle = RecordingVehicle(clock=clock)
    peer = lockstep(vehicle)
    stranger = LockstepPeer(peer.server, key, clock)
    peer.start()
    stranger.driven = True
    for _ in range(20):
        stranger.exchange(STOP)
        assert peer.server.answer(os.urandom(40)) is None
        peer.exchange()
    assert vehicle.moves() and stranger.end.answer is None and peer.server.malformed == 40


@FOREIGN_KEYS
def test_adapter_answers_its_onboard_unit_on_the_network_and_no_stranger(start_adapter: Start, key: bytes) -> None:
    vehicle = RecordingVehicle()
    server, peer = start_adapter(vehicle, host="0.0.0.0")
    stranger = OnboardPeer(("127.0.0.1", server.address[1]), key)
    peer.drive_until(vehicle.moves)
    for _ in range(20):
        stranger.exchange()
        stranger.socket.send(os.urandom(40))
    peer.until(lambda: server.malformed == 40)
    assert stranger.end.answer is None
    peer.drive_until(vehicle.moves)


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
params = AdapterParams(port=0, limit=5000, key={str(adapter_key_file())!r})
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
import time
from scan2sim.services.teleoperation.settings import OnboardParams
from scan2sim.services.teleoperation.vehicle.onboard_unit import OnboardUnit
from tests.fakes.driver import FakeConnection, RunningDriver
params = OnboardParams(adapter="127.0.0.1:{port}", limit=5000, key={str(adapter_key_file())!r})
unit, connection, drivers = OnboardUnit(params), FakeConnection(), []
unit.join(lambda received, restarted: drivers.append(RunningDriver(connection, received)) or connection)
drivers[0].until(lambda: connection.has_telemetry() and not connection.telemetry().standing)
drivers[0].confirms = False
print("drives", flush=True)
drivers[0].until(lambda: connection.telemetry().standing)
print("stands", flush=True)
time.sleep(600)
"""
    unit = subprocess.Popen(
        [sys.executable, "-c", hanging], stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    log = tmp_path / "log"

    def lines() -> list[str]:
        return log.read_text(encoding="utf-8").splitlines()

    try:
        assert unit.stdout is not None and unit.stdout.readline() == "drives\n"
        until(lambda: lines()[-1:] == ["1.0 0.0"])
        unit.send_signal(signal.SIGSTOP)
        until(lambda: lines()[-1:] == ["0.0 1.0"])
        stopped = len(lines())
        unit.send_signal(signal.SIGCONT)  # it continues, with the throttle still pressed
        assert unit.stdout.readline() == "stands\n"
        noticed = len(lines())
        until(lambda: len(lines()) > noticed + 50)
        assert set(lines()[stopped:-1]) == {"0.0 1.0"}
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


def connect(clock: Callable[[], float] = time.monotonic, **params: Any) -> Any:
    found = adapters.find("can")
    settings = {"interface": "virtual", "channel": "teleoperation"} | params
    return CanVehicle(found.Params.of("", settings), clock=clock)  # type: ignore[arg-type]


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


def test_vehicle_reports_speed_and_gear_or_its_silence(vehicle: Any, clock: VirtualClock) -> None:
    one = connect(clock)
    described: Any = cantools.database.load_file(EXAMPLE_DBC)
    vehicle.send(can.Message(arbitration_id=99, data=b"123", is_extended_id=False))
    vehicle.send(can.Message(arbitration_id=512, data=b"1", is_extended_id=False))
    data = described.encode_message("Motion", {"Speed": -18.0, "GearIn": "Reverse"})
    vehicle.send(can.Message(arbitration_id=512, data=data, is_extended_id=False))
    one.obey(STOP)
    assert one.state() == VehicleState(-5.0, gear=Gear.REVERSE)
    clock.sleep(0.3)
    assert (one.state().speed, one.state().faults) == (None, ())
    clock.sleep(1.7)
    assert one.state().faults == ("no messages from the vehicle on teleoperation",)
    one.close()


def test_vehicle_without_a_speed_signal_has_an_unknown_speed(vehicle: Any) -> None:
    one = connect(speed="", gear_in="")
    one.obey(STOP)
    assert one.state() == VehicleState(None)
    one.close()


def test_lost_bus_is_reported_and_opened_again(
    vehicle: Any, clock: VirtualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = connect(clock)
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
    with pytest.raises(VehicleUnreachable):
        one.obey(STOP)  # it is opened again only after a pause
    clock.sleep(REOPEN_DELAY_S)
    one.obey(STOP)
    assert newest_signals(vehicle)["Brake"] == 100
    one.close()


def test_stop_reaches_the_bus_when_the_onboard_unit_falls_silent(
    vehicle: Any, lockstep: Lockstep, clock: VirtualClock
) -> None:
    peer = lockstep(connect(clock))
    peer.start()
    peer.until(lambda: newest_signals(vehicle).get("Throttle") == 100)
    peer.hang(2 * LIMIT / 1000)
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


def ros_vehicle(clock: Callable[[], float] = time.monotonic, **params: Any) -> Any:
    return ros_adapter.RosVehicle(ros_adapter.Params.of("", params), clock=clock)


@pytest.mark.parametrize(
    ("message", "read_command"),
    [
        ("twist", lambda m: (m.linear.x, m.angular.z)),
        ("twist_stamped", lambda m: (m.twist.linear.x, m.twist.angular.z)),
        ("ackermann", lambda m: (m.drive.speed, m.drive.steering_angle)),
    ],
)
def test_controls_are_published_as_ros_messages(
    network: None, clock: VirtualClock, message: str, read_command: Callable[[Any], tuple[float, float]]
) -> None:
    one = ros_vehicle(clock, message=message, speed=2.0, angle=0.5, wheelbase=1.0)
    with pytest.raises(VehicleUnreachable, match="nothing subscribes to /cmd_vel"):
        one.obey(STOP)
    ros = transport.load()
    robot = ros.Node("robot")
    newest: list[tuple[float, float]] = []
    robot.create_subscription(
        ros.message_type(MESSAGE_TYPES[message]), "cmd_vel", lambda m: newest.append(read_command(m)), 10
    )
    odometry = robot.create_publisher(ros.message_type(ODOMETRY_TYPE), "odom", 10)
    expected = ros.message(ODOMETRY_TYPE)
    expected.pose.pose.position.x, expected.pose.pose.orientation.z, expected.pose.pose.orientation.w = 3.0, 1.0, 0.0
    expected.twist.twist.linear.x = -1.5

    def receives(controls: Controls, command: tuple[float, float]) -> bool:
        odometry.publish(expected)
        with contextlib.suppress(VehicleUnreachable):
            one.obey(controls)
        ros.spin_once(robot, 0.01)
        return newest[-1:] == [pytest.approx(command)] and one.state().position is not None

    turn = 0.25 if message == "ackermann" else math.tan(0.25) * -1.0
    braked_turn = 0.25 if message == "ackermann" else math.tan(0.25) * -0.5
    for controls, command in (
        (Controls(0.5, 0.5, 0.0, Gear.REVERSE), (-1.0, turn)),
        (Controls(0.5, 0.5, 0.5, Gear.REVERSE), (-0.5, braked_turn)),
        (STOP, (0.0, 0.0)),
    ):
        until(lambda: receives(controls, command), what=f"{command}", state=lambda: newest[-1:])  # noqa: B023
    state = one.state()
    assert (state.speed, state.position, state.faults) == (-1.5, (3.0, 0.0), ())
    assert state.heading is not None and abs(state.heading) == pytest.approx(math.pi)
    robot.destroy_node()
    one.close()


def test_missing_odometry_is_reported(network: None, clock: VirtualClock) -> None:
    one = ros_vehicle(clock)
    assert one.state().faults == ()
    clock.sleep(2)
    assert one.state().faults == ("no odometry on /odom",)
    one.close()


def nodes(pythons: dict[str, str]) -> Nodes:
    """Nodes between adapter and vehicle, and the vehicle, which has ROS 2's own client library if it is installed."""
    other = "rclpy" if "rclpy" in pythons else "cyclone"
    return Nodes({"smoother": "cyclone", "monitor": other, "base": other}, pythons)


@pytest.mark.realtime
@pytest.mark.parametrize("hung", ["smoother", "monitor"])
def test_vehicle_stops_when_a_node_between_hangs(
    network: None, pythons: dict[str, str], start_adapter: Start, hung: str
) -> None:
    with nodes(pythons) as chain:  # a vehicle without a timeout of its own
        one = ros_vehicle(topic="cmd_vel_teleop", output="cmd_vel", odometry="odom")
        _, peer = start_adapter(one)
        peer.drive_until(lambda: chain.moves and (one.state().speed or 0) > 0.9)
        chain.hang(hung)
        peer.drive_until(lambda: not chain.moves)
        silent = "nothing is published on /cmd_vel: check the nodes before it"
        peer.drive_until(lambda: peer.end.answer is not None and peer.end.answer.reason == silent)
        peer.until(lambda: not peer.driven and not one._output._moves)
        chain.wake(hung)
        peer.until(chain.stop_has_passed)  # what it missed came before
        for _ in range(50):
            peer.exchange()
        assert not chain.moves  # it drives again only when the driver confirms
        peer.drive_until(lambda: chain.moves)


@pytest.mark.realtime
def test_stop_passes_through_the_nodes_between(network: None, pythons: dict[str, str], start_adapter: Start) -> None:
    with nodes(pythons) as chain:
        one = ros_vehicle(topic="cmd_vel_teleop", output="cmd_vel", joint_states="joint_states", odometry="")
        _, peer = start_adapter(one)
        peer.drive_until(lambda: (one.state().speed or 0) == pytest.approx(1.0))  # measured by the wheels
        peer.until(lambda: not chain.moves, STOP)
        peer.until(lambda: one.state().speed == 0.0, STOP)
        peer.until(lambda: time.monotonic() - one._output._received > 0.5, STOP)  # the monitor ceases to publish
        peer.drive_until(lambda: chain.moves)


def twist(speed: float) -> Any:
    message = transport.load("cyclone").message("geometry_msgs/msg/Twist")
    message.linear.x = speed
    return message


def test_nodes_that_ignore_a_stop_are_overridden(clock: VirtualClock) -> None:
    sent: list[Any] = []

    class Publisher:
        def publish(self, message: Any) -> None:
            sent.append(message)

    params = ros_adapter.Params(topic="a", output="b", stop_within=0.5)
    output = ros_adapter.Output(params, Publisher(), clock=clock)
    output.receive(twist(1.0))
    output.enforce(twist(1.0), clock())
    clock.sleep(0.1)
    output.enforce(twist(0.0), clock())
    output.receive(twist(0.9))
    clock.sleep(0.1)
    output.enforce(twist(0.0), clock())
    assert not sent  # it may decelerate
    clock.sleep(0.5)
    output.enforce(twist(0.0), clock())
    output.receive(sent[-1])
    clock.sleep(0.01)
    output.enforce(twist(0.0), clock())
    assert [message.linear.x for message in sent] == [0.0, 0.0]  # until something else is commanded
    clock.sleep(0.01)
    output.enforce(twist(1.0), clock())
    output.receive(twist(0.0))
    assert output.holds(clock() + 2) and len(sent) == 2  # a collision monitor's stop is reported


def test_nodes_that_fall_silent_stop_the_vehicle(clock: VirtualClock) -> None:
    sent: list[Any] = []
    publisher: Any = SimpleNamespace(publish=sent.append)
    output = ros_adapter.Output(ros_adapter.Params(topic="a", output="b"), publisher, clock=clock)
    for _ in range(100):
        output.receive(twist(1.0))
        clock.sleep(0.01)
        output.enforce(twist(1.0), clock())
    clock.sleep(ros_adapter.OUTPUT_TIMEOUT_S - 0.02)
    output.enforce(twist(1.0), clock())
    clock.sleep(0.02)
    with pytest.raises(VehicleUnreachable, match="nothing is published on /b"):
        output.enforce(twist(1.0), clock())
    assert not sent
    output.enforce(twist(0.0), clock())  # the adapter's stop
    assert [message.linear.x for message in sent] == [0.0]


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
