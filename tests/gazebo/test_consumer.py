"""Gazebo as a consumer accepts a good world, and rejects one whose ground differs from the point cloud."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import Scene, read_scene
from tests.fakes import synthetic
from tests.fakes.consumers import gazebo
from tests.fakes.world_checks import Fault, drops
from tests.fakes.world_checks.reference import Visible, WorldReference, visible
from tests.pipeline.io.test_robots import driven


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return driven(read_scene(synthetic.world(tmp_path_factory.mktemp("gate"), friction=0.9).files["world"]))


@pytest.fixture(scope="module")
def world(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("exported")
    world_formats.write(scene, ["gazebo"], out, SceneParams(), silent, robot=True)
    return out


def reference(lift: float = 0.0, surfaces: tuple[Visible, ...] = ()) -> WorldReference:
    """Reference on the synthetic ground, raised by `lift` metres."""
    xy = np.random.default_rng(0).uniform(-9, 9, (60_000, 2))
    ground = np.column_stack([xy, synthetic.height(*xy.T) + lift])
    along, south = np.arange(-8, 8, 0.5), np.full(32, -7.0)
    return WorldReference(
        ground[[np.argmin(np.hypot(*(xy - at).T)) for at in ((-6, -6), (1, -6))]],
        np.zeros((0, 3)),
        ground,
        np.ones(len(ground), bool),
        (np.column_stack([along, south, synthetic.height(along, south)]),),
        surfaces=surfaces,
    )


def test_bodies_rest_and_the_robot_drives_on_the_clouds_surface(world: Path) -> None:
    metrics = gazebo.check(world, reference())
    assert metrics["robot_driven_m"] > 13 and metrics["robot_left_road"] == 0
    assert metrics["dropped"] == 4 and metrics["drop_max_m"] <= drops.MAX_REST_GAP_M and metrics["fell_through"] == 0


def test_a_lidar_measures_the_distances_to_all_surfaces(scene: Scene, world: Path) -> None:
    metrics = gazebo.check(world, reference(surfaces=tuple(visible(scene))))
    assert metrics["lidar_off_p99_m"] < 1e-3 and metrics["lidar_missing_share"] < 1e-3
    assert {"terrain", "building"} <= {name for name, count in metrics["lidar_rays"].items() if count > 100}


def test_a_surface_missing_from_the_export_is_a_fault(scene: Scene, world: Path) -> None:
    up = np.array([0, 0, 2.5], np.float32)  # just above the lidar
    crown = [replace(one, mesh=replace(one.mesh, vertices=one.mesh.vertices + up)) for one in visible(scene)]
    with pytest.raises(Fault, match="lidar"):
        gazebo.check(world, reference(surfaces=(*visible(scene), *crown)))


def test_ground_5_cm_off_the_cloud_is_a_fault(world: Path) -> None:
    with pytest.raises(Fault, match="don't rest on the cloud's surface"):
        gazebo.check(world, reference(0.05))


def test_a_broken_world_is_a_fault(world: Path) -> None:
    (world / "models/street/meshes/street_terrain_1.png").unlink()
    with pytest.raises(Fault, match="terrain_1"):
        gazebo.check(world, reference())


def test_surface_heights_are_interpolated_from_nearby_points() -> None:
    xy = np.array([[0.3, -2.0], [30, 30]])
    heights = reference().heights(xy)
    assert heights[0] == pytest.approx(synthetic.height(*xy[0]), abs=0.005) and np.isnan(heights[1])
