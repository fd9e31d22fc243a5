"""The gate's Gazebo: it lets a good world through, and none whose ground lies elsewhere than the cloud's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.consumers import Fault, gazebo
from bench.gate import drops
from bench.gate.places import Places
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import read_scene
from tests.pipeline import synthetic
from tests.pipeline.io.test_robots import driven


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = synthetic.world(tmp_path_factory.mktemp("gate"), friction=0.9).files["world"]
    out = tmp_path_factory.mktemp("exported")
    world_formats.write(driven(read_scene(made)), ["gazebo"], out, SceneParams(), silent, robot=True)
    return out


def places(lift: float = 0.0) -> Places:
    """On the made-up ground, as a cloud that is so much higher would have it."""
    xy = np.random.default_rng(0).uniform(-9, 9, (60_000, 2))
    ground = np.column_stack([xy, synthetic.height(*xy.T) + lift])
    along, south = np.arange(-8, 8, 0.5), np.full(32, -7.0)
    return Places(
        ground[[np.argmin(np.hypot(*(xy - at).T)) for at in ((-6, -6), (1, -6))]],
        np.zeros((0, 3)),
        ground,
        np.ones(len(ground), bool),
        (np.column_stack([along, south, synthetic.height(along, south)]),),
    )


def test_bodies_rest_on_the_clouds_surface_and_the_robot_drives_on_it(world: Path) -> None:
    figures = gazebo.check(world, places())
    assert figures["robot_driven_m"] > 13 and figures["robot_left_road"] == 0
    assert figures["dropped"] == 4 and figures["drop_max_m"] <= drops.WITHIN and figures["fell_through"] == 0


def test_a_ground_that_lies_5_cm_off_the_cloud_is_a_fault(world: Path) -> None:
    with pytest.raises(Fault, match="don't come to rest"):
        gazebo.check(world, places(0.05))


def test_a_broken_world_is_a_fault(world: Path) -> None:
    (world / "models/street/meshes/terrain_1.png").unlink()
    with pytest.raises(Fault, match="terrain_1"):
        gazebo.check(world, places())


def test_the_surface_is_that_of_the_points_around() -> None:
    some = places()
    xy = np.array([[0.3, -2.0], [30, 30]])
    heights = some.heights(xy)
    assert heights[0] == pytest.approx(synthetic.height(*xy[0]), abs=0.005) and np.isnan(heights[1])
