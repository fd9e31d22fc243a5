"""MuJoCo: `robot.xml`, which the world's model includes: a body, velocity actuators, camera, IMU, the lidar's place.

Actuators `left_wheel` and `right_wheel` take radians a second. The lidar is a site, to cast rays from by `mj_multiRay`
(docs/simulators.md): rangefinders would cast them one by one, at every step, through everything.
"""

from __future__ import annotations

from math import degrees
from pathlib import Path

from scipy.spatial.transform import Rotation

from scan2sim.pipeline.io.worlds.sdf import numbers
from scan2sim.pipeline.simulation.robot import Box, Link, Robot, Sphere, Start

GAIN = 5.0
"""Newton metres of a motor for each radian a second that its wheel lacks."""


def write(robot: Robot, start: Start, folder: Path) -> None:
    """Write the robot where it starts."""
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
{fixed}{_eyes(robot)}{wheels}    </body>
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


def _geom(link: Link, place: tuple[float, float, float]) -> str:
    shape, along = link.shape, ""
    if isinstance(shape, Box):
        kind, size = "box", numbers(side / 2 for side in shape.size)
    elif isinstance(shape, Sphere):
        kind, size = "sphere", f"{shape.radius:g}"
    else:
        kind, size = "cylinder", f"{shape.radius:g} {shape.length / 2:g}"
        along = ' zaxis="0 1 0"' if shape.axis == "y" else ""
    return f"""      <geom name="{link.name}" type="{kind}" size="{size}" pos="{numbers(place)}"{along}
        mass="{link.mass:g}" friction="{link.friction:g} 0.005 0.0001" priority="1" rgba="{numbers(link.colour)} 1"/>
"""


def _wheel(link: Link) -> str:
    return f"""      <body name="{link.name}" pos="{numbers(link.place)}">
        <joint name="{link.name}" type="hinge" axis="0 1 0"/>
  {_geom(link, (0.0, 0.0, 0.0))}      </body>
"""


def _motor(robot: Robot, link: Link) -> str:
    fastest, most = 2 * robot.speed / robot.wheel_radius, robot.torque
    return f"""    <velocity name="{link.name}" joint="{link.name}" kv="{GAIN:g}"
      ctrlrange="{-fastest:.4g} {fastest:.4g}" forcerange="{-most:g} {most:g}"/>
"""


def _eyes(robot: Robot) -> str:
    """Camera, lidar and IMU; a camera looks along -z."""
    x, y, z = robot.link(robot.camera.link).place
    lidar = numbers(robot.link(robot.lidar.link).place)
    return f"""      <camera name="camera" pos="{numbers((x + robot.camera.ahead, y, z))}" xyaxes="0 -1 0 0 0 1"
        fovy="{degrees(robot.camera.upright):.6g}" resolution="{robot.camera.width} {robot.camera.height}"/>
      <site name="imu"/>
      <site name="lidar" pos="{lidar}"/>
"""
