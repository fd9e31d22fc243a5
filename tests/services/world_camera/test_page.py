"""The commands and examples of docs/camera.md and of the camera in docs/splats.md fit what worlds contain."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.simulation.robot import ROBOT
from tests.fakes import synthetic
from tests.fakes.consumers import mujoco as consumer
from tests.present import present

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/camera.md").read_text(encoding="utf-8")
SPLATS_PAGE = (ROOT / "docs/splats.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `town`, the exported world with the robot."""
    folder = tmp_path_factory.mktemp("exported")
    scene = synthetic.driven(folder)
    world_formats.write(scene, ["gazebo"], folder / "town", SceneParams(), silent, robot=True)
    return folder


def sensors(folder: Path) -> dict[str, ET.Element]:
    """Sensors of Gazebo's robot, by name."""
    tree = ET.parse(folder / "town/models/robot/model.sdf")
    return {present(one.get("name")): one for one in tree.iter("sensor")}


def test_topics_of_gazebos_robot_are_those_of_the_page(folder: Path) -> None:
    model = (folder / "town/models/robot/model.sdf").read_text(encoding="utf-8")
    bridged = set(re.findall(r"'/([\w/]+)@", PAGE))
    assert {"cmd_vel", "ground_truth"} <= bridged
    for topic in ("cmd_vel", "ground_truth"):
        assert f"topic>{topic}</" in model
    topic = present(sensors(folder)["camera"].findtext("topic"))
    assert topic == "camera", "Gazebo publishes the intrinsics beside it, as /camera_info"
    # a sensor that also measures depth publishes below its topic
    assert bridged - {"cmd_vel", "ground_truth", "camera_info"} == {
        f"{topic}/{name}" for name in ("image", "depth_image", "camera_info")
    }
    (link,) = (one for one in ROBOT.links if one.name == ROBOT.camera.link)
    mounts = re.findall(r"--mount ([\d.-]+) ([\d.-]+) ([\d.-]+) 0 0 0 ", PAGE)
    assert len(mounts) >= 2
    for mount in mounts:
        assert np.allclose(np.array(mount, float), np.add(link.place, (ROBOT.camera.ahead, 0, 0)))


def test_gazebos_camera_gets_depth(folder: Path) -> None:
    (command,) = re.findall(r"^sed .*$", PAGE, re.MULTILINE)
    before = {name: one.get("type") for name, one in sensors(folder).items()}
    subprocess.run(["bash", "-c", command], cwd=folder, check=True)
    after = sensors(folder)
    assert {name: one.get("type") for name, one in after.items()} == before | {"camera": "rgbd_camera"}
    # gz-rendering's depth cameras ignore visibility masks, so the page exports a world without the backdrop
    assert "export `town` with `--no-backdrop`" in PAGE


def test_start_of_the_robot_is_printed_as_the_origin_option_takes_it(folder: Path) -> None:
    (code,) = re.findall(r"^python3 -c '(.*)'$", PAGE, re.MULTILINE)
    printed = subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, capture_output=True, text=True)
    robot = json.loads((folder / "town/metadata.json").read_text(encoding="utf-8"))["robot"]
    expected = [*robot["position_m"], *(math.degrees(angle) for angle in robot["angles_rad"])]
    assert [float(value) for value in printed.stdout.split()] == pytest.approx(expected)


def test_example_in_python_looks_along_the_road_from_the_spawn_pose(tmp_path: Path) -> None:
    (code,) = re.findall(r"## A camera without a simulator\n\n```python\n(.*?)```", SPLATS_PAGE, re.DOTALL)
    synthetic.scene(tmp_path, tiles=1).tiles[0].folder.parents[1].rename(tmp_path / "world")
    (tmp_path / "my_world").mkdir()
    (tmp_path / "world").rename(tmp_path / "my_world/world")
    x, y = synthetic.HOUSE
    spawn = {"position_m": [x - 6.0, y + 1.0, 0.0], "angles_rad": [0.0, 0.0, 0.0], "on": "road"}  # before the house
    for yaw, seen in ((0.0, True), (math.pi, False)):
        spawn["angles_rad"] = [0.0, 0.0, yaw]
        (tmp_path / "my_world/world/metadata.json").write_text(json.dumps({"spawn": spawn}), encoding="utf-8")
        shown = "\nnp.save('code.npy', image.code)\nnp.save('depth.npy', image.depth(lens))\n"
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        subprocess.run([sys.executable, "-c", code + shown], cwd=tmp_path, env=environment, check=True)
        codes, depth = np.load(tmp_path / "code.npy"), np.load(tmp_path / "depth.npy")
        assert (6 in codes) == seen
        if seen:
            assert depth[360, 640] == pytest.approx(6.0, abs=0.05)
    assert Image.open(tmp_path / "view.png").size == (1280, 720)


def test_example_in_mujoco_shows_the_street_ahead_of_the_robot(tmp_path: Path) -> None:
    if why := consumer.missing():
        pytest.skip(why)
    (code,) = re.findall(r"## In Python, without ROS\n.*?```python\n(.*?)```", PAGE, re.DOTALL)
    scene = synthetic.driven(tmp_path / "my_world")
    world_formats.write(scene, ["mujoco"], tmp_path / "town_mujoco", SceneParams(), silent, robot=True)
    model = tmp_path / "town_mujoco" / f"{scene.name}.xml"
    # a magenta post that only MuJoCo knows, two metres ahead of the robot
    robot = json.loads((tmp_path / "town_mujoco/metadata.json").read_text(encoding="utf-8"))["robot"]
    (x, y, z), yaw = robot["position_m"], robot["angles_rad"][2]
    at = f"{x + 2 * math.cos(yaw)} {y + 2 * math.sin(yaw)} {z + 0.5}"
    geom = f'<geom type="box" size=".1 .1 .5" pos="{at}" rgba="1 0 1 1" group="0" contype="0" conaffinity="0"/>'
    xml = model.read_text(encoding="utf-8")
    model.write_text(xml.replace("<worldbody>", "<worldbody>" + geom, 1), encoding="utf-8")
    code = code.replace("NAME", scene.name).replace("range(20)", "range(4)")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
    first, last = (np.array(Image.open(tmp_path / f"frame_{k:02d}.png")).astype(int) for k in (0, 3))
    post = np.minimum(last[..., 0], last[..., 2]) > 2 * last[..., 1] + 20
    assert 0.002 < post.mean() < 0.2, "MuJoCo's post is in front of the street"
    assert abs(np.argwhere(post)[:, 1].mean() - last.shape[1] / 2) < 0.05 * last.shape[1], "it is straight ahead"
    assert last[~post].std() > 10 and np.abs(last - first).mean() > 0.1, "the street is there, and the robot moves"
