"""Gazebo's own libraries load the world of a survey, with all tiles at their positions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.worlds.merge import TileWorld, assemble
from tests.fakes import synthetic
from tests.fakes.gazebo.checker import check_world
from tests.present import present

BOX_HALF_EDGE_M = 0.2
EAST_M, DOWN_M = 25.0, 2.0
"""Offset between successive tiles."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    x, y, z = synthetic.UTM.origin
    frames = [replace(synthetic.UTM, origin=(x + EAST_M * i, y, z - DOWN_M * i)) for i in range(3)]
    tiles = [
        TileWorld(f"tile{i}", synthetic.world(folder / f"tile{i}", frame, f"tile{i}").files["world"], frame)
        for i, frame in enumerate(frames)
    ]
    return assemble(folder, "town", tiles)


def test_meshes_and_textures_of_all_tiles_load(world: Path) -> None:
    loaded = check_world(world)
    assert loaded["world"] == "town"
    meshes = {mesh["file"]: mesh["role"] for mesh in loaded["meshes"]}
    for i in range(3):
        folder = f"models/tile{i}/meshes"
        assert meshes[f"{folder}/terrain.obj"] == meshes[f"{folder}/building.obj"] == "visual"
        assert meshes[f"{folder}/collision_terrain.obj"] == "collision" and meshes[f"{folder}/terrain.dae"] == "spare"
    assert len(meshes) == 18


@pytest.mark.parametrize("tile", [0, 2])  # the world's origin is that of the second tile
def test_a_box_comes_to_rest_on_the_roof_of_each_tile(world: Path, tile: int) -> None:
    x, y = synthetic.HOUSE[0] + 1.5 + EAST_M * (tile - 1), synthetic.HOUSE[1] + 1
    roof = 4.5 - DOWN_M * (tile - 1)
    (body,) = check_world(world, ("box", (x, y, roof + 1.5)))["bodies"]
    assert body["rest"] == pytest.approx([x, y, roof + BOX_HALF_EDGE_M], abs=0.02)


def test_the_worlds_origin_is_that_of_the_middle_tile(world: Path) -> None:
    spherical = check_world(world)["spherical"]
    assert [spherical["latitude"], spherical["longitude"]] == pytest.approx(
        present(crs.to_wgs84(synthetic.UTM, (EAST_M, 0, 0)))[:2], abs=1e-8
    )
