"""Worlds of robot maps in MuJoCo: bodies collide exactly with the collision mesh, on every storey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.geometry.fitted_boxes import Box, mesh_of
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import COLLISION_FILE, RobotMapFrame, Scene
from tests.fakes import synthetic

HALF_M = 0.1
"""Half the side of the boxes that are dropped."""


def box(low: tuple[float, float, float], high: tuple[float, float, float], heading: float = 0.0) -> tuple[Any, Any]:
    return mesh_of([Box(heading, np.array(low), np.array(high))])


def floor(low: tuple[float, float], high: tuple[float, float], z: float) -> tuple[Any, Any]:
    (a, b), (c, d) = low, high
    return np.array([[a, b, z], [c, b, z], [c, d, z], [a, d, z]], np.float32), np.array([[0, 1, 2], [0, 2, 3]])


def world(folder: Path, grounds: list[tuple[Any, Any]], solids: list[tuple[Any, Any]]) -> Scene:
    """A scene made from a robot's map that collides with these surfaces."""
    scene = replace(synthetic.scene(folder, tiles=1, frame=Frame()), robot_map=RobotMapFrame(np.eye(4)))
    parts = grounds + solids
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = np.concatenate([part[1] + n for part, n in zip(parts, first, strict=False)]).astype(np.int32)
    codes = [CODE["terrain"]] * len(grounds) + [CODE["building"]] * len(solids)
    classification = np.repeat(codes, [len(faces) for _, faces in parts]).astype(np.uint8)
    mesh = Mesh(Frame(), np.concatenate([v for v, _ in parts]), faces, classification=classification)
    (scene.tiles[0].folder / COLLISION_FILE).unlink()
    mesh.save(scene.tiles[0].folder / COLLISION_FILE)
    return scene


def spec(scene: Scene, folder: Path) -> Any:
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed")
    world_formats.write(scene, ["mujoco"], folder, SceneParams(), silent)
    return mujoco.MjSpec.from_file(str(folder / "town.xml"))


def heights_at_rest(scene: Scene, folder: Path, positions: list[tuple[float, float, float]]) -> np.ndarray:
    """Heights of the undersides of boxes that were dropped at positions."""
    import mujoco

    own = spec(scene, folder)
    for i, position in enumerate(positions):
        body = own.worldbody.add_body(name=f"box{i}", pos=position)
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[HALF_M] * 3, mass=5, contype=1, conaffinity=0)
    model = own.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(2 / model.opt.timestep))
    return np.array([data.body(f"box{i}").xpos[2] - HALF_M for i in range(len(positions))])


def test_bodies_fall_freely_below_and_beside_furniture_and_walls(tmp_path: Path) -> None:
    heading = 0.5
    c, s = np.cos(heading), np.sin(heading)
    table = box((0.0, 0.0, 0.68), (1.2, 0.7, 0.72), heading)
    wall = box((0.0, 2.0, 0.0), (3.0, 2.1, 2.5), heading)
    scene = world(tmp_path / "in", [floor((-5, -5), (5, 5), 0.0)], [table, wall])

    def place(u: float, v: float, z: float) -> tuple[float, float, float]:
        return c * u - s * v, s * u + c * v, z

    positions = [place(0.6, 0.35, 0.4), place(0.6, 0.35, 1.2), place(0.6, -0.12, 1.2), place(1.5, 1.88, 1.0)]
    rest = heights_at_rest(scene, tmp_path / "out", positions)
    assert rest == pytest.approx([0.0, 0.72, 0.0, 0.0], abs=0.02)  # under the table, on it, beside it and the wall


def test_bodies_rest_on_every_storey(tmp_path: Path) -> None:
    """The upper floor covers half of the lower one; stairs lead to it."""
    stairs = np.array([[-1, 1, 0], [-1, 2, 0], [2, 2, 3], [2, 1, 3]], np.float32), np.array([[0, 2, 1], [0, 3, 2]])
    grounds = [floor((-5, -5), (5, 5), 0.0), floor((2, -5), (5, 5), 3.0), stairs]
    scene = world(tmp_path / "in", grounds, [])
    rest = heights_at_rest(scene, tmp_path / "out", [(-3, 0, 0.5), (3.5, 0, 0.5), (3.5, 0, 3.5), (4.5, 4, 3.5)])
    assert rest == pytest.approx([0, 0, 3, 3], abs=0.02)


def test_ball_comes_to_rest_on_a_floor_with_a_slope_of_one_degree(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed")
    vertices, faces = floor((-5, -5), (5, 5), 0.0)
    vertices[:, 2] = np.tan(np.radians(1)) * vertices[:, 0]
    own = spec(world(tmp_path / "in", [(vertices, faces)], []), tmp_path / "out")
    ball = own.worldbody.add_body(name="ball", pos=[0, 0, 0.4])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], mass=1)
    model = own.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(4 / model.opt.timestep))
    assert np.linalg.norm(data.body("ball").cvel[3:]) < 0.05 and abs(data.body("ball").xpos[0]) < 0.5
