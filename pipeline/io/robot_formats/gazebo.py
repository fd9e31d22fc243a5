"""Robot for Gazebo: `models/robot/`, a model with its drive and sensors, which the world includes.

It subscribes to `/cmd_vel` and publishes `/odom`, `/tf`, `/joint_states`, `/camera`, `/labels`, `/lidar`, `/imu`, and
`/ground_truth`, its pose in the world, for nodes that simulate its sensors (docs/camera.md).
`/labels` is a segmentation camera with the pose of the camera; its pixels are the labels of the world.
"""

from __future__ import annotations

from math import pi
from pathlib import Path

from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.worlds.sdf import WITHOUT_BACKDROP, numbers, write_config
from scan2sim.pipeline.simulation.robot import OPTICAL_FRAME, Box, Link, Robot, Sphere, Start

LABELS_RATE_HZ = 5.0
"""Update rate of the segmentation camera."""


def write(robot: Robot, start: Start, folder: Path) -> None:
    """Write the model; the world includes it with its start pose."""
    model_folder = folder / "models" / robot.name
    make_folder(model_folder)
    parts = "".join(_link(robot, link) for link in robot.links) + "".join(
        _joint(robot, link) for link in robot.attached
    )
    (model_folder / "model.sdf").write_text(
        f"""<?xml version="1.0"?>
<sdf version="1.9">
  <model name="{robot.name}">
{parts}{_drive(robot)}  </model>
</sdf>
""",
        encoding="ascii",
    )
    write_config(model_folder, robot.name, "A small robot with two driven wheels, camera, lidar and IMU.")


def _link(robot: Robot, link: Link) -> str:
    frame = "" if link is robot.base else f"      <pose>{numbers(link.place)} 0 0 0</pose>\n"
    mass_centre = f"<pose>{numbers(robot.centre_in_link(link))} 0 0 0</pose>"
    x, y, z = link.inertia
    red_green_blue = numbers(link.colour)
    return f"""    <link name="{link.name}">
{frame}      <inertial>
        {mass_centre}
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
    """Pose and geometry of a visual or collision in its link."""
    shape, roll = link.shape, 0.0
    if isinstance(shape, Box):
        geometry = f"<box><size>{numbers(shape.size)}</size></box>"
    elif isinstance(shape, Sphere):
        geometry = f"<sphere><radius>{shape.radius:g}</radius></sphere>"
    else:
        geometry = f"<cylinder><radius>{shape.radius:g}</radius><length>{shape.length:g}</length></cylinder>"
        roll = -pi / 2 if shape.axis == "y" else 0.0
    return f"<pose>{numbers(robot.centre_in_link(link))} {roll:.8g} 0 0</pose>\n        <geometry>{geometry}</geometry>"


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
    """Sensors mounted on a link."""
    if link is robot.base:
        return _sensor("imu", "imu", robot.imu_rate, "<imu/>")
    if link.name == robot.camera.link:
        offset = f"<pose>{robot.camera.ahead:g} 0 0 0 0 0</pose>\n        "
        segmentation = "<segmentation_type>semantic</segmentation_type>"
        frame = f"<optical_frame_id>{OPTICAL_FRAME}</optical_frame_id>"
        return _sensor("camera", "camera", robot.camera.rate, offset + _camera(robot, frame)) + _sensor(
            "segmentation", "labels", LABELS_RATE_HZ, offset + _camera(robot, segmentation)
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


def _camera(robot: Robot, extra: str) -> str:
    camera = robot.camera
    return f"""<camera>
          {extra}<horizontal_fov>{camera.horizontal_fov:.8g}</horizontal_fov>
          <image><width>{camera.width}</width><height>{camera.height}</height></image>
          <clip><near>{camera.min_range:g}</near><far>{camera.max_range:g}</far></clip>
        </camera>"""


def _lidar(robot: Robot) -> str:
    lidar = robot.lidar
    max_angle = pi - pi / lidar.rays_per_turn
    return f"""<lidar>
          <scan>
            <horizontal>
              <samples>{lidar.rays_per_turn}</samples><resolution>1</resolution>
              <min_angle>{-max_angle:.8g}</min_angle><max_angle>{max_angle:.8g}</max_angle>
            </horizontal>
            <vertical>
              <samples>{lidar.rings}</samples><resolution>1</resolution>
              <min_angle>{lidar.min_elevation:.8g}</min_angle><max_angle>{lidar.max_elevation:.8g}</max_angle>
            </vertical>
          </scan>
          <range><min>{lidar.min_range:g}</min><max>{lidar.max_range:g}</max><resolution>0.001</resolution></range>
          <noise><type>gaussian</type><mean>0</mean><stddev>{lidar.noise:g}</stddev></noise>
          <visibility_mask>{WITHOUT_BACKDROP}</visibility_mask>
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
    <plugin filename="gz-sim-odometry-publisher-system" name="gz::sim::systems::OdometryPublisher">
      <dimensions>3</dimensions>
      <odom_topic>ground_truth</odom_topic>
      <odom_frame>world</odom_frame>
      <robot_base_frame>{robot.base.name}</robot_base_frame>
    </plugin>
    <plugin filename="gz-sim-joint-state-publisher-system" name="gz::sim::systems::JointStatePublisher">
      <topic>joint_states</topic>
    </plugin>
"""
