"""Step for the floor of a robot map: task graph, metrics and warnings, and bodies dropped on the floor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from scan2sim.flows.pipelines.graph import Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud, RobotMap
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.collision import CollisionParams, collision
from scan2sim.pipeline.steps.floor import FloorParams, floor
from tests.pipeline.terrain.test_floor_map import SIZE, inside, level, noisy, walls

SAMPLE = Path(__file__).resolve().parents[3] / "data_samples" / "tile" / "tile.toml"
FRAME = Frame("local", (0.0, 0.0, 0.0))
BALL_RADIUS_M = 0.1


def run(folder: Path, ground: np.ndarray, others: np.ndarray) -> Done:
    empty = np.zeros((0, 3), np.float32)
    parts = {"terrain": ground, "building": others, "vegetation": empty, "rest": empty}
    for name, xyz in parts.items():
        PointCloud(FRAME, xyz.astype(np.float32)).save(folder / f"{name}.npz")
    return floor({name: folder / f"{name}.npz" for name in parts}, FloorParams(), folder, silent)


def test_only_robot_maps_have_the_floor_task() -> None:
    tile = read_tile(SAMPLE)
    plain = {task.id.name for task in build_graph(tile, Settings())}
    assert not {"floor"} & plain
    tasks = {
        task.id.name
        for task in build_graph(replace(tile, robot_map=RobotMap("indoor", 0.05, 1.0, np.eye(4))), Settings())
    }
    assert "floor" in tasks and not {"ground", "walls", "poisson.terrain", "trim.terrain"} & tasks


@pytest.mark.parametrize("scene", ["indoor", "outdoor"])
def test_bodies_in_a_mesh_of_rooms_collide_with_a_floor_without_holes(scene: Literal["indoor", "outdoor"]) -> None:
    robot_map = RobotMap(scene, 0.05, 1.0, np.eye(4), source_mesh=SAMPLE)
    tasks = {task.id.name: task for task in build_graph(replace(read_tile(SAMPLE), robot_map=robot_map), Settings())}
    source = tasks["collision"].inputs["terrain"]
    assert isinstance(source, Output)
    assert (source.task.name == "floor") == (scene == "indoor") and ("floor" in tasks) == (scene == "indoor")
    assert {"unwrap.terrain", "split_mesh"} <= set(tasks)  # the visual mesh is unchanged


def test_assumed_floor_is_marked_in_metrics_warnings_points_and_mask(tmp_path: Path) -> None:
    ground = level((0, 0), (SIZE, SIZE))
    done = run(tmp_path, noisy(ground[ground[:, 0] < 3]), noisy(walls()))
    assert done.metrics["assumed_share"] == pytest.approx(0.5, abs=0.05)
    assert any("not scanned" in text for text in done.warnings)
    made = PointCloud.load(done.files["synthesized"])
    assert (made.xyz[:, 0] > 2.9).mean() > 0.98
    with np.load(done.files["mask"]) as mask:
        assert mask["assumed_0"].sum() == len(made)
        assert np.isfinite(mask["height_0"][mask["assumed_0"]]).all()


def test_map_without_ground_warns_of_a_floor_from_walls(tmp_path: Path) -> None:
    done = run(tmp_path, np.zeros((0, 3)), noisy(walls()))
    assert done.metrics["ground_missing"] and "feet of the walls" in done.warnings[0]


def test_map_without_ground_and_walls_is_accepted(tmp_path: Path) -> None:
    done = run(tmp_path, np.zeros((0, 3)), np.zeros((0, 3)))
    assert done.metrics["storeys"] == 0 and "no floor" in done.warnings[0]


def test_bodies_dropped_anywhere_in_the_room_rest_on_the_floor(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    ground = level((0, 0), (SIZE, SIZE))
    hole = (np.abs(ground[:, :2] - [4, 4]) < 1.2).all(axis=1)
    spikes = np.column_stack([inside(40, 0.5), np.random.default_rng(0).uniform(-0.3, 0.3, 40)])
    done = run(tmp_path, noisy(np.concatenate([ground[~hole], spikes])), noisy(walls()))
    collision({"terrain": done.files["mesh"]}, CollisionParams(), tmp_path, silent)
    solid = Mesh.load(tmp_path / "collision.npz")
    spec = mujoco.MjSpec()
    # MuJoCo's meshes are convex: each triangle is a thin prism
    for i, corners in enumerate(solid.corners.astype(np.float64)):
        points = np.concatenate([corners, corners - [0, 0, 0.2]])
        spec.add_mesh(name=f"m{i}", uservert=points.ravel())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{i}")
    xy = inside(60, 0.3)
    for position in xy:
        body = spec.worldbody.add_body(pos=[*position, 0.4])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BALL_RADIUS_M, 0, 0], mass=1, condim=6,
                      friction=[0.9, 0.01, 0.01], contype=2, conaffinity=1)  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(2 / model.opt.timestep))
    z = data.xpos[1:, 2] - BALL_RADIUS_M
    assert np.abs(z).max() < 0.05
