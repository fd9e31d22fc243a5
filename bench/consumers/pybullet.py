"""PyBullet: balls fall, the robot is driven along the road, a picture is taken from a photo's pose (TinyRenderer)."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np

from bench.gate import drive, drops, renderings
from bench.gate.drive import Pose
from bench.gate.places import Places
from bench.gate.renderings import Photo
from scan2sim.pipeline.core.types import F64, U8
from scan2sim.pipeline.simulation.robot import ROBOT

FORMAT = "urdf"
STEP = 1 / 240
REST = 2.5
"""Seconds until balls rest."""
NEAR, FAR = 0.1, 300.0
"""Metres that its camera sees."""


def missing() -> str:
    """Why it can't run here, or an empty text."""
    return "" if importlib.util.find_spec("pybullet") else "pybullet isn't installed (pip install pybullet)"


def check(export: Path, places: Places) -> dict[str, Any]:
    """Load the world; see the module."""
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        engine = _Engine(export)
        figures = drops.told(drops.gaps(engine.fallen(drops.starts(places)), places))
        figures |= drive.drive(engine, places)
        seen = renderings.photo(places)
        return figures | renderings.compare(export, "pybullet", seen, *engine.picture(seen))
    finally:
        pybullet.disconnect(client)


class _Engine:
    """The world and the robot, by the export's own files."""

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

    def fallen(self, starts: F64) -> F64:
        """(N, 3) where balls rest; they are taken away then."""
        shape = self._p.createCollisionShape(self._p.GEOM_SPHERE, radius=drops.BALL)
        balls = [self._p.createMultiBody(1, shape, basePosition=place) for place in starts.tolist()]
        for ball in balls:
            self._p.changeDynamics(ball, -1, rollingFriction=0.01, spinningFriction=0.01)
        self._step(REST)
        rests = np.array([self._p.getBasePositionAndOrientation(ball)[0] for ball in balls])
        for ball in balls:
            self._p.removeBody(ball)
        return rests

    def pose(self) -> Pose:
        """Where the robot is: PyBullet tells of the middle of its body's mass."""
        place, quaternion = self._p.getBasePositionAndOrientation(self._robot)
        rotation = np.reshape(self._p.getMatrixFromQuaternion(quaternion), (3, 3))
        return Pose(np.asarray(place) - rotation @ ROBOT.base.place, rotation)

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Have the wheels turn so fast for a time."""
        for wheel, speed in zip(ROBOT.wheels, (left, right), strict=True):
            joint = self._joints[f"{wheel.name}_joint"]
            kind = self._p.VELOCITY_CONTROL
            self._p.setJointMotorControl2(self._robot, joint, kind, targetVelocity=speed, force=ROBOT.torque)
        self._step(seconds)

    def picture(self, seen: Photo) -> tuple[U8, Any]:
        """What a camera sees from a photo's pose, and where it sees anything."""
        own = seen.camera
        left, top = -(own.cx + 0.5) / own.fx, (own.cy + 0.5) / own.fy
        right, bottom = left + own.width / own.fx, top - own.height / own.fy
        lens = self._p.computeProjectionMatrix(*(NEAR * side for side in (left, right, bottom, top)), NEAR, FAR)
        centre, rotation = seen.pose[:3, 3], seen.pose[:3, :3]
        view = self._p.computeViewMatrix(centre, centre + rotation[:, 2], -rotation[:, 1])
        taken = self._p.getCameraImage(
            own.width, own.height, view, lens, shadow=0, lightAmbientCoeff=1.0, lightDiffuseCoeff=0.0,
            lightSpecularCoeff=0.0, renderer=self._p.ER_TINY_RENDERER,
        )  # fmt: skip
        rgb = np.reshape(taken[2], (own.height, own.width, 4))[..., :3].astype(np.uint8)
        return rgb, np.reshape(taken[4], (own.height, own.width)) >= 0

    def _step(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self._p.stepSimulation()
