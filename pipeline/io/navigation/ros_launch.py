"""ROS 2 launch file of a world: Gazebo, the robot, the bridge, the static transforms and `nav2_map_server`.

Frames: `world` is Gazebo's world and the frame of the occupancy map; `map` is the frame of the robot's map, below
`world` by a static transform. Without localization `world` -> `odom` is static, from the spawn pose; with it, the
localization publishes `map` -> `odom`. Tested against ROS' own launch parser, for Humble with Fortress and later.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds.sdf import numbers
from scan2sim.pipeline.simulation.robot import OPTICAL_FRAME, Robot, Start

OPTICAL_AXES = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
"""Rotation from the camera's optical axes (x right, y down, z ahead) to the robot's (x ahead, y left, z up)."""
BRIDGED = (
    "/clock@rosgraph_msgs/msg/Clock[gz.msgs.Clock",
    "/cmd_vel@geometry_msgs/msg/Twist]gz.msgs.Twist",
    "/odom@nav_msgs/msg/Odometry[gz.msgs.Odometry",
    "/ground_truth@nav_msgs/msg/Odometry[gz.msgs.Odometry",
    "/tf@tf2_msgs/msg/TFMessage[gz.msgs.Pose_V",
    "/joint_states@sensor_msgs/msg/JointState[gz.msgs.Model",
    "/lidar@sensor_msgs/msg/LaserScan[gz.msgs.LaserScan",
    "/lidar/points@sensor_msgs/msg/PointCloud2[gz.msgs.PointCloudPacked",
    "/imu@sensor_msgs/msg/Imu[gz.msgs.IMU",
    "/camera@sensor_msgs/msg/Image[gz.msgs.Image",
    "/camera_info@sensor_msgs/msg/CameraInfo[gz.msgs.CameraInfo",
)
"""Topics of the robot (`pipeline.io.robot_formats.gazebo`), as arguments of `parameter_bridge`."""


def write(
    path: Path, world: str, robot: Robot, start: Start | None, *, spawn: bool, occupancy: bool, T_world_map: F64 | None
) -> None:
    """Write a launch file beside the world.

    Args:
        path: of the launch file.
        world: file name of the SDF world.
        robot: the robot, a model in `models/`.
        start: its spawn pose; None: there is none, and nothing is spawned.
        spawn: whether the launch file spawns it; otherwise it is part of the world.
        occupancy: whether there is `map.yaml`.
        T_world_map: (4, 4) rigid transform from the robot's map to the world, or None.
    """
    at = start or Start((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "world")
    model = f"os.path.join(HERE, 'models', {robot.name!r}, 'model.sdf')" if spawn and start else "''"
    nodes = []
    if T_world_map is not None:
        nodes.append(f"static_transform('world', 'map', {_transform(T_world_map)}),")
    nodes.append(
        f"static_transform('world', 'odom', {_transform(_pose(at))}, condition=UnlessCondition(localization)),"
    )
    lidar, camera = np.eye(4), np.eye(4)
    lidar[:3, 3] = robot.link(robot.lidar.link).place
    camera[:3, :3] = OPTICAL_AXES
    camera[:3, 3] = np.asarray(robot.link(robot.camera.link).place) + [robot.camera.ahead, 0, 0]
    for frame, place in ((f"{robot.name}/{robot.lidar.link}/lidar", lidar), (OPTICAL_FRAME, camera)):
        nodes.append(f"static_transform({robot.base.name!r}, {frame!r}, {_transform(place)}),")
    imu = f"static_transform({robot.base.name!r}, '{robot.name}/{robot.base.name}/imu', {_transform(np.eye(4))}),"
    nodes.append(imu)
    x, y, z = at.position
    roll, pitch, yaw = at.angles
    text = _TEMPLATE.format(
        world=world,
        model=model,
        name=robot.name,
        pose=", ".join(f"'-{k}', '{numbers([v])}'" for k, v in zip("xyzRPY", (x, y, z, roll, pitch, yaw), strict=True)),
        bridged="".join(f"\n    '{topic}'," for topic in BRIDGED),
        transforms="\n        ".join(nodes),
        map_usage=" [map:=map_1.yaml]" if occupancy else "",
        map_argument=_MAP_ARGUMENT if occupancy else "",
        map_server=_MAP_SERVER if occupancy else "",
    )
    path.write_text(text, encoding="utf-8")


def _pose(start: Start) -> F64:
    """(4, 4) pose of the robot in the world."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", start.angles).as_matrix()
    T[:3, 3] = start.position
    return T


def _transform(T: F64) -> str:
    """Translation and quaternion (x, y, z, w) of a rigid transform, as Python text."""
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    if quaternion[3] < 0:
        quaternion = -quaternion
    return _tuple(T[:3, 3], 6) + ", " + _tuple(quaternion, 12)


def _tuple(values: Sequence[float] | F64, digits: int) -> str:
    return "(" + ", ".join(repr(round(float(value), digits) + 0.0) for value in values) + ")"


_MAP_ARGUMENT = """
        DeclareLaunchArgument('map', default_value=os.path.join(HERE, 'map.yaml'), description='Map of the storey.'),\
"""
_MAP_SERVER = """
        Node(
            package='nav2_map_server', executable='map_server', name='map_server', output='screen',
            parameters=[{'yaml_filename': LaunchConfiguration('map'), 'frame_id': 'world', **SIM_TIME}],
        ),
        Node(
            package='nav2_lifecycle_manager', executable='lifecycle_manager', name='lifecycle_manager_map',
            parameters=[{'autostart': True, 'node_names': ['map_server'], **SIM_TIME}],
        ),\
"""
_TEMPLATE = """\
\"\"\"Starts Gazebo with this world, the robot, the bridge to ROS 2 and the map server (written by scan2sim).

    ros2 launch FILE [localization:=true] [robot:=MODEL.sdf|none] [gz_args:='-r -s']{map_usage}

Packages: ros_gz_sim, ros_gz_bridge, tf2_ros, nav2_map_server, nav2_lifecycle_manager.
\"\"\"

import os
import shlex

from launch import LaunchDescription
from launch.actions import (
    AppendEnvironmentVariable, DeclareLaunchArgument, IncludeLaunchDescription
)
from launch.conditions import UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

HERE = os.path.dirname(os.path.abspath(__file__))
SIM_TIME = {{'use_sim_time': True}}
BRIDGED = [{bridged}
]


def static_transform(parent, child, translation, quaternion, condition=None):
    names = ('--x', '--y', '--z', '--qx', '--qy', '--qz', '--qw')
    values = [text for pair in zip(names, map(str, (*translation, *quaternion))) for text in pair]
    return Node(
        package='tf2_ros', executable='static_transform_publisher', parameters=[SIM_TIME], condition=condition,
        arguments=[*values, '--frame-id', parent, '--child-frame-id', child],
    )


def generate_launch_description():
    robot, localization = LaunchConfiguration('robot'), LaunchConfiguration('localization')
    world = os.path.join(HERE, '{world}')
    return LaunchDescription([
        DeclareLaunchArgument('robot', default_value={model}, description='SDF model to spawn, or none.'),
        DeclareLaunchArgument(
            'localization', default_value='false', description='true: your localization publishes map -> odom.'
        ),
        DeclareLaunchArgument('gz_args', default_value='-r', description='Options of Gazebo; -r -s: no window.'),\
{map_argument}
        AppendEnvironmentVariable('GZ_SIM_RESOURCE_PATH', os.path.join(HERE, 'models')),
        AppendEnvironmentVariable('IGN_GAZEBO_RESOURCE_PATH', os.path.join(HERE, 'models')),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(
                PathJoinSubstitution([FindPackageShare('ros_gz_sim'), 'launch', 'gz_sim.launch.py'])
            ),
            launch_arguments={{'gz_args': [LaunchConfiguration('gz_args'), ' ', shlex.quote(world)]}}.items(),
        ),
        Node(
            package='ros_gz_sim', executable='create', output='screen',
            condition=UnlessCondition(PythonExpression(['"', robot, '" in ("", "none")'])),
            arguments=['-name', '{name}', '-file', robot, {pose}],
        ),
        Node(package='ros_gz_bridge', executable='parameter_bridge', arguments=BRIDGED, parameters=[SIM_TIME]),
        {transforms}{map_server}
    ])
"""
