"""Gazebo's own readers and physics take what the export writes, and refuse what is broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.world_formats import SceneParams
from tests.gazebo.checker import Refused, check_world
from tests.pipeline import synthetic
from tests.pipeline.io.test_robots import driven
from tests.present import present

BOX = 0.2  # half the edge of the dropped box, metres


@pytest.fixture
def world(tmp_path: Path) -> Path:
    return synthetic.world(tmp_path).files["world"] / "street.sdf"


def test_every_mesh_and_texture_loads(world: Path) -> None:
    seen = check_world(world)
    roles = {Path(mesh["file"]).name: mesh["role"] for mesh in seen["meshes"]}
    assert roles == {
        "terrain.obj": "visual",
        "building.obj": "visual",
        "collision_terrain.obj": "collision",
        "collision_building.obj": "collision",
        "terrain.dae": "spare",
        "building.dae": "spare",
    }
    for mesh in seen["meshes"]:
        group = Path(mesh["file"]).stem
        if group.startswith("collision"):
            continue
        assert mesh["textures"] == [f"{group}_0.png", f"{group}_1.png"]
        low, high = ((-10, -10), (10, 10)) if group == "terrain" else ((4, 2, -0.5), (7, 4, 4.5))
        assert mesh["low"][: len(low)] == pytest.approx(low, abs=1e-3)
        assert mesh["high"][: len(high)] == pytest.approx(high, abs=1e-3)


def test_a_box_comes_to_rest_on_the_ground(world: Path) -> None:
    seen = check_world(world, ("box", (-4.7, 0.3, 1.5)))  # over a hollow
    (body,) = seen["bodies"]
    x, y, z = body["rest"]
    ground = synthetic.height(x, y)
    assert body["speed"] < 0.05
    assert ground + BOX - 0.05 < z < ground + BOX + 0.1


def test_a_box_comes_to_rest_on_the_roof(world: Path) -> None:
    x, y = synthetic.HOUSE
    assert check_world(world, ("box", (x + 1.5, y + 1, 6)))["bodies"][0]["rest"] == pytest.approx(
        [x + 1.5, y + 1, 4.5 + BOX], abs=0.02
    )


def test_bodies_fall_together_and_lie_as_the_ground_does(world: Path) -> None:
    car, ball = check_world(world, ("car", (-4, -4, 1.5)), ("ball", (4, -6, 1)))["bodies"]
    assert car["speed"] < 0.05 and 0.9 < abs(car["lies"][0]) <= 1
    x, y, z = ball["rest"]
    assert z - 0.11 == pytest.approx(synthetic.height(x, y), abs=0.03)


def test_poles_are_cylinders_that_can_be_hit(tmp_path: Path) -> None:
    vertices, faces = primitives.tube([(-5, 3, 0), (-5.05, 3, 4)], [0.3, 0.3], 12)
    codes = np.full(len(faces), CODE["pole"], np.uint8)
    pole = Mesh(synthetic.UTM, vertices.astype(np.float32), faces, classification=codes)
    world = synthetic.world(tmp_path, things=pole).files["world"]
    assert not list(world.rglob("collision_pole*.obj"))
    seen = check_world(world / "street.sdf", ("box", (-5.05, 3, 5)))
    assert seen["solids"] == 3 and seen["bodies"][0]["rest"][2] > 4  # it stands on the pole's top


def test_positions_in_gazebo_are_positions_on_the_map(world: Path) -> None:
    place = check_world(world)["spherical"]
    assert [place["latitude"], place["longitude"]] == pytest.approx(present(crs.to_wgs84(synthetic.UTM))[:2], abs=1e-8)
    there = present(crs.to_wgs84(synthetic.UTM, (0, 100, 0)))
    assert place["at_y_100"] == pytest.approx(there[:2], abs=1e-6)  # a decimetre: the grid's scale is not quite 1


def test_a_tile_away_from_the_worlds_origin(tmp_path: Path) -> None:
    x, y, z = synthetic.UTM.origin
    world = synthetic.world(tmp_path, world_origin=(x - 100, y, z - 20)).files["world"] / "street.sdf"
    rest = check_world(world, ("box", (100 + synthetic.HOUSE[0] + 1.5, synthetic.HOUSE[1] + 1, 26)))["bodies"][0][
        "rest"
    ]
    assert rest[2] == pytest.approx(20 + 4.5 + BOX, abs=0.02)


def test_a_split_local_world_with_collada_visuals(tmp_path: Path) -> None:
    done = synthetic.world(tmp_path, frame=Frame(), meshes=("collada",), max_visual_triangles=1000)
    seen = check_world(done.files["world"] / "street.sdf")
    assert seen["spherical"] is None
    assert sum(mesh["triangles"] for mesh in seen["meshes"] if "/terrain" in mesh["file"]) == 3200


def _edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_a_missing_texture_is_refused(world: Path) -> None:
    (world.parent / "models/street/meshes/terrain_1.png").unlink()
    with pytest.raises(Refused, match="terrain_1"):
        check_world(world)


def test_a_missing_or_broken_mesh_is_refused(world: Path) -> None:
    meshes = world.parent / "models/street/meshes"
    whole = (meshes / "building.dae").read_text(encoding="utf-8")
    (meshes / "building.dae").write_text(whole[: len(whole) // 2], encoding="utf-8")
    with pytest.raises(Refused, match=r"building\.dae"):
        check_world(world)
    (meshes / "building.obj").unlink()
    with pytest.raises(Refused, match=r"building\.obj is missing"):
        check_world(world)


def test_a_dropped_triangle_is_refused(world: Path) -> None:
    path = world.parent / "models/street/meshes/terrain.obj"
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(lines[:-1]) + "\n", encoding="utf-8")
    with pytest.raises(Refused, match="3199 triangles where 3200 are expected"):
        check_world(world)


def test_unknown_elements_are_refused(world: Path) -> None:
    _edit(world, "<gravity>", "<gravty>1</gravty><gravity>")
    with pytest.raises(Refused, match="gravty"):
        check_world(world)


def test_a_collision_mesh_that_physics_would_ignore_is_refused(world: Path) -> None:
    path = world.parent / "models/street/meshes/collision_terrain.obj"
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("vn ")]
    path.write_text(
        "\n".join(" ".join(p.split("//")[0] for p in line.split(" ")) for line in lines) + "\n", encoding="utf-8"
    )
    with pytest.raises(Refused, match="normal count"):
        check_world(world)


def test_the_robot_is_read_without_a_warning(tmp_path: Path) -> None:
    town = driven(synthetic.scene(tmp_path))
    world_formats.write(town, ["gazebo"], tmp_path / "out", SceneParams(), silent, robot=True)
    assert check_world(tmp_path / "out" / "town.sdf")["solids"] == 6  # its own are none that bodies are dropped on
