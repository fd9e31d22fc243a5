"""MuJoCo (EGL or OSMesa): balls are dropped, the robot is driven along the road, a photo's view is rendered."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.simulation.robot import ROBOT
from tests.fakes.world_checks import drive, drops, renderings
from tests.fakes.world_checks.drive import Pose
from tests.fakes.world_checks.reference import Photo, WorldReference

FORMAT = "mujoco"
SETTLE_S = 2.5
"""Seconds until balls rest."""
os.environ.setdefault("MUJOCO_GL", "egl")


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    if importlib.util.find_spec("mujoco") is None:
        return "mujoco isn't installed (pip install mujoco)"
    import mujoco

    try:
        mujoco.GLContext(8, 8).free()
    except Exception as why:  # whatever the driver raises
        return f"MuJoCo can't render here ({why}): see MUJOCO_GL in its manual"
    return ""


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Load the world, see the module's docstring."""
    (world,) = (path for path in export.glob("*.xml") if path.stem != ROBOT.name)
    engine = _Engine(world, reference)
    metrics = drops.rest_metrics(drops.rest_gaps(engine.fallen(), reference))
    metrics |= drive.drive(engine, reference)
    photo = renderings.photo(reference)
    return metrics | renderings.compare(export, "mujoco", photo, *engine.render(photo))


class _Engine:
    """The world with balls above its road, and a camera at the photo's pose."""

    def __init__(self, world: Path, reference: WorldReference) -> None:
        import mujoco

        self._mj = mujoco
        spec = mujoco.MjSpec.from_file(str(world))
        self._balls = len(drops.start_positions(reference))
        for i, position in enumerate(drops.start_positions(reference)):
            ball = spec.worldbody.add_body(name=f"ball{i}", pos=position)
            ball.add_freejoint()
            ball.add_geom(
                name=f"ball{i}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[drops.BALL_RADIUS_M, 0, 0], mass=1, condim=6,
                friction=[0.9, 0.01, 0.01],
            )  # fmt: skip
        photo = renderings.photo(reference)
        camera = photo.camera
        spec.worldbody.add_camera(
            name="photo", pos=photo.pose[:3, 3], quat=_quaternion(photo.pose[:3, :3] * [1, -1, -1]),
            resolution=[camera.width, camera.height], sensor_size=[camera.width, camera.height],
            focal_pixel=[camera.fx, camera.fy],
            principal_pixel=[camera.width / 2 - camera.cx - 0.5, camera.height / 2 - camera.cy - 0.5],
        )  # fmt: skip
        spec.visual.global_.offwidth, spec.visual.global_.offheight = camera.width, camera.height
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)

    def fallen(self) -> Any:
        """(N, 3) positions of the balls at rest; afterwards they no longer collide."""
        self._step(SETTLE_S)
        rests = np.array([self._data.body(f"ball{i}").xpos.copy() for i in range(self._balls)])
        for i in range(self._balls):
            self._model.geom(f"ball{i}").contype = self._model.geom(f"ball{i}").conaffinity = 0
        return rests

    def pose(self) -> Pose:
        """Pose of the robot."""
        body = self._data.body(ROBOT.name)
        return Pose(body.xpos.copy(), body.xmat.reshape(3, 3).copy())

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Turn the wheels at the given velocities for some time."""
        for wheel, speed in zip(ROBOT.wheels, (left, right), strict=True):
            self._data.actuator(wheel.name).ctrl[:] = speed
        self._step(seconds)

    def render(self, photo: Photo) -> tuple[U8, Any]:
        """Image from the photo's pose, and mask of the pixels that show the world."""
        with self._mj.Renderer(self._model, photo.camera.height, photo.camera.width) as renderer:
            renderer.update_scene(self._data, "photo")
            taken = renderer.render().copy()
            renderer.enable_segmentation_rendering()
            renderer.update_scene(self._data, "photo")
            return taken, renderer.render()[..., 0] >= 0

    def _step(self, seconds: float) -> None:
        self._mj.mj_step(self._model, self._data, nstep=round(seconds / self._model.opt.timestep))


def _quaternion(rotation: Any) -> Any:
    """Quaternion w, x, y, z."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
