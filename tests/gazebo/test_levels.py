"""Gazebo's own readers and physics take a survey's world, with all its tiles at their places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.worlds.merge import TileWorld, assemble
from tests.gazebo.checker import check_world
from tests.pipeline import synthetic
from tests.present import present

BOX = 0.2  # half the edge of the dropped box, metres
EAST, DOWN = 25.0, 2.0  # metres from one tile to the next


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    x, y, z = synthetic.UTM.origin
    frames = [replace(synthetic.UTM, origin=(x + EAST * i, y, z - DOWN * i)) for i in range(3)]
    tiles = [
        TileWorld(f"tile{i}", synthetic.world(folder / f"tile{i}", frame, f"tile{i}").files["world"], frame)
        for i, frame in enumerate(frames)
    ]
    return assemble(folder, "town", tiles)


def test_every_tiles_meshes_and_textures_load(world: Path) -> None:
    seen = check_world(world)
    assert seen["world"] == "town"
    meshes = {mesh["file"]: mesh["role"] for mesh in seen["meshes"]}
    for i in range(3):
        folder = f"models/tile{i}/meshes"
        assert meshes[f"{folder}/terrain.obj"] == meshes[f"{folder}/building.obj"] == "visual"
        assert meshes[f"{folder}/collision_terrain.obj"] == "collision" and meshes[f"{folder}/terrain.dae"] == "spare"
    assert len(meshes) == 18


@pytest.mark.parametrize("tile", [0, 2])  # the world's origin is the second tile's
def test_a_box_comes_to_rest_on_the_roof_of_each_tile(world: Path, tile: int) -> None:
    x, y = synthetic.HOUSE[0] + 1.5 + EAST * (tile - 1), synthetic.HOUSE[1] + 1
    roof = 4.5 - DOWN * (tile - 1)
    assert check_world(world, ("box", (x, y, roof + 1.5)))["bodies"][0]["rest"] == pytest.approx(
        [x, y, roof + BOX], abs=0.02
    )


def test_the_world_stands_where_its_middle_tile_does(world: Path) -> None:
    place = check_world(world)["spherical"]
    assert [place["latitude"], place["longitude"]] == pytest.approx(
        present(crs.to_wgs84(synthetic.UTM, (EAST, 0, 0)))[:2], abs=1e-8
    )
