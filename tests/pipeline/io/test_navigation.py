"""Files for navigation: Nav2's occupancy maps, the PCD, the launch file, as ROS and PCL read them."""

from __future__ import annotations

import ast
import json
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from scan2sim.data_samples.building import Style, build
from scan2sim.pipeline.camera.renderer import Body, Renderer, pinhole
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, Frame, Mesh, PointCloud
from scan2sim.pipeline.geometry.surface_distance import distances, sample_surface
from scan2sim.pipeline.io import clouds, world_formats
from scan2sim.pipeline.io.navigation import nav2_map, pcd
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import RobotMapFrame, read_scene, save_tile
from scan2sim.pipeline.simulation.occupancy import FREE, OCCUPIED, UNKNOWN, Storey
from scan2sim.pipeline.simulation.spans import Grid
from scan2sim.pipeline.steps.navigation import NAVIGATION, NavigationParams
from scan2sim.pipeline.steps.pictures import robot_pose
from tests.fakes import synthetic
from tests.fakes.interpreters import ROS_PYTHON
from tests.fakes.steps import step_params

ORIGIN = (7.0, -3.0, -2.0)
"""Origin of the tile, far enough from the map's to notice when it is forgotten."""


def turned(tilt_deg: float = 8.0) -> F64:
    """Rigid transform from a y-up map, tilted, to a level world."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = (Rotation.from_euler("xyz", (90 + tilt_deg, 0, 30), degrees=True)).as_matrix()
    return T


def read_map(path: Path) -> tuple[np.ndarray, float, tuple[float, float]]:
    """Cells by the rules of nav2_map_server, rows along y; their size; position of the corner of cell (0, 0)."""
    about = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert about["mode"] == "trinary" and about["negate"] == 0 and about["origin"][2] == 0
    image = cv2.imread(str(path.parent / about["image"]), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint8 and image.ndim == 2
    p = (255.0 - image[::-1]) / 255.0  # the server flips rows: the first cell is the lower left pixel
    cells = np.full(image.shape, UNKNOWN, np.uint8)
    cells[p > about["occupied_thresh"]] = OCCUPIED
    cells[p < about["free_thresh"]] = FREE
    return cells, about["resolution"], (about["origin"][0], about["origin"][1])


def test_cells_of_an_asymmetrical_map_are_where_nav2_reads_them(tmp_path: Path) -> None:
    occupancy = np.full((4, 6), FREE, np.uint8)
    occupancy[0, 5], occupancy[3, 0], occupancy[3, 1] = OCCUPIED, UNKNOWN, OCCUPIED  # lower right, upper left
    storey = Storey(Grid((-1.0, 2.0), 0.1, (4, 6)), occupancy, np.zeros((4, 6), np.float32))
    nav2_map.write(storey, tmp_path / "map.yaml", (10.0, 20.0), "a note")
    cells, resolution, origin = read_map(tmp_path / "map.yaml")
    assert (cells == occupancy).all() and resolution == 0.1 and origin == pytest.approx((9.0, 22.0))


def test_pcd_round_trip_in_single_and_double_precision(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz, intensity = rng.uniform(-50, 50, (500, 3)), rng.uniform(0, 255, 500).astype(np.float32)
    pcd.write(tmp_path / "a.pcd", xyz, intensity)
    pcd.write(tmp_path / "b.pcd", xyz + (500_000, 5_400_000, 200), double=True)
    first = clouds.read(tmp_path / "a.pcd", Frame())
    assert np.abs(first.xyz - xyz).max() < 1e-5 and first.intensity is not None
    far = clouds.read(tmp_path / "b.pcd", Frame(origin=(500_000.0, 5_400_000.0, 200.0)))
    assert np.abs(far.xyz - xyz).max() < 1e-4 and far.intensity is None


def middle(mesh: Mesh) -> np.ndarray:
    return (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2


@pytest.fixture(scope="module")
def step(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Mesh]:
    """The step's folder for a building that was mapped in millimetres, y up and tilted; and its mesh in the world."""
    folder = tmp_path_factory.mktemp("navigation")
    building = build(1, Style(rooms=2))
    start = building.routes[0][0] + (0, 0, 0.5)  # the map's origin, which the transform leaves at the world's
    world = Mesh(Frame(), (building.mesh.vertices - start).astype(np.float32), building.mesh.faces)
    mesh = world.moved_to(Frame(origin=ORIGIN))
    mesh.save(folder / "mesh.npz")
    points = sample_surface(mesh, 40_000)
    at = points + np.asarray(ORIGIN) - middle(world)
    seen = PointCloud(mesh.frame, points, intensity=(257 * np.where(at[:, 1] < 1, 50, 200)).astype(np.uint16))
    seen.take(at[:, 0] < 0).save(folder / "cloud.npz")  # half of the building
    context = {
        "world_origin": (0.0, 0.0, 0.0), "T_world_map": tuple(map(tuple, turned().tolist())), "unit": 0.001,
        "spacing": 0.1,
    }  # fmt: skip
    inputs = {"collision": folder / "mesh.npz", "mesh.building": folder / "mesh.npz", "cloud": folder / "cloud.npz"}
    out = folder / "out"
    out.mkdir()
    NAVIGATION.run(inputs, step_params(NavigationParams, **context), out, silent)
    return out / "navigation", world


def test_points_in_the_frame_and_unit_of_the_map_lie_on_the_world(step: tuple[Path, Mesh]) -> None:
    folder, world = step
    cloud = clouds.read(folder / "map.pcd", Frame())
    placed = 0.001 * cloud.xyz.astype(np.float64) @ turned()[:3, :3].T
    assert distances(placed.astype(np.float32), world).max() < 0.002
    assert len(cloud) == pytest.approx(world.face_area.sum() / 0.01, rel=0.01)
    assert cloud.intensity is not None
    at = placed - middle(world)
    seen, left, right = at[:, 0] < -0.5, at[:, 1] < 0.5, at[:, 1] > 1.5
    level = cloud.intensity / 257
    assert (level[seen & left] == 50).all() and (level[seen & right] == 200).all()
    assert (level[at[:, 0] > 0.6] == 50).all()  # no point is near: the median
    assert (seen & right).sum() > 1000 < (at[:, 0] > 0.6).sum()


def test_map_and_spawn_pose_are_in_world_coordinates(step: tuple[Path, Mesh]) -> None:
    folder, _ = step
    building = build(1, Style(rooms=2))
    start = building.routes[0][0] + (0, 0, 0.5)
    cells, resolution, origin = read_map(folder / "map.yaml")
    rows, columns = np.nonzero(cells == FREE)
    xy = origin + resolution * (np.column_stack([columns, rows]) + 0.5) + start[:2]
    assert building.free_space(0, low=0.1, high=0.6, cell=0.02).at(xy).mean() > 0.98
    about = json.loads((folder / "navigation.json").read_text(encoding="utf-8"))
    assert about["frame"] == "world" and about["storeys"][0]["map"] == "map.yaml"
    assert about["storeys"][0]["floor_m"] == pytest.approx(-0.5, abs=0.02)
    x, y, z = about["spawn"]["position_m"]
    assert np.hypot(x, y) < 1.5 and z == pytest.approx(-0.48, abs=0.02) and about["spawn"]["clearance_m"] >= 0.6


def test_robot_sees_the_room_ahead_at_the_height_of_its_camera(step: tuple[Path, Mesh]) -> None:
    folder, world = step
    frame = Frame(origin=ORIGIN)
    pose = robot_pose(folder, frame)
    assert pose is not None
    x, y, z = frame.to_crs(pose[None, :3, 3])[0]
    assert np.hypot(x, y) < 1.7 and z + 0.5 == pytest.approx(0.6, abs=0.05)  # the floor is at -0.5
    ahead = Renderer([Body(world.moved_to(frame))]).view(pinhole(64, 36), pose)
    middle_row = ahead.range[18]
    assert ahead.hit.mean() > 0.99 and middle_row.min() > 0.5 and middle_row[32] > 2


def test_world_without_a_floor_gets_points_and_a_warning(tmp_path: Path) -> None:
    wall = Mesh(Frame(), np.array([[0, 0, 0], [4, 0, 0], [4, 0, 2]], np.float32), np.array([[0, 1, 2]], np.int32))
    wall.save(tmp_path / "mesh.npz")
    context = {"T_world_map": tuple(map(tuple, np.eye(4).tolist()))}
    inputs = {"collision": tmp_path / "mesh.npz", "mesh.building": tmp_path / "mesh.npz"}
    done = NAVIGATION.run(inputs, step_params(NavigationParams, **context), tmp_path, silent)
    assert {file.name for file in done.files["navigation"].iterdir()} == {"map.pcd"}
    assert robot_pose(done.files["navigation"], Frame()) is None
    assert "no occupancy map" in done.warnings[0]


def test_height_band_must_not_be_empty(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="high"):
        NAVIGATION.run({}, NavigationParams(low=0.5, high=0.5), tmp_path, silent)


@pytest.fixture(scope="module")
def world(step: tuple[Path, Mesh], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Gazebo world with the files of the step and arbitrary meshes."""
    folder = tmp_path_factory.mktemp("world")
    frame = Frame(origin=ORIGIN)
    sources = {"terrain": synthetic.textured(folder / "terrain", synthetic.ground(10, frame))}
    synthetic.collided(frame).save(folder / "collision.npz")
    files = {file.name: file for file in step[0].iterdir()}
    saved = RobotMapFrame(turned(), 0.001)
    save_tile(folder, "house", sources, folder / "collision.npz", files, 0.9, (0.0, 0.0, 0.0), robot_map=saved)
    out = folder / "a world's folder"
    world_formats.write(read_scene(folder), ["gazebo"], out, SceneParams(), silent)
    return out


def test_world_has_the_files_and_frames(world: Path, step: tuple[Path, Mesh]) -> None:
    about = json.loads((world / "metadata.json").read_text(encoding="utf-8"))
    assert np.allclose(about["T_world_map"], turned()) and about["map_unit_m"] == 0.001
    assert about["navigation"] == json.loads((step[0] / "navigation.json").read_text(encoding="utf-8"))
    for name in ("map.yaml", "map.pgm", "map.pcd"):
        assert (world / name).read_bytes() == (step[0] / name).read_bytes()
    assert (world / "models" / "robot" / "model.sdf").is_file()
    assert "model://robot" not in (world / "house.sdf").read_text(encoding="utf-8")  # the launch file spawns it


def test_robot_of_the_world_spawns_at_the_pose_in_free_space(world: Path, tmp_path: Path) -> None:
    scene = read_scene(world.parent)
    world_formats.write(scene, ["gazebo"], tmp_path, SceneParams(), silent, robot=True)
    about = json.loads((tmp_path / "metadata.json").read_text(encoding="utf-8"))
    assert about["robot"]["on"] == "floor"
    assert about["robot"]["position_m"] == about["navigation"]["spawn"]["position_m"]
    assert "default_value=''" in (tmp_path / "house.launch.py").read_text(encoding="utf-8")


def test_world_origin_is_part_of_the_transform(world: Path, tmp_path: Path) -> None:
    frame = Frame(origin=ORIGIN)
    sources = {"terrain": synthetic.textured(tmp_path / "terrain", synthetic.ground(10, frame))}
    synthetic.collided(frame).save(tmp_path / "collision.npz")
    scene = save_tile(
        tmp_path, "house", sources, tmp_path / "collision.npz", {}, 0.9, robot_map=RobotMapFrame(turned())
    )
    assert scene.robot_map is not None and np.allclose(scene.robot_map.T_world_map[:3, 3], -np.array(ORIGIN))


def static_transforms(launch: Path) -> dict[tuple[str, str], F64]:
    """Static transforms in a launch file, by parent and child: x, y, z, qx, qy, qz, qw."""
    found = {}
    for node in ast.walk(ast.parse(launch.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "static_transform":
            parent, child, translation, quaternion = map(ast.literal_eval, node.args)
            found[parent, child] = np.array([*translation, *quaternion], np.float64)
    return found


def test_launch_file_publishes_the_frames(world: Path) -> None:
    from scipy.spatial.transform import Rotation

    transforms = static_transforms(world / "house.launch.py")
    to_map = transforms["world", "map"]
    assert np.allclose(Rotation.from_quat(to_map[3:]).as_matrix(), turned()[:3, :3], atol=1e-9)
    about = json.loads((world / "metadata.json").read_text(encoding="utf-8"))["navigation"]["spawn"]
    odom = transforms["world", "odom"]
    assert np.allclose(odom[:3], about["position_m"])
    assert np.allclose(Rotation.from_quat(odom[3:]).as_euler("xyz"), about["angles_rad"], atol=1e-5)
    assert ("base_link", "robot/lidar_link/lidar") in transforms
    # frame of Gazebo's images; RViz and image_proc take it for an optical one
    image_frame = ET.parse(world / "models/robot/model.sdf").getroot().findtext(".//camera/optical_frame_id")
    optical = transforms["base_link", str(image_frame)]
    assert np.allclose(Rotation.from_quat(optical[3:]).apply([[1, 0, 0], [0, 0, 1]]), [[0, -1, 0], [1, 0, 0]])


PARSE = """
import sys
from launch import LaunchContext
from launch.actions import DeclareLaunchArgument
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import Node

context = LaunchContext()
description = PythonLaunchDescriptionSource(sys.argv[1]).get_launch_description(context)
for entity in description.entities:
    if isinstance(entity, DeclareLaunchArgument):
        entity.visit(context)
print(*sorted(entity.node_executable for entity in description.entities if isinstance(entity, Node)))
print(*(entity.condition.evaluate(context) for entity in description.entities if getattr(entity, "condition", None)))
"""


def test_launch_file_is_valid_for_ros(world: Path) -> None:
    if not ROS_PYTHON.exists():
        pytest.skip("launch_ros isn't installed (.venv-ros)")
    if subprocess.run([ROS_PYTHON, "-c", "import launch_ros.actions"], capture_output=True, check=False).returncode:
        pytest.skip("launch_ros isn't installed (in .venv-ros: from a ROS 2 installation, PYTHONPATH)")
    ran = subprocess.run(
        [ROS_PYTHON, "-c", PARSE, world / "house.launch.py"], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    nodes, conditions = ran.stdout.splitlines()
    assert nodes.split() == sorted(
        ["create", "lifecycle_manager", "map_server", "parameter_bridge", *["static_transform_publisher"] * 5]
    )
    assert conditions == "True True"  # the robot is spawned, and odom is static
