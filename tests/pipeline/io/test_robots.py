"""The robot in all formats that support one: spawn pose, equal links, and driving."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Trajectory
from scan2sim.pipeline.io import robot_formats, world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import PATH_FILE, Scene
from scan2sim.pipeline.io.worlds.spawn import default_pose, find_spawn_pose
from scan2sim.pipeline.simulation.robot import ROBOT
from tests.fakes import synthetic

MASS = sum(link.mass for link in ROBOT.links)
FIRST, LAST = (-8.0, -7.0), (8.0, -7.0)
"""Ends of the way that a vehicle drove over the first tile, from west to east, the pole 2 m to its left."""


def driven(scene: Scene) -> Scene:
    """The same scene, with the path of a scanner 2 m above the ground."""
    x = np.linspace(FIRST[0], LAST[0], 33)
    places = np.column_stack([x, np.full(33, FIRST[1]), synthetic.height(x, np.full(33, FIRST[1])) + 2])
    Trajectory(np.arange(33.0), places).save(scene.tiles[0].folder / PATH_FILE)
    return scene


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return driven(synthetic.scene(tmp_path_factory.mktemp("town")))


@pytest.fixture(scope="module")
def exported(town: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    world_formats.write(town, ["gazebo", "mujoco", "urdf"], folder, SceneParams(), silent, robot=True)
    return folder


def test_every_robot_format_has_a_world_format() -> None:
    assert set(plugins.names(robot_formats.PACKAGE)) <= set(world_formats.format_names())


def test_robot_starts_at_the_beginning_of_the_path_facing_along_it(town: Scene, exported: Path) -> None:
    start = find_spawn_pose(town)
    x, y, z = start.position
    assert start.by == "path" and (x, y) == pytest.approx(FIRST, abs=0.6)
    assert z == pytest.approx(float(synthetic.height(np.array(x), np.array(y))), abs=0.06)
    roll, pitch, yaw = start.angles
    assert yaw == pytest.approx(0, abs=0.05) and abs(roll) < 0.15 and abs(pitch) < 0.15
    robot = json.loads((exported / "metadata.json").read_text(encoding="utf-8"))["robot"]
    assert robot == {"name": "robot", "position_m": [x, y, z], "angles_rad": [roll, pitch, yaw], "on": "path"}


def test_robot_starts_clear_of_obstacles(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    x = np.linspace(-7.0, 9.0, 33)
    Trajectory(np.arange(33.0), np.column_stack([x, np.full(33, -5.3), np.full(33, 3.0)])).save(
        scene.tiles[0].folder / PATH_FILE
    )
    assert find_spawn_pose(scene).position[0] > -5 + 0.5  # behind the pole at (-5, -5)


def test_robot_without_a_road_path_or_free_ground_is_an_error(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    with pytest.raises(DataError, match="neither a road nor"):
        world_formats.write(scene, ["mujoco"], tmp_path / "out", SceneParams(), silent, robot=True)
    Trajectory(np.arange(9.0), np.column_stack([np.linspace(50, 60, 9), np.zeros(9), np.zeros(9)])).save(
        scene.tiles[0].folder / PATH_FILE
    )
    with pytest.raises(DataError, match="no free ground"):
        find_spawn_pose(scene)
    assert not (tmp_path / "out").exists()


def test_every_world_names_a_free_place_for_a_robot(town: Scene, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path)  # no road and no path
    pose = default_pose(scene)
    assert pose is not None and pose.by == "ground"
    x, y, z = pose.position
    assert max(abs(x), abs(y)) <= 1 and z == pytest.approx(float(synthetic.height(np.array(x), np.array(y))), abs=0.08)
    assert default_pose(town) == find_spawn_pose(town)
    for one in (scene, replace(scene, tiles=scene.tiles[:1])):  # with levels, and without
        world_formats.write(one, ["gazebo"], tmp_path / f"out{len(one.tiles)}", SceneParams(), silent)
        folder = tmp_path / f"out{len(one.tiles)}"
        spawn = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))["spawn"]
        assert spawn == {"position_m": [x, y, z], "angles_rad": list(pose.angles), "on": "ground"}
        frame = ET.parse(folder / f"{one.name}.sdf").getroot().find("world/frame[@name='spawn_pose']")
        assert frame is not None
        assert [*map(float, frame.findtext("pose", "").split())] == pytest.approx([x, y, z, *pose.angles], abs=1e-5)
        command = f"ros2 run ros_gz_sim create -file ROBOT.sdf -x {x:.2f} -y {y:.2f} -z {z:.2f} -Y {pose.angles[2]:.3f}"
        for file in ("README.md", f"{one.name}.sdf"):
            assert command in (folder / file).read_text(encoding="utf-8")


def test_a_world_without_free_ground_says_so(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    (tile,) = scene.tiles
    solid = tile.solid()
    assert solid.classification is not None
    solid.keep(solid.classification != CODE["terrain"]).save(tile.folder / "collision.npz")
    world_formats.write(scene, ["glb"], tmp_path / "out", SceneParams(), silent)
    assert "spawn" not in json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))
    assert "No free ground" in (tmp_path / "out" / "README.md").read_text(encoding="utf-8")


def test_formats_without_robots_are_reported(town: Scene, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"not supported by glb, usd\. Add one of: gazebo, mujoco, urdf"):
        world_formats.check(["glb", "usd"], SceneParams(), "--to", robot=True)
    with pytest.raises(DataError, match="robot"):
        world_formats.write(
            replace(town, name="robot"), ["mujoco"], tmp_path / "out", SceneParams(), silent, robot=True
        )


def of_sdf(folder: Path) -> Iterator[tuple[str, float, Any]]:
    """Name, mass and position of each link."""
    for link in ET.parse(folder / "models/robot/model.sdf").getroot().iter("link"):
        place = (link.findtext("pose") or "0 0 0").split()[:3]
        yield link.attrib["name"], float(link.findtext("inertial/mass", "")), np.array(place, float)


def of_urdf(folder: Path) -> Iterator[tuple[str, float, Any]]:
    root = ET.parse(folder / "robot.urdf").getroot()
    places = {
        joint.find("child").attrib["link"]: joint.find("origin").attrib["xyz"]  # type: ignore[union-attr]
        for joint in root.iter("joint")
    }
    for link in root.iter("link"):
        name, mass = link.attrib["name"], link.find("inertial/mass")
        assert mass is not None
        yield name, float(mass.attrib["value"]), np.array(places.get(name, "0 0 0").split(), float)


@pytest.mark.parametrize("read", [of_sdf, of_urdf])
def test_links_of_the_robot_are_equal_in_all_formats(exported: Path, read: Any) -> None:
    found = {name: (mass, place) for name, mass, place in read(exported)}
    assert found.keys() == {link.name for link in ROBOT.links}
    for link in ROBOT.attached:
        assert found[link.name][0] == link.mass
        np.testing.assert_allclose(found[link.name][1], link.place, atol=1e-6)


def test_gazebo_world_loads_the_systems_for_sensors_and_drive(exported: Path) -> None:
    world = ET.parse(exported / "town.sdf").getroot()
    systems = {plugin.attrib["name"].split("::")[-1] for plugin in world.iter("plugin")}
    assert systems >= {"Physics", "Sensors", "SceneBroadcaster", "UserCommands", "Imu"}
    (include,) = (one for one in world.iter("include") if one.findtext("uri") == "model://robot")
    robot = json.loads((exported / "metadata.json").read_text(encoding="utf-8"))["robot"]
    pose = np.array(include.findtext("pose", "").split(), float)
    np.testing.assert_allclose(pose, [*robot["position_m"], *robot["angles_rad"]], atol=1e-6)
    assert world.findtext(".//performer/ref") == "robot"  # levels are loaded around it
    model = ET.parse(exported / "models/robot/model.sdf").getroot()
    assert {s.attrib["type"] for s in model.iter("sensor")} == {"camera", "segmentation", "gpu_lidar", "imu"}
    drive = next(plugin for plugin in model.iter("plugin") if plugin.attrib["name"] == "gz::sim::systems::DiffDrive")
    joints = {joint.attrib["name"] for joint in model.iter("joint") if joint.attrib["type"] == "revolute"}
    assert {drive.findtext("left_joint"), drive.findtext("right_joint")} == joints
    assert float(drive.findtext("wheel_separation", "")) == pytest.approx(ROBOT.track)
    (true,) = (one for one in model.iter("plugin") if one.attrib["name"] == "gz::sim::systems::OdometryPublisher")
    assert (true.findtext("odom_topic"), true.findtext("odom_frame"), true.findtext("dimensions")) == (
        "ground_truth", "world", "3",
    )  # fmt: skip


def test_robot_drives_ahead_in_mujoco(exported: Path) -> None:
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed")
    model = mujoco.MjModel.from_xml_path(str(exported / "town.xml"))
    assert model.body("robot").subtreemass[0] == pytest.approx(MASS)
    data = mujoco.MjData(model)
    data.ctrl[:] = ROBOT.wheel_speeds(1.0, 0.0)
    mujoco.mj_step(model, data, nstep=int(3 / model.opt.timestep))
    x, y, z = (
        data.body("robot").xpos
        - json.loads((exported / "metadata.json").read_text(encoding="utf-8"))["robot"]["position_m"]
    )
    assert 2.5 < x < 3.1 and abs(y) < 0.5 and abs(z) < 0.5
    assert data.camera("camera").xmat.reshape(3, 3)[0, 2] < -0.9  # it looks along x


def test_robot_drives_and_turns_in_pybullet(exported: Path) -> None:
    bullet = pytest.importorskip("pybullet", reason="pybullet is not installed")
    client = bullet.connect(bullet.DIRECT)
    try:
        bullet.setGravity(0, 0, -9.8)
        bullet.loadURDF(str(exported / "town.urdf"), useFixedBase=True)
        start = json.loads((exported / "metadata.json").read_text(encoding="utf-8"))["robot"]
        turned = bullet.getQuaternionFromEuler(start["angles_rad"])
        robot = bullet.loadURDF(str(exported / "robot.urdf"), start["position_m"], turned)
        joints = {bullet.getJointInfo(robot, i)[1].decode(): i for i in range(bullet.getNumJoints(robot))}
        masses = [bullet.getDynamicsInfo(robot, i)[0] for i in (-1, *joints.values())]
        assert sum(masses) == pytest.approx(MASS)

        def drive(speed: float, turn: float, seconds: float) -> tuple[np.ndarray, float]:
            for side, wheel in zip(ROBOT.wheel_speeds(speed, turn), ("left", "right"), strict=True):
                joint = joints[f"{wheel}_wheel_joint"]
                bullet.setJointMotorControl2(robot, joint, bullet.VELOCITY_CONTROL, targetVelocity=side, force=10)
            for _ in range(int(seconds * 240)):
                bullet.stepSimulation()
            place, angles = bullet.getBasePositionAndOrientation(robot)
            return np.array(place), bullet.getEulerFromQuaternion(angles)[2]

        first, _ = drive(0.0, 0.0, 0.5)
        then, heading = drive(1.0, 0.0, 2.0)
        assert 1.6 < then[0] - first[0] < 2.2 and abs(then[1] - first[1]) < 0.3
        assert 0.5 < drive(0.0, 0.5, 2.0)[1] - heading < 1.3
    finally:
        bullet.disconnect(client)
