"""A robot drives through a world in MuJoCo, filmed by the camera in Python: `python -m bench.robot_film --world WORLD`.

MuJoCo simulates the exported robot on the world's collision mesh, and a box car that comes towards it; the camera on
the robot, and one that follows it, see the street by `scan2sim.camera`, with MuJoCo's bodies in front by depth. Writes
`film.mp4` (following camera) and `sheet.png` (both cameras, depth and instances) into bench-out/robot-film, and prints
RESULT with the number of frames, seconds per frame, and the distance driven.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("MUJOCO_GL", "egl")  # no screen needed

import scan2sim
from bench.paths import ROOT
from scan2sim.pipeline.camera.renderer import look_at, pinhole
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F32, F64, U8, Camera
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.simulation.robot import ROBOT
from scan2sim.services.world_camera.views import View, composed, rendered

OPTICAL_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0, 1.0])
"""MuJoCo's cameras look along -z, y up."""
ROBOT_SPEED, CAR_SPEED, CAR_AHEAD_M, CAR_LEFT_M = 1.0, -1.0, 14.0, 2.4
"""Metres per second along the road; where the car is when time begins, relative to the robot."""
FOLLOW_M = np.array([-2.6, 1.1, 1.7])
"""The following camera relative to the robot: behind, to the left, above."""
SCENERY_GROUPS, BODY_GROUP = (2, 3), 0
"""Groups of the exported world's geometries, and of the robot's and the car's."""
FPS, CAR_NAME, FOLLOWER = 10, "oncoming_car", "follower"
CAR = (
    ("body", (2.1, 0.85, 0.33), (0, 0, 0.62), (0.55, 0.06, 0.08)),
    ("cabin", (1.1, 0.74, 0.28), (-0.15, 0, 1.2), (0.1, 0.11, 0.13)),
)
"""Boxes of the car: name, half sizes, position, colour."""
WHEELS = [(x, y) for x in (-1.3, 1.3) for y in (-0.75, 0.75)]


@dataclass(frozen=True)
class Frame:
    """A view of the street with MuJoCo's bodies in it, and seconds that the street and the whole took."""

    view: View
    street_s: float
    whole_s: float


class Film:
    """The simulation and its cameras."""

    def __init__(self, world: Path, export: Path, camera: Camera) -> None:
        """Export the world with its robot to MuJoCo below `export`, and add a car and a following camera."""
        import mujoco

        scene = scan2sim.read_world(world).scene
        world_formats.write(scene, ["mujoco"], export, SceneParams(), silent, robot=True)
        spec = mujoco.MjSpec.from_file(str(export / f"{scene.name}.xml"))
        spec.visual.global_.offwidth, spec.visual.global_.offheight = camera.width, camera.height
        start = json.loads((export / "metadata.json").read_text(encoding="utf-8"))["robot"]
        self.start, self.yaw = np.array(start["position_m"]), start["angles_rad"][2]
        _add_car(mujoco, spec)
        focal = camera.fy
        fovy = float(np.degrees(2 * np.arctan(camera.height / 2 / focal)))
        spec.worldbody.add_camera(name=FOLLOWER, mode=mujoco.mjtCamLight.mjCAMLIGHT_FIXED, fovy=fovy)
        self.model = spec.compile()
        self.model.camera("camera").fovy[:] = fovy
        self.data, self._mujoco = mujoco.MjData(self.model), mujoco
        self._street, self._camera = scan2sim.camera(world), camera
        self._renderer = mujoco.Renderer(self.model, camera.height, camera.width)
        self._shown = mujoco.MjvOption()
        self._shown.geomgroup[list(SCENERY_GROUPS)] = 0

    def step(self, seconds: float) -> None:
        """Simulate until a time; the car moves as given, the robot by its wheels."""
        self.data.ctrl[:] = ROBOT_SPEED / ROBOT.wheel_radius
        while self.data.time < seconds:
            self._place_car()
            self._mujoco.mj_step(self.model, self.data)
        self._place_follower()
        self._mujoco.mj_forward(self.model, self.data)

    def _along(self, ahead: float, left: float) -> F64:
        """Position on the ground (3,) relative to where the robot started."""
        direction = np.array([np.cos(self.yaw), np.sin(self.yaw)])
        xy = self.start[:2] + ahead * direction + left * np.array([-direction[1], direction[0]])
        hit, down = np.zeros(1, np.int32), np.array([0.0, 0, -1])
        above, collides = np.array([*xy, self.start[2] + 3]), np.array([0, 0, 0, 1, 0, 0], np.uint8)
        distance = self._mujoco.mj_ray(self.model, self.data, above, down, collides, 1, -1, hit, None)
        return np.array([*xy, above[2] - distance if distance >= 0 else self.start[2]])

    def _place_car(self) -> None:
        body = self.model.body(CAR_NAME)
        index = body.mocapid[0]
        self.data.mocap_pos[index] = self._along(CAR_AHEAD_M + CAR_SPEED * self.data.time, CAR_LEFT_M)
        half = (self.yaw + np.pi) / 2
        self.data.mocap_quat[index] = np.cos(half), 0, 0, np.sin(half)

    def _place_follower(self) -> None:
        robot = self.data.body("robot")
        forward = robot.xmat.reshape(3, 3)[:2, 0] / np.linalg.norm(robot.xmat.reshape(3, 3)[:2, 0])
        ahead, left = np.array([*forward, 0]), np.array([-forward[1], forward[0], 0])
        eye = robot.xpos + np.column_stack([ahead, left, [0, 0, 1]]) @ FOLLOW_M
        pose = look_at(eye, robot.xpos + 3.5 * ahead + (0, 0, 0.5)) @ OPTICAL_FROM_MUJOCO
        camera = self.model.camera(FOLLOWER)
        camera.pos[:] = eye
        self._mujoco.mju_mat2Quat(camera.quat, np.ascontiguousarray(pose[:3, :3]).ravel())

    def take(self, name: str) -> Frame:
        """The street seen by a camera of the model, with MuJoCo's bodies in front."""
        begun = time.perf_counter()
        seen = self.data.camera(name)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = seen.xmat.reshape(3, 3), seen.xpos
        street = rendered(self._street, self._camera, (pose @ OPTICAL_FROM_MUJOCO)[None])
        street_s = time.perf_counter() - begun
        view = composed(street, *self._bodies(name), 0.0)
        return Frame(view, street_s, time.perf_counter() - begun)

    def _bodies(self, name: str) -> tuple[U8, F32]:
        """Colour (H, W, 3) and depth (H, W) of the robot and the car alone, inf elsewhere."""
        self._renderer.update_scene(self.data, name, self._shown)
        rgb = self._renderer.render().copy()
        self._renderer.enable_segmentation_rendering()
        is_body = self._renderer.render()[..., 0] >= 0
        self._renderer.disable_segmentation_rendering()
        self._renderer.enable_depth_rendering()
        depth = np.where(is_body, self._renderer.render(), np.inf).astype(np.float32)
        self._renderer.disable_depth_rendering()
        return rgb, depth

    @property
    def driven_m(self) -> float:
        """Metres that the robot has driven."""
        return float(np.linalg.norm(self.data.body("robot").xpos[:2] - self.start[:2]))


def _add_car(mujoco: Any, spec: Any) -> None:
    """Add a car of boxes, which moves as given (a mocap body) and collides with nothing."""
    car = spec.worldbody.add_body(name=CAR_NAME, mocap=True)
    shared = {"contype": 0, "conaffinity": 0, "group": BODY_GROUP}
    for name, half, position, rgb in CAR:
        box = mujoco.mjtGeom.mjGEOM_BOX
        car.add_geom(name=f"car_{name}", type=box, size=half, pos=position, rgba=(*rgb, 1), **shared)
    for k, (x, y) in enumerate(WHEELS):
        end = (x, y - 0.1, 0.32, x, y + 0.1, 0.32)
        cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
        car.add_geom(
            name=f"car_wheel{k}", type=cylinder, size=(0.32, 0, 0), fromto=end, rgba=(0.05, 0.05, 0.05, 1), **shared
        )


def _depth_picture(depth: F32) -> U8:
    """Depth as colours: near is bright, inf black."""
    import cv2

    level = np.where(np.isfinite(depth), np.clip(255 * 2 / np.maximum(depth, 2), 0, 255), 0).astype(np.uint8)
    return np.asarray(cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB), np.uint8)


def _instance_picture(view: View) -> U8:
    """Instances as colours over the grey image; what MuJoCo shows (class 1) is white."""
    table = np.random.default_rng(5).integers(40, 256, (4096, 3))
    grey = np.repeat(view.rgb.mean(axis=2, keepdims=True), 3, axis=2)
    colour = np.where((view.instance > 0)[..., None], 0.35 * grey + 0.65 * table[view.instance % 4096], 0.6 * grey)
    return np.where((view.code == 1)[..., None], 255, colour).astype(np.uint8)


def main() -> None:
    """Film a drive."""
    import cv2

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", type=Path, default=ROOT / "demo-out", help="output folder of `run` or `survey`")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "robot-film")
    parser.add_argument("--seconds", type=float, default=8.0, help="simulated time")
    parser.add_argument("--size", type=int, nargs=2, default=(960, 540), metavar=("WIDTH", "HEIGHT"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    width, height = arguments.size
    film = Film(arguments.world, arguments.out / "export", pinhole(width, height, field=80))
    count = round(arguments.seconds * FPS)
    shown = np.linspace(0, count - 1, 4).round().astype(int).tolist()
    frames, rows = list[Frame](), list[U8]()
    with Encoder(arguments.out / "film.mp4", (width, height), FPS, preset="medium", crf="20") as encoder:
        for k in range(count):
            film.step((k + 1) / FPS)
            frames.append(film.take(FOLLOWER))
            encoder.add(np.asarray(cv2.cvtColor(frames[-1].view.rgb, cv2.COLOR_RGB2YUV_I420), np.uint8), k / FPS)
            if k in shown:
                own, around = film.take("camera").view, frames[-1].view
                rows.append(np.hstack([around.rgb, own.rgb, _depth_picture(around.depth), _instance_picture(around)]))
    sheet = cv2.resize(np.vstack(rows), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(arguments.out / "sheet.png"), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    result = {
        "frames": count,
        "size": [width, height],
        "seconds_per_frame": round(float(np.median([one.whole_s for one in frames])), 3),
        "street_seconds_per_frame": round(float(np.median([one.street_s for one in frames])), 3),
        "driven_m": round(film.driven_m, 2),
        "pixels_of_bodies": round(float(np.mean([(one.view.code == 1).mean() for one in frames])), 4),
    }
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
