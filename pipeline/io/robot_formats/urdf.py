"""Robot as URDF, for PyBullet and ROS: `robot.urdf`; the driven joints are `left_wheel_joint` and `right_wheel_joint`.

PyBullet loads it in addition to the world, at the position and angles in `metadata.json`. Sensors are links that point
along their x axes; programs request PyBullet's cameras and rays themselves.
"""

from __future__ import annotations

from math import pi
from pathlib import Path

from scan2sim.pipeline.io.worlds.sdf import numbers
from scan2sim.pipeline.simulation.robot import Box, Link, Robot, Sphere, Start


def write(robot: Robot, start: Start, folder: Path) -> None:
    """Write the robot, in its own frame."""
    parts = "".join(_link(robot, link) for link in robot.links) + "".join(
        _joint(robot, link) for link in robot.attached
    )
    text = f'<?xml version="1.0"?>\n<robot name="{robot.name}">\n{parts}</robot>\n'
    (folder / f"{robot.name}.urdf").write_text(text, encoding="ascii")


def _link(robot: Robot, link: Link) -> str:
    x, y, z = link.inertia
    shape = _shape(robot, link)
    return f"""  <link name="{link.name}">
    <inertial>
      <origin xyz="{numbers(robot.centre_in_link(link))}"/>
      <mass value="{link.mass:g}"/>
      <inertia ixx="{x:.8f}" ixy="0" ixz="0" iyy="{y:.8f}" iyz="0" izz="{z:.8f}"/>
    </inertial>
    <visual>
      {shape}
      <material name="{link.name}"><color rgba="{numbers(link.colour)} 1"/></material>
    </visual>
    <collision>
      {shape}
    </collision>
    <contact><lateral_friction value="{link.friction:g}"/></contact>
  </link>
"""


def _shape(robot: Robot, link: Link) -> str:
    """Origin and geometry of a visual or collision in its link."""
    shape, roll = link.shape, 0.0
    if isinstance(shape, Box):
        geometry = f'<box size="{numbers(shape.size)}"/>'
    elif isinstance(shape, Sphere):
        geometry = f'<sphere radius="{shape.radius:g}"/>'
    else:
        geometry = f'<cylinder radius="{shape.radius:g}" length="{shape.length:g}"/>'
        roll = -pi / 2 if shape.axis == "y" else 0.0
    return f"""<origin xyz="{numbers(robot.centre_in_link(link))}" rpy="{roll:.8g} 0 0"/>
      <geometry>{geometry}</geometry>"""


def _joint(robot: Robot, link: Link) -> str:
    axis = ""
    if link.driven:
        max_wheel_rate = robot.speed / robot.wheel_radius
        axis = f'    <axis xyz="0 1 0"/>\n    <limit effort="{robot.torque:g}" velocity="{2 * max_wheel_rate:.4g}"/>\n'
    return f"""  <joint name="{link.name}_joint" type="{"continuous" if link.driven else "fixed"}">
    <parent link="{robot.base.name}"/>
    <child link="{link.name}"/>
    <origin xyz="{numbers(link.place)}" rpy="0 0 0"/>
{axis}  </joint>
"""
