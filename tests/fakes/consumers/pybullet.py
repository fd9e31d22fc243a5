"""PyBullet: balls are dropped, the robot is driven along the road, an image is rendered from a photo's pose."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, U8
from scan2sim.pipeline.simulation.robot import ROBOT
from tests.fakes.world_checks import drive, drops, renderings
from tests.fakes.world_checks.drive import Pose
from tests.fakes.world_checks.reference import Photo, WorldReference

FORMAT = "urdf"
TIME_STEP_S = 1 / 240
SETTLE_S = 2.5
"""Seconds until balls rest."""
NEAR_PLANE_M, FAR_PLANE_M = 0.1, 300.0
"""Clipping planes of its camera."""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if importlib.util.find_spec("pybullet") else "pybullet isn't installed (pip install pybullet)"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Load the world, see the module's docstring."""
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        engine = _Engine(export)
        metrics = drops.rest_metrics(drops.rest_gaps(engine.fallen(drops.start_positions(reference)), reference))
        metrics |= drive.drive(engine, reference)
        photo = renderings.photo(reference)
        return metrics | renderings.compare(export, "pybullet", photo, *engine.render(photo))
    finally:
        pybullet.disconnect(client)


class _Engine:
    """The world and the robot, loaded from the export's files."""

    def __init__(self, export: Path) -> None:
        import pybullet

        self._p = pybullet
        pybullet.setGravity(0, 0, -9.8)
        (world,) = (path for path in export.glob("*.urdf") if path.stem != ROBOT.name)
        pybullet.loadURDF(str(world), useFixedBase=True)
        start = json.loads((export / "metadata.json").read_text(encoding="utf-8"))["robot"]
        angles = pybullet.getQuaternionFromEuler(start["angles_rad"])
        self._robot = pybullet.loadURDF(str(export / f"{ROBOT.name}.urdf"), start["position_m"], angles)
        joints = range(pybullet.getNumJoints(self._robot))
        self._joints = {pybullet.getJointInfo(self._robot, i)[1].decode(): i for i in joints}

    def fallen(self, start_positions: F64) -> F64:
        """(N, 3) positions of the balls at rest; afterwards they are removed."""
        shape = self._p.createCollisionShape(self._p.GEOM_SPHERE, radius=drops.BALL_RADIUS_M)
        balls = [self._p.createMultiBody(1, shape, basePosition=position) for position in start_positions.tolist()]
        for ball in balls:
            self._p.changeDynamics(ball, -1, rollingFriction=0.01, spinningFriction=0.01)
        self._step(SETTLE_S)
        rests = np.array([self._p.getBasePositionAndOrientation(ball)[0] for ball in balls])
        for ball in balls:
            self._p.removeBody(ball)
        return rests

    def pose(self) -> Pose:
        """Pose of the robot; PyBullet reports the centre of mass of its base."""
        position, quaternion = self._p.getBasePositionAndOrientation(self._robot)
        rotation = np.reshape(self._p.getMatrixFromQuaternion(quaternion), (3, 3))
        return Pose(np.asarray(position) - rotation @ ROBOT.base.place, rotation)

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Turn the wheels at the given velocities for some time."""
        for wheel, speed in zip(ROBOT.wheels, (left, right), strict=True):
            joint = self._joints[f"{wheel.name}_joint"]
            kind = self._p.VELOCITY_CONTROL
            self._p.setJointMotorControl2(self._robot, joint, kind, targetVelocity=speed, force=ROBOT.torque)
        self._step(seconds)

    def render(self, photo: Photo) -> tuple[U8, Any]:
        """Image from the photo's pose, and mask of the pixels that show the world."""
        camera = photo.camera
        left, top = -(camera.cx + 0.5) / camera.fx, (camera.cy + 0.5) / camera.fy
        right, bottom = left + camera.width / camera.fx, top - camera.height / camera.fy
        lens = self._p.computeProjectionMatrix(
            *(NEAR_PLANE_M * side for side in (left, right, bottom, top)), NEAR_PLANE_M, FAR_PLANE_M
        )
        centre, rotation = photo.pose[:3, 3], photo.pose[:3, :3]
        view = self._p.computeViewMatrix(centre, centre + rotation[:, 2], -rotation[:, 1])
        taken = self._p.getCameraImage(
            camera.width, camera.height, view, lens, shadow=0, lightAmbientCoeff=1.0, lightDiffuseCoeff=0.0,
            lightSpecularCoeff=0.0, renderer=self._p.ER_TINY_RENDERER,
        )  # fmt: skip
        rgb = np.reshape(taken[2], (camera.height, camera.width, 4))[..., :3].astype(np.uint8)
        return rgb, np.reshape(taken[4], (camera.height, camera.width)) >= 0

    def _step(self, seconds: float) -> None:
        for _ in range(round(seconds / TIME_STEP_S)):
            self._p.stepSimulation()
