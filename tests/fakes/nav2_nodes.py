"""Nodes before a ROS 2 vehicle that behave as Nav2's velocity smoother and collision monitor, and the vehicle.

`python -m tests.fakes.nav2_nodes smoother|monitor|base`: topics `cmd_vel_teleop` -> `cmd_vel_smoothed` -> `cmd_vel`,
type `Twist`. As in Nav2's sources the smoother publishes 20 times per second, limits acceleration, decelerates to 0
after `velocity_timeout` (1 s) without commands, then is silent; the monitor publishes only when it receives a command,
and ceases to publish zeros 1 s after a stop. The base drives at the last command for ever, and prints a line with the
time and the commanded speed, m/s, when that changes between motion and standstill.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
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
    received = time.monotonic()

    def receive(message: Any) -> None:
        nonlocal target, received
        target, received = float(message.linear.x), time.monotonic()

    def smooth() -> None:
        nonlocal target, passed
        if time.monotonic() - received > VELOCITY_TIMEOUT_S:
            if passed == 0.0:
                return
            target = 0.0
        step = ACCELERATION / SMOOTHING_HZ
        passed += min(max(target - passed, -step), step)
        message = ros.message(TWIST)
        message.linear.x = passed
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
        value = float(message.linear.x)
        if (value == 0) != (speed == 0):
            print(time.monotonic(), value, flush=True)
        speed = value

    def measure() -> None:
        message = ros.message(ODOMETRY)
        message.twist.twist.linear.x, message.pose.pose.orientation.w = speed, 1.0
        odometry.publish(message)
        joints.publish(joint_state(ros, speed))

    node.create_subscription(ros.message_type(TWIST), "cmd_vel", receive, QoS(depth=1))
    node.create_timer(0.02, measure)


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
        self.processes = {
            role: subprocess.Popen(
                [pythons[name], "-m", "tests.fakes.nav2_nodes", role],
                env=os.environ | {"PYTHONPATH": str(ROOT), "SCAN2SIM_TRANSPORT": name},
                stdout=subprocess.PIPE,
                text=True,
            )
            for role, name in transports.items()
        }
        threading.Thread(target=self._read, daemon=True).start()

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

    def _read(self) -> None:
        stdout = self.processes["base"].stdout
        assert stdout is not None
        for line in stdout:
            since, speed = map(float, line.split())
            self.moves, self.since = speed != 0, since


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
