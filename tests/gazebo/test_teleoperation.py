"""The exported robot is driven remotely in an exported world: in Gazebo, or in its physics library alone."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.pipeline.simulation.robot import ROBOT
from scan2sim.services import transport
from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.control.controls import STOP, Controls, Gear
from scan2sim.services.teleoperation.vehicle import adapters
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from tests.fakes import synthetic
from tests.fakes.gazebo.checker import SimulatedRobot
from tests.fakes.ports import free_dds_domain
from tests.fakes.vehicle import LIMIT_MS, OnboardPeer, adapter_key_file
from tests.pipeline.io.test_robots import driven

TWIST, ODOMETRY = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry"
STEP_S = 0.02


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = driven(read_scene(synthetic.world(tmp_path_factory.mktemp("scene"), friction=0.9).files["world"]))
    out = tmp_path_factory.mktemp("exported")
    world_formats.write(scene, ["gazebo"], out, SceneParams(), silent, robot=True)
    return next(out.glob("*.sdf"))


@contextmanager
def in_physics_library(world: Path) -> Iterator[None]:
    """The robot in Gazebo's physics, with what the plugin DiffDrive and the bridge to ROS 2 do, in real time."""
    ended = threading.Event()
    ros = transport.load()
    node, wheels = ros.Node("bridge"), [0.0, 0.0]
    odometry = node.create_publisher(ros.message_type(ODOMETRY), "odom", 10)

    def receive(message: Any) -> None:
        wheels[:] = ROBOT.wheel_speeds(float(message.linear.x), float(message.angular.z))

    node.create_subscription(ros.message_type(TWIST), "cmd_vel", receive, 1)

    def run() -> None:
        joints = (f"{ROBOT.wheels[0].name}_joint", f"{ROBOT.wheels[1].name}_joint")
        with SimulatedRobot(world, ROBOT.name, joints) as robot:
            before, due = np.asarray(robot.pose["rest"]), time.monotonic()
            while not ended.is_set():
                ros.spin_once(node, 0.0)
                robot.turn(wheels[0], wheels[1], STEP_S)
                message, position = ros.message(ODOMETRY), np.asarray(robot.pose["rest"])
                q = message.pose.pose.orientation
                q.w, q.x, q.y, q.z = robot.pose["lies"]
                message.pose.pose.position.x, message.pose.pose.position.y = position[:2].tolist()
                forwards = math.copysign(1.0, wheels[0] + wheels[1])
                message.twist.twist.linear.x = forwards * float(np.linalg.norm(position - before)) / STEP_S
                odometry.publish(message)
                before, due = position, max(due + STEP_S, time.monotonic())
                time.sleep(max(due - time.monotonic(), 0))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        node.destroy_node()


@contextmanager
def in_gazebo(world: Path) -> Iterator[None]:
    """Gazebo itself, with its plugin DiffDrive, and its bridge to ROS 2."""
    if not (shutil.which("gz") and shutil.which("ros2")):
        pytest.skip("gz sim and ros_gz_bridge aren't installed")
    bridged = ["/cmd_vel@geometry_msgs/msg/Twist]gz.msgs.Twist", "/odom@nav_msgs/msg/Odometry[gz.msgs.Odometry"]
    environment = os.environ | {"GZ_SIM_RESOURCE_PATH": str(world.parent / "models")}
    commands = [["gz", "sim", "-s", "-r", str(world)], ["ros2", "run", "ros_gz_bridge", "parameter_bridge", *bridged]]
    started = [subprocess.Popen(command, env=environment, start_new_session=True) for command in commands]
    try:
        yield
    finally:
        for one in started:
            os.killpg(one.pid, 9)
            one.wait()


@pytest.mark.realtime
@pytest.mark.parametrize("simulator", [in_physics_library, in_gazebo])
def test_robot_is_driven_remotely_and_stops_without_commands(
    world: Path, simulator: Callable[[Path], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_dds_domain()))
    monkeypatch.setenv("SCAN2SIM_TRANSPORT", "cyclone")
    found, ended = adapters.find("ros"), threading.Event()
    vehicle: Any = found.connect(found.Params.of("", {"speed": 1.0}))
    server = AdapterServer(vehicle, AdapterParams(port=0, limit=LIMIT_MS, key=adapter_key_file()))
    thread = threading.Thread(target=server.run, args=(ended,))
    thread.start()
    try:  # also if the simulator is missing: the next test of this process must not find this one's DDS domain
        with simulator(world):
            _drive(vehicle, OnboardPeer(server.address, adapter_key.read(adapter_key_file())))
    finally:
        ended.set()
        thread.join()


def _drive(vehicle: Any, peer: OnboardPeer) -> None:
    peer.until(lambda: vehicle.state().position is not None)
    x, y = vehicle.state().position
    peer.start()

    def distance() -> float:
        return math.dist(vehicle.state().position, (x, y))

    straight = Controls(throttle=0.5, gear=Gear.FORWARD)
    peer.until(lambda: distance() > 2.0, straight)
    assert vehicle.state().speed == pytest.approx(0.5, abs=0.15)
    heading = vehicle.state().heading
    left = Controls(1.0, throttle=0.5, gear=Gear.FORWARD)
    peer.until(lambda: abs(math.remainder(vehicle.state().heading - heading, math.tau)) > 0.5, left)
    assert math.remainder(vehicle.state().heading - heading, math.tau) > 0  # to the left
    before = distance()
    time.sleep(2.0)  # the onboard unit is silent
    assert abs(vehicle.state().speed) < 0.05 and distance() - before < 0.5
    peer.until(lambda: not peer.driven, STOP)
