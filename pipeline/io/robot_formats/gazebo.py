"""Gazebo: `models/robot/`, a model with its drive and sensors; the world includes it.

It listens to `/cmd_vel` and tells `/odom`, `/tf`, `/joint_states`, `/camera`, `/labels`, `/lidar`, `/imu`. `/labels` is
a segmentation camera in the camera's place: what it shows are the world's labels.
"""

from __future__ import annotations

from math import pi
from pathlib import Path

from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.worlds.sdf import numbers, write_config
from scan2sim.pipeline.simulation.robot import Box, Link, Robot, Sphere, Start

LABELS = 5.0
"""Labelled pictures a second."""


def write(robot: Robot, start: Start, folder: Path) -> None:
    """Write the model; the world places it."""
    place = folder / "models" / robot.name
    make_folder(place)
    parts = "".join(_link(robot, link) for link in robot.links) + "".join(_joint(robot, link) for link in robot.joined)
    (place / "model.sdf").write_text(
        f"""<?xml version="1.0"?>
<sdf version="1.9">
  <model name="{robot.name}">
{parts}{_drive(robot)}  </model>
</sdf>
""",
        encoding="ascii",
    )
    write_config(place, robot.name, "A small robot with two driven wheels, camera, lidar and IMU.")


def _link(robot: Robot, link: Link) -> str:
    frame = "" if link is robot.base else f"      <pose>{numbers(link.place)} 0 0 0</pose>\n"
    middle = f"<pose>{numbers(robot.within(link))} 0 0 0</pose>"
    x, y, z = link.inertia
    red_green_blue = numbers(link.colour)
    return f"""    <link name="{link.name}">
{frame}      <inertial>
        {middle}
        <mass>{link.mass:g}</mass>
        <inertia><ixx>{x:.8f}</ixx><iyy>{y:.8f}</iyy><izz>{z:.8f}</izz></inertia>
      </inertial>
      <visual name="visual">
        {_shape(robot, link)}
        <material><ambient>{red_green_blue} 1</ambient><diffuse>{red_green_blue} 1</diffuse></material>
      </visual>
      <collision name="collision">
        {_shape(robot, link)}
        <surface>
          <friction>
            <ode><mu>{link.friction:g}</mu><mu2>{link.friction:g}</mu2></ode>
            <bullet><friction>{link.friction:g}</friction><friction2>{link.friction:g}</friction2></bullet>
          </friction>
        </surface>
      </collision>
{_sensors(robot, link)}    </link>
"""


def _shape(robot: Robot, link: Link) -> str:
    """Of a visual or a collision, and where it is in its link."""
    shape, turned = link.shape, 0.0
    if isinstance(shape, Box):
        form = f"<box><size>{numbers(shape.size)}</size></box>"
    elif isinstance(shape, Sphere):
        form = f"<sphere><radius>{shape.radius:g}</radius></sphere>"
    else:
        form = f"<cylinder><radius>{shape.radius:g}</radius><length>{shape.length:g}</length></cylinder>"
        turned = -pi / 2 if shape.axis == "y" else 0.0
    return f"<pose>{numbers(robot.within(link))} {turned:.8g} 0 0</pose>\n        <geometry>{form}</geometry>"


def _joint(robot: Robot, link: Link) -> str:
    ends = f"<parent>{robot.base.name}</parent>\n      <child>{link.name}</child>"
    if not link.driven:
        return f"""    <joint name="{link.name}_joint" type="fixed">
      {ends}
    </joint>
"""
    return f"""    <joint name="{link.name}_joint" type="revolute">
      {ends}
      <axis><xyz>0 1 0</xyz><limit><effort>{robot.torque:g}</effort></limit></axis>
    </joint>
"""


def _sensors(robot: Robot, link: Link) -> str:
    """Those that a link carries."""
    if link is robot.base:
        return _sensor("imu", "imu", robot.imu_rate, "<imu/>")
    if link.name == robot.camera.link:
        ahead = f"<pose>{robot.camera.ahead:g} 0 0 0 0 0</pose>\n        "
        labelled = "<segmentation_type>semantic</segmentation_type>"
        return _sensor("camera", "camera", robot.camera.rate, ahead + _camera(robot, "")) + _sensor(
            "segmentation", "labels", LABELS, ahead + _camera(robot, labelled)
        )
    return _sensor("gpu_lidar", "lidar", robot.lidar.rate, _lidar(robot)) if link.name == robot.lidar.link else ""


def _sensor(kind: str, topic: str, rate: float, content: str) -> str:
    return f"""      <sensor name="{topic}" type="{kind}">
        {content}
        <topic>{topic}</topic>
        <update_rate>{rate:g}</update_rate>
        <always_on>true</always_on>
      </sensor>
"""


def _camera(robot: Robot, more: str) -> str:
    own = robot.camera
    return f"""<camera>
          {more}<horizontal_fov>{own.across:.8g}</horizontal_fov>
          <image><width>{own.width}</width><height>{own.height}</height></image>
          <clip><near>{own.nearest:g}</near><far>{own.farthest:g}</far></clip>
        </camera>"""


def _lidar(robot: Robot) -> str:
    own = robot.lidar
    half = pi - pi / own.around
    return f"""<lidar>
          <scan>
            <horizontal>
              <samples>{own.around}</samples><resolution>1</resolution>
              <min_angle>{-half:.8g}</min_angle><max_angle>{half:.8g}</max_angle>
            </horizontal>
            <vertical>
              <samples>{own.rings}</samples><resolution>1</resolution>
              <min_angle>{own.lowest:.8g}</min_angle><max_angle>{own.highest:.8g}</max_angle>
            </vertical>
          </scan>
          <range><min>{own.nearest:g}</min><max>{own.farthest:g}</max><resolution>0.001</resolution></range>
          <noise><type>gaussian</type><mean>0</mean><stddev>{own.noise:g}</stddev></noise>
        </lidar>"""


def _drive(robot: Robot) -> str:
    left, right = robot.wheels
    return f"""    <plugin filename="gz-sim-diff-drive-system" name="gz::sim::systems::DiffDrive">
      <left_joint>{left.name}_joint</left_joint>
      <right_joint>{right.name}_joint</right_joint>
      <wheel_separation>{robot.track:g}</wheel_separation>
      <wheel_radius>{robot.wheel_radius:g}</wheel_radius>
      <max_linear_velocity>{robot.speed:g}</max_linear_velocity>
      <min_linear_velocity>{-robot.speed:g}</min_linear_velocity>
      <max_linear_acceleration>{robot.acceleration:g}</max_linear_acceleration>
      <min_linear_acceleration>{-robot.acceleration:g}</min_linear_acceleration>
      <topic>cmd_vel</topic>
      <odom_topic>odom</odom_topic>
      <tf_topic>tf</tf_topic>
      <frame_id>odom</frame_id>
      <child_frame_id>{robot.base.name}</child_frame_id>
    </plugin>
    <plugin filename="gz-sim-joint-state-publisher-system" name="gz::sim::systems::JointStatePublisher">
      <topic>joint_states</topic>
    </plugin>
"""
