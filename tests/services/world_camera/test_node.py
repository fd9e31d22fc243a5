"""The camera node on DDS: images at the robot's poses by /tf or odometry, with a simulator's images in front."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cyclonedds", reason="the extra bus isn't installed")

from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.services.world_camera.pose_source import BODY_FROM_OPTICAL, pose_of
from scan2sim.texturing.world_camera import WorldCamera
from tests.fakes import synthetic
from tests.services.conftest import Start
from tests.services.world_camera import robot
from tests.services.world_camera.robot import CAMERA

pytestmark = pytest.mark.realtime

COMMAND = ("-m", "scan2sim.flows.cli", "camera")
SIZE = CAMERA.height, CAMERA.width


def seen(start: Start, scene: Scene, folder: Path, mode: str, *options: object) -> dict[str, Any]:
    """What the robot has received, by output, and the errors of the node."""
    world = scene.tiles[0].folder.parents[1]
    spawn = {"position_m": list(robot.START), "angles_rad": [0.0, 0.0, 0.0], "on": "road"}
    (world / "metadata.json").write_text(json.dumps({"spawn": spawn}), encoding="utf-8")
    node = start("cyclone", *COMMAND, world, "--camera-info", "/front/camera_info", *options)
    driven = start("cyclone", Path(robot.__file__), folder, mode)
    _, errors = driven.communicate(timeout=240)
    assert driven.returncode == 0, errors
    assert node.poll() is None, "invalid messages don't end it"
    return {path.stem: dict(np.load(path)) for path in folder.glob("*.npz")}


def pixels(received: dict[str, Any], name: str, kind: type, *channels: int) -> np.ndarray:
    return received[name]["data"].view(kind).reshape(*SIZE, *channels)


def test_images_are_those_of_the_pose_by_tf(start: Start, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path)
    received = seen(start, scene, tmp_path, "tf")
    table = json.loads(received.pop("instance_table")["text"].item())
    assert {one["frame"].item() for one in received.values()} == {"eye_optical_frame"}
    assert np.array_equal(received["camera_info"]["d"], CAMERA.distortion)
    assert received["camera_info"]["k"][0] == CAMERA.fx
    world = WorldCamera(scene)
    for name in ("image_raw", "depth", "image_raw_compressed", "instances"):
        T = np.eye(4)
        T[:3, :3] = robot.OPTICAL
        T[:3, 3] = robot.position(float(received[name]["time"])) + (0, 0, 2)
        expected = world.render(T, CAMERA)
        if name == "depth":
            depth, own = pixels(received, "depth", np.float32), expected.depth(CAMERA)
            assert np.isclose(depth, own, rtol=0.01).mean() > 0.98
        elif name == "instances":
            ids = pixels(received, "instances", np.int32)
            assert (ids == expected.instance).mean() > 0.98 and ids.any()
            assert set(np.unique(ids)) - {0} <= {one["id"] for one in table["instances"]}
        elif name == "image_raw":
            shown = pixels(received, "image_raw", np.uint8, 3).astype(int)
            assert (np.abs(shown - expected.rgb).max(axis=2) <= 3).mean() > 0.98
        else:
            content = io.BytesIO(received[name]["data"].tobytes())
            assert np.abs(np.asarray(Image.open(content)).astype(int) - expected.rgb).mean() < 10


def test_images_by_odometry_begin_at_the_spawn_pose_with_the_simulators_in_front(start: Start, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path)
    mount = [str(value) for value in robot.MOUNT]
    options = ("--odometry", "/odom", "--mount", *mount, "--image", "/front/image", "--depth-image")
    received = seen(start, scene, tmp_path, "odometry", *options, "/front/depth_image")
    shown, depth = pixels(received, "image_raw", np.uint8, 3), pixels(received, "depth", np.float32)
    half = CAMERA.width // 2
    assert (shown[:, :half] == robot.OBJECT_RGB).all() and (depth[:, :half] == robot.OBJECT_M).all()
    pose = pose_of((*robot.position(float(received["image_raw"]["time"])), 0, 0, 0)) @ pose_of(robot.MOUNT)
    expected = WorldCamera(scene).render(pose @ BODY_FROM_OPTICAL, CAMERA)
    beside = np.abs(shown[:, half:].astype(int) - expected.rgb[:, half:]).max(axis=2)
    assert (beside <= 3).mean() > 0.98
    assert set(np.unique(pixels(received, "classes", np.uint8)[:, :half])) == {1}
    assert not pixels(received, "instances", np.int32)[:, :half].any()
