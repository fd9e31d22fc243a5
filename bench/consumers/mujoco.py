"""MuJoCo: balls fall, the robot is driven along the road, a picture is taken from a photo's pose (EGL or OSMesa)."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import numpy as np

from bench.gate import drive, drops, renderings
from bench.gate.drive import Pose
from bench.gate.places import Places
from bench.gate.renderings import Photo
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.simulation.robot import ROBOT

FORMAT = "mujoco"
REST = 2.5
"""Seconds until balls rest."""
os.environ.setdefault("MUJOCO_GL", "egl")


def missing() -> str:
    """Why it can't run here, or an empty text."""
    if importlib.util.find_spec("mujoco") is None:
        return "mujoco isn't installed (pip install mujoco)"
    import mujoco

    try:
        mujoco.GLContext(8, 8).free()
    except Exception as why:  # whatever the driver raises
        return f"MuJoCo can't draw here ({why}): see MUJOCO_GL in its manual"
    return ""


def check(export: Path, places: Places) -> dict[str, Any]:
    """Load the world; see the module."""
    (world,) = (path for path in export.glob("*.xml") if path.stem != ROBOT.name)
    engine = _Engine(world, places)
    figures = drops.told(drops.gaps(engine.fallen(), places))
    figures |= drive.drive(engine, places)
    seen = renderings.photo(places)
    return figures | renderings.compare(export, "mujoco", seen, *engine.picture(seen))


class _Engine:
    """The world with balls above its road, and a camera to be placed."""

    def __init__(self, world: Path, places: Places) -> None:
        import mujoco

        self._mj = mujoco
        spec = mujoco.MjSpec.from_file(str(world))
        self._balls = len(drops.starts(places))
        for i, place in enumerate(drops.starts(places)):
            ball = spec.worldbody.add_body(name=f"ball{i}", pos=place)
            ball.add_freejoint()
            ball.add_geom(
                name=f"ball{i}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[drops.BALL, 0, 0], mass=1, condim=6,
                friction=[0.9, 0.01, 0.01],
            )  # fmt: skip
        seen = renderings.photo(places)
        own = seen.camera
        spec.worldbody.add_camera(
            name="photo", pos=seen.pose[:3, 3], quat=_quaternion(seen.pose[:3, :3] * [1, -1, -1]),
            resolution=[own.width, own.height], sensor_size=[own.width, own.height], focal_pixel=[own.fx, own.fy],
            principal_pixel=[own.width / 2 - own.cx - 0.5, own.height / 2 - own.cy - 0.5],
        )  # fmt: skip
        spec.visual.global_.offwidth, spec.visual.global_.offheight = own.width, own.height
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)

    def fallen(self) -> Any:
        """(N, 3) where balls rest; nothing holds them any more then."""
        self._step(REST)
        rests = np.array([self._data.body(f"ball{i}").xpos.copy() for i in range(self._balls)])
        for i in range(self._balls):
            self._model.geom(f"ball{i}").contype = self._model.geom(f"ball{i}").conaffinity = 0
        return rests

    def pose(self) -> Pose:
        """Where the robot is."""
        body = self._data.body(ROBOT.name)
        return Pose(body.xpos.copy(), body.xmat.reshape(3, 3).copy())

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Have the wheels turn so fast for a time."""
        for wheel, speed in zip(ROBOT.wheels, (left, right), strict=True):
            self._data.actuator(wheel.name).ctrl[:] = speed
        self._step(seconds)

    def picture(self, seen: Photo) -> tuple[U8, Any]:
        """What a camera sees from a photo's pose, and where it sees anything."""
        with self._mj.Renderer(self._model, seen.camera.height, seen.camera.width) as renderer:
            renderer.update_scene(self._data, "photo")
            taken = renderer.render().copy()
            renderer.enable_segmentation_rendering()
            renderer.update_scene(self._data, "photo")
            return taken, renderer.render()[..., 0] >= 0

    def _step(self, seconds: float) -> None:
        self._mj.mj_step(self._model, self._data, nstep=round(seconds / self._model.opt.timestep))


def _quaternion(rotation: Any) -> Any:
    """w, x, y, z."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
