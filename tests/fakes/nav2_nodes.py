"""Nodes before a ROS 2 vehicle that behave as Nav2's velocity smoother and collision monitor, and the vehicle.

`python -m tests.fakes.nav2_nodes smoother|monitor|base`: topics `cmd_vel_teleop` -> `cmd_vel_smoothed` -> `cmd_vel`,
type `Twist`. As in Nav2's sources the smoother publishes 20 times per second, limits acceleration, decelerates to 0
after `velocity_timeout` (1 s) without commands, then is silent; the monitor publishes only when it receives a command,
and ceases to publish zeros 1 s after a stop. The base drives at the last command for ever.
The smoother numbers its messages in `linear.z`. Smoother and base print a line for each message that they send or
receive: time, commanded speed (m/s), number (0: not from the smoother).
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.services import transport
from scan2sim.services.transport import QoS

ROOT = Path(__file__).resolve().parents[2]
TWIST, ODOMETRY, JOINT_STATE = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState"
SMOOTHING_HZ, ACCELERATION, VELOCITY_TIMEOUT_S, STOP_PUB_TIMEOUT_S = 20.0, 2.5, 1.0, 1.0
WHEEL_RADIUS_M = 0.165


def smoother(ros: Any, node: Any) -> None:
    """Limit the acceleration of `cmd_vel_teleop`."""
    publisher = node.create_publisher(ros.message_type(TWIST), "cmd_vel_smoothed", QoS(depth=1))
    target = passed = 0.0
    received, number = time.monotonic(), 0

    def receive(message: Any) -> None:
        nonlocal target, received
        target, received = float(message.linear.x), time.monotonic()

    def smooth() -> None:
        nonlocal target, passed, number
        if time.monotonic() - received > VELOCITY_TIMEOUT_S:
            if passed == 0.0:
                return
            target = 0.0
        step = ACCELERATION / SMOOTHING_HZ
        passed += min(max(target - passed, -step), step)
        number += 1
        message = ros.message(TWIST)
        message.linear.x, message.linear.z = passed, float(number)
        print_command(message)
        publisher.publish(message)

    node.create_subscription(ros.message_type(TWIST), "cmd_vel_teleop", receive, QoS(depth=1))
    node.create_timer(1 / SMOOTHING_HZ, smooth)


def monitor(ros: Any, node: Any) -> None:
    """Pass `cmd_vel_smoothed` on."""
    publisher = node.create_publisher(ros.message_type(TWIST), "cmd_vel", QoS(depth=1))
    stopped: float | None = None

    def receive(message: Any) -> None:
        nonlocal stopped
        now = time.monotonic()
        stopped = None if message.linear.x else now if stopped is None else stopped
        if stopped is None or now - stopped <= STOP_PUB_TIMEOUT_S:
            publisher.publish(message)

    node.create_subscription(ros.message_type(TWIST), "cmd_vel_smoothed", receive, QoS(depth=1))


def base(ros: Any, node: Any) -> None:
    """Drive at `cmd_vel`, and publish odometry and joint states."""
    odometry = node.create_publisher(ros.message_type(ODOMETRY), "odom", QoS(depth=1))
    joints = node.create_publisher(ros.message_type(JOINT_STATE), "joint_states", QoS(depth=1))
    speed = 0.0

    def receive(message: Any) -> None:
        nonlocal speed
        print_command(message)
        speed = float(message.linear.x)

    def measure() -> None:
        message = ros.message(ODOMETRY)
        message.twist.twist.linear.x, message.pose.pose.orientation.w = speed, 1.0
        odometry.publish(message)
        joints.publish(joint_state(ros, speed))

    node.create_subscription(ros.message_type(TWIST), "cmd_vel", receive, QoS(depth=1))
    node.create_timer(0.02, measure)


def print_command(message: Any) -> None:
    """Print time, speed and number of a command."""
    print(time.monotonic(), float(message.linear.x), round(message.linear.z), flush=True)


def joint_state(ros: Any, speed: float) -> Any:
    """Joint states of two wheels at a speed."""
    message = ros.message(JOINT_STATE)
    message.name = ["left_wheel_joint", "caster_joint", "right_wheel_joint"]
    message.velocity = np.array([speed / WHEEL_RADIUS_M, 99.0, speed / WHEEL_RADIUS_M])
    return message


ROLES = {"smoother": smoother, "monitor": monitor, "base": base}


class Nodes:
    """The nodes, each a process; a context manager.

    Attributes:
        moves: whether the vehicle is commanded to move; since: since when (monotonic clock).
    """

    def __init__(self, transports: dict[str, str], pythons: Mapping[str, str | Path]) -> None:
        """Start them; `transports`: transport of each role; `pythons`: interpreter of each transport."""
        self.moves, self.since = False, 0.0
        self._stop, self._arrived = math.inf, 0  # number of the smoother's first stop of this standstill; at the base
        self.processes = {
            role: subprocess.Popen(
                [pythons[name], "-m", "tests.fakes.nav2_nodes", role],
                env=os.environ | {"PYTHONPATH": str(ROOT), "SCAN2SIM_TRANSPORT": name},
                stdout=subprocess.PIPE,
                text=True,
            )
            for role, name in transports.items()
        }
        for read in (self._read_smoother, self._read_base):
            threading.Thread(target=read, daemon=True).start()

    def __enter__(self) -> Nodes:
        return self

    def __exit__(self, *raised: object) -> None:
        for process in self.processes.values():
            process.kill()
            process.communicate()

    def hang(self, role: str) -> float:
        """Stop a process without ending it; returns when."""
        self.processes[role].send_signal(signal.SIGSTOP)
        return time.monotonic()

    def wake(self, role: str) -> None:
        """Let it continue."""
        self.processes[role].send_signal(signal.SIGCONT)

    def stop_has_passed(self) -> bool:
        """Whether the smoother publishes stops, and the base has received the first of them or a later one."""
        return self._arrived >= self._stop

    def _read_smoother(self) -> None:
        for _, speed, number in self._commands("smoother"):
            self._stop = math.inf if speed else min(self._stop, number)

    def _read_base(self) -> None:
        for at, speed, number in self._commands("base"):
            if (speed != 0) != self.moves:
                self.moves, self.since = speed != 0, at
            self._arrived = number or self._arrived

    def _commands(self, role: str) -> Iterator[tuple[float, float, int]]:
        """Time, speed and number of each command that a node has printed."""
        stdout = self.processes[role].stdout
        assert stdout is not None
        for line in stdout:
            at, speed, number = line.split()
            yield float(at), float(speed), int(number)


def main() -> None:
    """Run a node until killed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=ROLES)
    role = parser.parse_args().role
    ros = transport.load()
    ros.init()
    node = ros.Node(role)
    ROLES[role](ros, node)
    while True:
        ros.spin_once(node, 0.02)


if __name__ == "__main__":
    main()
