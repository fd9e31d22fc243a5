"""The sky of a survey's world: one dome of all tiles, for cameras only, rebuilt when a tile's sky changes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from scan2sim.flows.reports.view import Pages
from scan2sim.pipeline.camera.renderer import Image, Renderer, look_at, pinhole, textured
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Mesh, Trajectory
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.merge import TileWorld, assemble
from scan2sim.pipeline.io.worlds.scene import (
    BACKDROP,
    DOME_FOLDER,
    PATH_FILE,
    SCENE_FOLDER,
    Scene,
    add_dome,
    read_scene,
)
from scan2sim.pipeline.simulation.robot import ROBOT
from scan2sim.texturing.backdrop import dome
from scan2sim.texturing.backdrop.dome import HEIGHT_PX, SCENERY, SKY, WIDTH_PX, Dome, Mean
from tests.fakes import synthetic
from tests.fakes.scene_readers import READERS

BLUE, EAST_M = (110, 160, 230), 25.0
RISING = np.linspace(0.8, 1.1, HEIGHT_PX)[:, None, None]
"""Brightness of the sky over the ground, from the zenith."""


def sky_of(columns: slice, exposure: float = 1.0) -> Dome:
    """A blue sky that a tile saw at some azimuths, up to an elevation of 60 degrees; houses hide its lowest part."""
    colour = np.clip(exposure * RISING * np.tile(np.array(BLUE, float), (HEIGHT_PX, WIDTH_PX, 1)), 0, 255)
    shows = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    shows[150:350, columns], shows[350:, columns] = SKY, SCENERY
    colour[350:] = 90
    return Dome(colour.astype(np.uint8), shows)


def saved(folder: Path, domes: Sequence[Dome]) -> Mean:
    for i, one in enumerate(domes):
        (folder / str(i)).mkdir()
        one.save(folder / str(i))
    return Mean([folder / str(i) for i in range(len(domes))])


def test_tiles_of_different_exposures_give_a_dome_without_seams(tmp_path: Path) -> None:
    east, west, all_round = slice(900, 2048), slice(0, 1100), slice(0, 2048)
    mean = saved(tmp_path, [sky_of(east, 1.0), sky_of(west, 0.85), sky_of(all_round, 1.1)])
    ratio = mean.gains() ** (1 / dome.GAMMA) * np.array([[1.0], [0.85], [1.1]])
    assert ratio == pytest.approx(np.full((3, 3), ratio.mean()), rel=0.02)
    found = mean.texture()[200:345].astype(float)
    assert np.abs(np.diff(np.concatenate([found, found[:, :1]], axis=1), axis=1)).max() <= 2
    expected = (0.85 * 1.1) ** (1 / 3) * (RISING * np.array(BLUE))[200:345]
    assert np.abs(found - expected).max() < 6


def test_directions_that_no_tile_saw_continue_the_sky(tmp_path: Path) -> None:
    found = saved(tmp_path, [sky_of(slice(300, 600)), sky_of(slice(500, 900))]).texture()
    assert np.abs(found[:300].astype(float) - BLUE).max() < 60
    assert np.abs(found[410:].astype(float) - 90).max() < 6


def test_sky_of_only_one_of_many_tiles_is_rejected(tmp_path: Path) -> None:
    """Houses are not part of the dome either, as they depend on the viewpoint."""
    houses, wall = (sky_of(slice(0, WIDTH_PX)) for _ in range(2))
    houses.shows[300:350, 1000:1200], houses.colour[300:350, 1000:1200] = SCENERY, 40
    wall.colour[300:350, 1000:1200] = 250
    found = saved(tmp_path, [houses] * 11 + [wall]).texture()[310:340, 1050:1150]
    assert np.abs(found.astype(float) - (RISING * np.array(BLUE))[310:340]).max() < 15


def survey(folder: Path, number: int = 3, with_sky: bool = True) -> list[TileWorld]:
    """Tiles in a row, each with its sky."""
    x, y, z = synthetic.UTM.origin
    tiles = []
    for i in range(number):
        frame = replace(synthetic.UTM, origin=(x + EAST_M * i, y, z))
        world = synthetic.world(folder / f"tile{i}", frame=frame, name=f"tile{i}").files["world"]
        if with_sky:
            place = world / SCENE_FOLDER / f"tile{i}" / BACKDROP
            place.mkdir()
            sky_of(slice(0, WIDTH_PX)).save(place)
            Mesh(frame, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)).save(place / "mesh.npz")
        tiles.append(TileWorld(f"tile{i}", world, frame))
    return tiles


def town(folder: Path) -> Scene:
    assemble(folder, "town", survey(folder), dome=dome.of_survey)
    return read_scene(folder)


def seen(scene: Scene, eye: tuple[float, float, float], target: tuple[float, float, float]) -> Image:
    """A camera's image in the world, of the surfaces of all tiles and the sky."""
    bodies = []
    for tile in scene.with_dome:
        for folder in [tile.folder / group for group in tile.groups] + [tile.folder / BACKDROP]:
            body = textured(folder) if (folder / "mesh.npz").is_file() else None
            if body is not None and len(body.mesh):
                vertices = (body.mesh.vertices + np.asarray(tile.offset)).astype(np.float32)
                bodies.append(replace(body, mesh=replace(body.mesh, vertices=vertices)))
    return Renderer(bodies).view(pinhole(320, 180, field=80), look_at(eye, target))


def test_cameras_see_the_same_sky_everywhere_along_the_survey(tmp_path: Path) -> None:
    scene = town(tmp_path)
    before, after = (seen(scene, (x, -8.0, 2.0), (x, 10.0, 12.0)) for x in (12.4, 12.6))  # the border is at 12.5
    up = slice(0, 60)
    assert np.abs(before.rgb[up].astype(float) - after.rgb[up]).max() <= 3
    for x in (-35.0, 0.0, 35.0):
        sky = seen(scene, (x, -8.0, 2.0), (x, 10.0, 12.0))
        assert sky.hit.all() and np.abs(sky.rgb[up].astype(float) - before.rgb[up]).mean() < 4
        assert (sky.range[up] > 300).all()


@pytest.mark.parametrize("name", ["gazebo", "glb", "usd"])
def test_exports_contain_the_dome(tmp_path: Path, name: str) -> None:
    missing = plugins.missing(world_formats.PACKAGE, name)
    if missing:
        pytest.skip(f"{missing} is not installed")
    scene = town(tmp_path)
    out = tmp_path / "world" if name == "gazebo" else tmp_path / "out"
    if name != "gazebo":
        world_formats.write(scene, [name], out, SceneParams(), silent)
    (far,) = [part for part in READERS[name](out, scene) if np.abs(part.corners).max() > 300]
    assert np.abs(far.corners).max() < (scene.far or 0)
    assert np.abs(far.image[250, ::100].astype(float) - BLUE).max() < 40


@pytest.mark.parametrize("name", ["mujoco", "urdf", "tiles3d"])
def test_physics_and_tile_formats_omit_the_dome(tmp_path: Path, name: str) -> None:
    scene = town(tmp_path)
    world_formats.write(scene, [name], tmp_path / "out", SceneParams(), silent)
    assert not list((tmp_path / "out").rglob("*backdrop*")) and not list((tmp_path / "out").rglob("town_sky*"))


def test_gazebo_shows_the_dome_to_cameras_only_and_outside_of_levels(tmp_path: Path) -> None:
    town(tmp_path)
    world = ElementTree.parse(tmp_path / "world" / "town.sdf").getroot()
    assert "model://town_sky" in {include.findtext("uri") for include in world.iter("include")}
    assert {level.findtext("ref") for level in world.iter("level")} == {"tile0", "tile1", "tile2"}
    model = ElementTree.parse(tmp_path / "world" / "models" / "town_sky" / "model.sdf").getroot()
    (visual,) = model.iter("visual")
    assert visual.findtext("visibility_flags") == str(sdf.BACKDROP_FLAG) and not list(model.iter("collision"))
    about = json.loads((tmp_path / "world" / "metadata.json").read_text(encoding="utf-8"))
    assert (
        400 < about["camera_far_m"] < 2000 and "models/town_sky/meshes/backdrop_sky.obj" in about["triangles_by_file"]
    )


def test_viewer_loads_the_dome(tmp_path: Path) -> None:
    pages = Pages(town(tmp_path), tmp_path / "page", 4.0)
    assert "town_sky.js" in pages.scripts and "town_sky_collision.js" not in pages.scripts
    pages.write("town_sky.js")
    assert (tmp_path / "page" / "tiles" / "town_sky.js").stat().st_size > 1000


def test_survey_without_backdrop_has_no_dome(tmp_path: Path) -> None:
    assemble(tmp_path, "town", survey(tmp_path, with_sky=False), dome=dome.of_survey)
    assert read_scene(tmp_path).dome is None and not list((tmp_path / "world").rglob("*sky*"))
    assert "camera_far_m" not in json.loads((tmp_path / "world" / "metadata.json").read_text(encoding="utf-8"))


def test_dome_is_rebuilt_only_when_the_sky_of_a_tile_changes(tmp_path: Path) -> None:
    tiles, made = survey(tmp_path, 2), list[int]()

    def make(scene: Scene, folder: Path) -> None:
        made.append(len(scene.tiles))
        dome.of_survey(scene, folder)

    texture = tmp_path / "world" / SCENE_FOLDER / DOME_FOLDER / BACKDROP / "page_1.png"
    mesh = tmp_path / "world" / "models" / "tile1" / "meshes" / "tile1_terrain_0.png"
    pictures, grounds = [], []
    for exposure in (None, 0.7):
        if exposure is not None:
            sky = tiles[0].world / SCENE_FOLDER / "tile0" / BACKDROP
            (sky / dome.DOME_FILE).unlink()
            sky_of(slice(0, WIDTH_PX), exposure).save(sky)
        for _ in range(2):
            assemble(tmp_path, "town", tiles, dome=make)
        pictures.append(texture.read_bytes())
        grounds.append(mesh.stat().st_ino)
    assert made == [2, 2] and pictures[0] != pictures[1]
    assert grounds[0] == grounds[1]  # the tiles' own files are the same
    page = tmp_path / "world" / "models" / "town_sky" / "meshes" / "town_sky_backdrop_sky_1.png"
    whole = page.read_bytes()
    page.write_bytes(b"damaged")
    assemble(tmp_path, "town", tiles, dome=make)
    assert page.read_bytes() == whole


def test_camera_of_the_robot_sees_as_far_as_the_sky_of_a_long_survey(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, apart=600.0)
    for tile in scene.tiles:
        (tile.folder / BACKDROP).mkdir()
        sky_of(slice(0, WIDTH_PX)).save(tile.folder / BACKDROP)
        Mesh(tile.frame, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)).save(
            tile.folder / BACKDROP / "mesh.npz"
        )
    x, y = np.linspace(-6.0, 8.0, 33), np.full(33, -2.0)
    driven = np.column_stack([x, y, synthetic.height(x, y) + 2])
    Trajectory(np.arange(33.0), driven).save(scene.tiles[0].folder / PATH_FILE)
    whole = add_dome(scene, tmp_path / "world", dome.of_survey)
    world_formats.write(whole, ["gazebo"], tmp_path / "out", SceneParams(), silent, robot=True)
    robot = ElementTree.parse(tmp_path / "out" / "models" / ROBOT.name / "model.sdf").getroot()
    far = {float(clip.text or 0) for clip in robot.iter("far")}
    about = json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))
    assert far == {about["camera_far_m"]} and 3500 < about["camera_far_m"] < 4500
