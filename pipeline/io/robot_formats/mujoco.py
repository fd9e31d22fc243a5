"""Robot for MuJoCo: `robot.xml`, included by the world: a body, velocity actuators, camera, IMU, a site for the lidar.

Actuators `left_wheel` and `right_wheel` take radians per second. The lidar is a site from which programs cast rays with
`mj_multiRay` (docs/simulators.md): MuJoCo's rangefinders would cast each ray separately in every simulation step.
"""

from __future__ import annotations

from math import degrees
from pathlib import Path

from scipy.spatial.transform import Rotation

from scan2sim.pipeline.io.worlds.sdf import numbers
from scan2sim.pipeline.simulation.robot import Box, Link, Robot, Sphere, Start

VELOCITY_GAIN = 5.0
"""Gain of the velocity actuators: newton metres per radian per second of velocity error."""


def write(robot: Robot, start: Start, folder: Path) -> None:
    """Write the robot at its start pose."""
    w, x, y, z = Rotation.from_euler("xyz", start.angles).as_quat(scalar_first=True).tolist()
    driven = set(robot.wheels)
    fixed = "".join(_geom(link, link.place) for link in robot.links if link not in driven)
    wheels = "".join(_wheel(link) for link in robot.wheels)
    (folder / f"{robot.name}.xml").write_text(
        f"""<mujoco model="{robot.name}">
  <compiler angle="radian"/>
  <worldbody>
    <body name="{robot.name}" pos="{numbers(start.position)}" quat="{w:.9f} {x:.9f} {y:.9f} {z:.9f}">
      <freejoint name="{robot.name}"/>
{fixed}{_sensors(robot)}{wheels}    </body>
  </worldbody>
  <actuator>
{"".join(_motor(robot, link) for link in robot.wheels)}  </actuator>
  <sensor>
    <gyro name="gyro" site="imu"/>
    <accelerometer name="accelerometer" site="imu"/>
  </sensor>
</mujoco>
""",
        encoding="ascii",
    )


def _geom(link: Link, position: tuple[float, float, float]) -> str:
    shape, axis = link.shape, ""
    if isinstance(shape, Box):
        kind, size = "box", numbers(side / 2 for side in shape.size)
    elif isinstance(shape, Sphere):
        kind, size = "sphere", f"{shape.radius:g}"
    else:
        kind, size = "cylinder", f"{shape.radius:g} {shape.length / 2:g}"
        axis = ' zaxis="0 1 0"' if shape.axis == "y" else ""
    return f"""      <geom name="{link.name}" type="{kind}" size="{size}" pos="{numbers(position)}"{axis}
        mass="{link.mass:g}" friction="{link.friction:g} 0.005 0.0001" priority="1" rgba="{numbers(link.colour)} 1"/>
"""


def _wheel(link: Link) -> str:
    return f"""      <body name="{link.name}" pos="{numbers(link.place)}">
        <joint name="{link.name}" type="hinge" axis="0 1 0"/>
  {_geom(link, (0.0, 0.0, 0.0))}      </body>
"""


def _motor(robot: Robot, link: Link) -> str:
    max_rate, max_torque = 2 * robot.speed / robot.wheel_radius, robot.torque
    return f"""    <velocity name="{link.name}" joint="{link.name}" kv="{VELOCITY_GAIN:g}"
      ctrlrange="{-max_rate:.4g} {max_rate:.4g}" forcerange="{-max_torque:g} {max_torque:g}"/>
"""


def _sensors(robot: Robot) -> str:
    """Camera, IMU and lidar site; a MuJoCo camera looks along -z."""
    x, y, z = robot.link(robot.camera.link).place
    lidar = numbers(robot.link(robot.lidar.link).place)
    return f"""      <camera name="camera" pos="{numbers((x + robot.camera.ahead, y, z))}" xyaxes="0 -1 0 0 0 1"
        fovy="{degrees(robot.camera.vertical_fov):.6g}" resolution="{robot.camera.width} {robot.camera.height}"/>
      <site name="imu"/>
      <site name="lidar" pos="{lidar}"/>
"""
