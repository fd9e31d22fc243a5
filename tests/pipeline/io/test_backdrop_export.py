"""Export of worlds with a backdrop, which only cameras see; all other files are as without it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.io import robot_formats, world_formats
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import readme, sdf
from scan2sim.pipeline.io.worlds.scene import BACKDROP, BACKDROP_PARTS, Scene, read_scene
from scan2sim.pipeline.simulation.robot import ROBOT, Start
from tests.fakes import synthetic
from tests.fakes.scene_readers import READERS

COLOURS = ((40, 90, 30), (110, 160, 230))


@pytest.fixture
def town(tmp_path: Path) -> Scene:
    """A tile with a hedge far away, and a sky."""
    scene = synthetic.scene(tmp_path, tiles=1)
    folder = scene.tiles[0].folder / BACKDROP
    folder.mkdir()
    corners = np.array([[(60, -5, 0), (60, 5, 0), (60, 0, 6)], [(-90, 300, 50), (90, 300, 50), (0, 300, 150)]])
    uv = np.tile(np.array([(0, 0), (1, 0), (0, 1)], np.float32), (2, 1, 1))
    vertices, faces = corners.reshape(-1, 3).astype(np.float32), np.arange(6, dtype=np.int32).reshape(2, 3)
    Mesh(scene.tiles[0].frame, vertices, faces, uv=uv, page=np.arange(2, dtype=np.int16)).save(folder / "mesh.npz")
    for page, colour in enumerate(COLOURS):
        image.write(folder / f"page_{page}.png", np.full((8, 8, 3), colour, np.uint8))
    return read_scene(tmp_path / "world")


def exported(scene: Scene, name: str, folder: Path) -> Path:
    missing = plugins.missing(world_formats.PACKAGE, name)
    if missing:
        pytest.skip(f"{missing} is not installed")
    world_formats.write(scene, [name], folder, SceneParams(), silent)
    return folder


def test_gazebo_shows_the_backdrop_to_cameras_only(town: Scene, tmp_path: Path) -> None:
    out = exported(town, "gazebo", tmp_path / "out")
    model = ElementTree.parse(out / "models" / "tile0" / "model.sdf").getroot()
    flags = {visual.get("name"): visual.findtext("visibility_flags") for visual in model.iter("visual")}
    assert {name for name, value in flags.items() if value} == set(BACKDROP_PARTS)
    assert not any("backdrop" in (shape.get("name") or "") for shape in model.iter("collision"))
    files = [f"models/tile0/meshes/{name}.obj" for name in BACKDROP_PARTS]
    about = json.loads((out / "metadata.json").read_text(encoding="utf-8"))
    assert about["backdrop"] == files and BACKDROP not in about["groups"]
    for file, colour in zip(files, COLOURS, strict=True):
        material = (out / file).with_suffix(".mtl").read_text(encoding="utf-8")
        page = (out / file).parent / material.split("map_Kd ")[1].split()[0]
        assert tuple(image.read_rgb(page)[0, 0]) == colour
    robot_formats_gazebo = plugins.module(robot_formats.PACKAGE, "gazebo")
    robot_formats_gazebo.write(ROBOT, Start((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "road"), tmp_path)
    robot = ElementTree.parse(tmp_path / "models" / ROBOT.name / "model.sdf").getroot()
    (mask,) = (int(lidar.findtext("visibility_mask") or 0) for lidar in robot.iter("lidar"))
    assert mask & int(flags["backdrop"] or 0) == 0 and mask & ~sdf.BACKDROP_FLAG == mask != 0
    assert all(camera.find("visibility_mask") is None for camera in robot.iter("camera"))


def test_files_without_the_backdrop_are_unchanged(town: Scene, tmp_path: Path) -> None:
    plain = replace(town, tiles=tuple(replace(tile, folder=tile.folder) for tile in town.tiles))
    with_it = exported(town, "gazebo", tmp_path / "with")
    for path in (town.tiles[0].folder / BACKDROP).iterdir():
        path.unlink()
    (town.tiles[0].folder / BACKDROP).rmdir()
    without = exported(plain, "gazebo", tmp_path / "without")
    files = {path.relative_to(without) for path in without.rglob("*") if path.is_file()}
    more = {path.relative_to(with_it) for path in with_it.rglob("*") if path.is_file()} - files
    assert more and all("backdrop" in path.name for path in more)
    for file in files - {Path("metadata.json"), Path("README.md"), Path("models/tile0/model.sdf")}:
        assert (with_it / file).read_bytes() == (without / file).read_bytes(), file
    assert "backdrop" not in json.loads((without / "metadata.json").read_text(encoding="utf-8"))


def test_readme_says_what_a_users_own_sensors_need(town: Scene, tmp_path: Path) -> None:
    text = (exported(town, "gazebo", tmp_path / "out") / "README.md").read_text(encoding="utf-8")
    mask = int(text.split("<visibility_mask>")[1].split("<")[0])
    assert mask & sdf.BACKDROP_FLAG == 0
    (sky,) = (surface for surface in town.tiles[0].backdrop() if surface.name == "backdrop_sky")
    assert float(text.split("<far>")[1].split("<")[0]) > np.linalg.norm(sky.shape.mesh.vertices, axis=1).max()
    plain = exported(synthetic.scene(tmp_path / "plain", tiles=1), "gazebo", tmp_path / "without")
    assert "visibility_mask" not in (plain / "README.md").read_text(encoding="utf-8")


def test_readme_says_how_to_open_every_format(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    for name in set(world_formats.format_names()) - {"opendrive"}:
        readme.write(tmp_path, scene, [name])
        text = (tmp_path / "README.md").read_text(encoding="utf-8")
        assert "in this folder" in text and "{" not in text, name
    readme.write(tmp_path, scene, ["gazebo"])
    assert "NavSat" not in (tmp_path / "README.md").read_text(encoding="utf-8")
    readme.write(tmp_path, replace(scene, frame=Frame()), ["gazebo"])
    assert "NavSat sensors publish nothing" in (tmp_path / "README.md").read_text(encoding="utf-8")
    command = f"GZ_SIM_RESOURCE_PATH=$PWD/models:$GZ_SIM_RESOURCE_PATH gz sim -r {scene.name}.sdf"
    assert command in (tmp_path / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["gazebo", "glb", "usd"])
def test_backdrop_can_be_omitted_for_depth_cameras(town: Scene, tmp_path: Path, name: str) -> None:
    if missing := plugins.missing(world_formats.PACKAGE, name):
        pytest.skip(f"{missing} is not installed")
    world_formats.write(town, [name], tmp_path / "out", SceneParams(backdrop=False), silent)
    assert not list((tmp_path / "out").rglob("*backdrop*"))
    assert max(np.abs(part.corners).max() for part in READERS[name](tmp_path / "out", town)) < 55
    assert "visibility_mask" not in (tmp_path / "out" / "README.md").read_text(encoding="utf-8")
    assert town.has_backdrop


@pytest.mark.parametrize("name", ["glb", "usd"])
def test_visual_formats_contain_the_backdrop(town: Scene, tmp_path: Path, name: str) -> None:
    out = exported(town, name, tmp_path / "out")
    far = [part.image[0, 0] for part in READERS[name](out, town) if np.abs(part.corners).max() > 55]
    np.testing.assert_allclose(sorted(far, key=list), sorted(COLOURS), atol=4)


@pytest.mark.parametrize("name", ["mujoco", "urdf", "tiles3d"])
def test_physics_and_tile_formats_omit_the_backdrop(town: Scene, tmp_path: Path, name: str) -> None:
    out = exported(town, name, tmp_path / "out")
    assert not list(out.rglob("*backdrop*"))
