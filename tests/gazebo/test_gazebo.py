"""Gazebo's own libraries load exported worlds, and reject broken ones."""

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
from tests.fakes import synthetic
from tests.fakes.gazebo.checker import WorldRejected, check_world
from tests.pipeline.io.test_robots import driven
from tests.present import present

BOX_HALF_EDGE_M = 0.2


@pytest.fixture
def world(tmp_path: Path) -> Path:
    return synthetic.world(tmp_path).files["world"] / "street.sdf"


def test_all_meshes_and_textures_load(world: Path) -> None:
    loaded = check_world(world)
    roles = {Path(mesh["file"]).name: mesh["role"] for mesh in loaded["meshes"]}
    assert roles == {
        "terrain.obj": "visual",
        "building.obj": "visual",
        "collision_terrain.obj": "collision",
        "collision_building.obj": "collision",
        "terrain.dae": "spare",
        "building.dae": "spare",
    }
    for mesh in loaded["meshes"]:
        group = Path(mesh["file"]).stem
        if group.startswith("collision"):
            continue
        assert mesh["textures"] == [f"street_{group}_0.png", f"street_{group}_1.png"]
        low, high = ((-10, -10), (10, 10)) if group == "terrain" else ((4, 2, -0.5), (7, 4, 4.5))
        assert mesh["low"][: len(low)] == pytest.approx(low, abs=1e-3)
        assert mesh["high"][: len(high)] == pytest.approx(high, abs=1e-3)


def test_visuals_with_reflectance_load(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    world_formats.write(scene, ["gazebo"], tmp_path / "out", SceneParams(), silent)
    model = (tmp_path / "out" / "models" / "tile0" / "model.sdf").read_text(encoding="utf-8")
    assert model.count("<laser_retro>153</laser_retro>") == 2 and model.count("<laser_retro>51</laser_retro>") == 1
    loaded = check_world(tmp_path / "out" / "town.sdf")
    visuals = {Path(mesh["file"]).name for mesh in loaded["meshes"] if mesh["role"] == "visual"}
    assert visuals == {"terrain.obj", "building.obj", "building_road_sign.obj"}


def test_a_box_comes_to_rest_on_the_ground(world: Path) -> None:
    (body,) = check_world(world, ("box", (-4.7, 0.3, 1.5)))["bodies"]  # over a depression
    x, y, z = body["rest"]
    ground = synthetic.height(x, y)
    assert body["speed"] < 0.05
    assert ground + BOX_HALF_EDGE_M - 0.05 < z < ground + BOX_HALF_EDGE_M + 0.1


def test_a_box_comes_to_rest_on_the_roof(world: Path) -> None:
    x, y = synthetic.HOUSE
    assert check_world(world, ("box", (x + 1.5, y + 1, 6)))["bodies"][0]["rest"] == pytest.approx(
        [x + 1.5, y + 1, 4.5 + BOX_HALF_EDGE_M], abs=0.02
    )


def test_bodies_dropped_together_rest_on_the_ground(world: Path) -> None:
    car, ball = check_world(world, ("car", (-4, -4, 1.5)), ("ball", (4, -6, 1)))["bodies"]
    assert car["speed"] < 0.05 and 0.9 < abs(car["lies"][0]) <= 1
    x, y, z = ball["rest"]
    assert z - 0.11 == pytest.approx(synthetic.height(x, y), abs=0.03)


def test_poles_are_solid_cylinders(tmp_path: Path) -> None:
    vertices, faces = primitives.tube([(-5, 3, 0), (-5.05, 3, 4)], [0.3, 0.3], 12)
    codes = np.full(len(faces), CODE["pole"], np.uint8)
    pole = Mesh(synthetic.UTM, vertices.astype(np.float32), faces, classification=codes)
    world = synthetic.world(tmp_path, things=pole).files["world"]
    assert not list(world.rglob("collision_pole*.obj"))
    loaded = check_world(world / "street.sdf", ("box", (-5.05, 3, 5)))
    assert loaded["solids"] == 3 and loaded["bodies"][0]["rest"][2] > 4  # the box rests on top of the pole


def test_spherical_coordinates_agree_with_the_crs(world: Path) -> None:
    spherical = check_world(world)["spherical"]
    origin = present(crs.to_wgs84(synthetic.UTM))
    assert [spherical["latitude"], spherical["longitude"]] == pytest.approx(origin[:2], abs=1e-8)
    north = present(crs.to_wgs84(synthetic.UTM, (0, 100, 0)))
    assert spherical["at_y_100"] == pytest.approx(north[:2], abs=1e-6)  # a decimetre: the UTM scale factor isn't 1


def test_a_tile_is_placed_relative_to_the_world_origin(tmp_path: Path) -> None:
    x, y, z = synthetic.UTM.origin
    world = synthetic.world(tmp_path, world_origin=(x - 100, y, z - 20)).files["world"] / "street.sdf"
    (body,) = check_world(world, ("box", (100 + synthetic.HOUSE[0] + 1.5, synthetic.HOUSE[1] + 1, 26)))["bodies"]
    assert body["rest"][2] == pytest.approx(20 + 4.5 + BOX_HALF_EDGE_M, abs=0.02)


def test_a_world_without_crs_with_split_collada_visuals_loads(tmp_path: Path) -> None:
    done = synthetic.world(tmp_path, frame=Frame(), meshes=("collada",), max_visual_triangles=1000)
    loaded = check_world(done.files["world"] / "street.sdf")
    assert loaded["spherical"] is None
    assert sum(mesh["triangles"] for mesh in loaded["meshes"] if "/terrain" in mesh["file"]) == 3200


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_a_missing_texture_is_rejected(world: Path) -> None:
    (world.parent / "models/street/meshes/street_terrain_1.png").unlink()
    with pytest.raises(WorldRejected, match="terrain_1"):
        check_world(world)


def test_a_missing_or_truncated_mesh_is_rejected(world: Path) -> None:
    meshes = world.parent / "models/street/meshes"
    text = (meshes / "building.dae").read_text(encoding="utf-8")
    (meshes / "building.dae").write_text(text[: len(text) // 2], encoding="utf-8")
    with pytest.raises(WorldRejected, match=r"building\.dae"):
        check_world(world)
    (meshes / "building.obj").unlink()
    with pytest.raises(WorldRejected, match=r"building\.obj is missing"):
        check_world(world)


def test_a_missing_triangle_is_rejected(world: Path) -> None:
    path = world.parent / "models/street/meshes/terrain.obj"
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(lines[:-1]) + "\n", encoding="utf-8")
    with pytest.raises(WorldRejected, match="3199 triangles where 3200 are expected"):
        check_world(world)


def test_unknown_sdf_elements_are_rejected(world: Path) -> None:
    _replace(world, "<gravity>", "<gravty>1</gravty><gravity>")
    with pytest.raises(WorldRejected, match="gravty"):
        check_world(world)


def test_a_collision_mesh_without_normals_is_rejected(world: Path) -> None:
    path = world.parent / "models/street/meshes/collision_terrain.obj"
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("vn ")]
    path.write_text(
        "\n".join(" ".join(p.split("//")[0] for p in line.split(" ")) for line in lines) + "\n", encoding="utf-8"
    )
    with pytest.raises(WorldRejected, match="normal count"):
        check_world(world)


def test_the_robot_loads_without_warnings(tmp_path: Path) -> None:
    town = driven(synthetic.scene(tmp_path))
    world_formats.write(town, ["gazebo"], tmp_path / "out", SceneParams(), silent, robot=True)
    assert check_world(tmp_path / "out" / "town.sdf")["solids"] == 6  # without the robot's collision shapes
