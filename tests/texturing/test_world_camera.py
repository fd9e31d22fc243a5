"""A camera in a finished world: colour of splats or surfaces, distance and class of the first surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import scan2sim
from scan2sim.pipeline.camera.renderer import look_at, pinhole
from scan2sim.pipeline.core.splats import SplatLayer, Splats
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.io.geodata import geojson
from scan2sim.pipeline.io.worlds.instances import TILE_IDS
from scan2sim.pipeline.io.worlds.scene import SPLATS_FILE, Scene, add_dome
from scan2sim.texturing.world_camera import WorldCamera
from tests.fakes import synthetic

CAMERA = pinhole(160, 120, field=80)
POSE = look_at((-4.0, -4.0, 3.0), (0.0, 0.0, 0.5))
GREEN = (0.1, 0.8, 0.2)


@pytest.fixture
def town(tmp_path: Path) -> Scene:
    return synthetic.scene(tmp_path)


def green_ground(seed: int = 1, background: float = 1.0) -> SplatLayer:
    """A layer of green splats over the ground of a tile, before a white (1) or darker background."""
    random = np.random.default_rng(seed)
    xyz = np.column_stack([random.uniform(-6, 6, (20_000, 2)), np.zeros(20_000)])
    splats = Splats.of(
        xyz, np.full((20_000, 3), 0.08), np.tile([1.0, 0, 0, 0], (20_000, 1)), np.full(20_000, 0.9),
        np.tile(GREEN, (20_000, 1)),
    )  # fmt: skip
    return SplatLayer(splats, np.full((512, 1024, 3), background, np.float32))


def test_surfaces_are_shown_with_distance_and_class(town: Scene, tmp_path: Path) -> None:
    image = scan2sim.camera(tmp_path / "world").render(POSE, CAMERA)
    hit = np.isfinite(image.range)
    assert 0.3 < hit.mean() <= 1 and set(np.unique(image.code[hit])) <= {2, 6, 64} and not image.code[~hit].any()
    assert {2, 6} <= set(np.unique(image.code))
    depth = image.depth(CAMERA)
    assert (depth[hit] <= image.range[hit] + 1e-4).all() and depth[60, 80] == pytest.approx(
        image.range[60, 80], rel=1e-3
    )


def test_splats_give_the_colour_and_surfaces_the_distance(town: Scene) -> None:
    without = scan2sim.camera(scan2sim.World(town.tiles[0].folder.parent.parent)).render(POSE, CAMERA)
    green_ground().save(town.tiles[0].folder / SPLATS_FILE)
    image = scan2sim.camera(town.tiles[0].folder.parent.parent).render(POSE, CAMERA)
    assert np.array_equal(image.code, without.code)
    hit = np.isfinite(without.range)
    assert np.array_equal(image.range[hit], without.range[hit])
    middle = image.rgb[90:, 40:120].reshape(-1, 3).mean(axis=0) / 255
    assert np.abs(middle - GREEN).max() < 0.1
    assert image.rgb[0].min() > 240, "above the horizon is the background"


@pytest.mark.parametrize(
    "camera", [Camera("equirectangular", 256, 128), Camera("fisheye", 128, 128, 45, 45, 63.5, 63.5)]
)
def test_other_cameras_see_the_same(town: Scene, camera: Camera) -> None:
    green_ground().save(town.tiles[0].folder / SPLATS_FILE)
    world = scan2sim.camera(town.tiles[0].folder.parent.parent)
    narrow, wide = world.render(POSE, CAMERA), world.render(POSE, camera)
    ahead = wide.rgb[camera.height // 2, camera.width // 2].astype(int)
    assert np.abs(ahead - narrow.rgb[60, 80]).max() < 25


@pytest.mark.parametrize("given", [[-0.1, 0.01, 0.0, 0.0], np.array([[-0.1, 0.01, 0.0, 0.0]])])
def test_distortion_may_be_a_list_or_an_array_of_opencv(town: Scene, given: Any) -> None:
    green_ground().save(town.tiles[0].folder / SPLATS_FILE)
    lens, exact = (replace(CAMERA, model="opencv", distortion=one) for one in (given, (-0.1, 0.01, 0.0, 0.0)))
    assert lens == exact and hash(lens) == hash(exact)
    assert np.array_equal(WorldCamera(town).render(POSE, lens).rgb, WorldCamera(town).render(POSE, exact).rgb)


@pytest.mark.parametrize("wrong", [POSE[:3], np.full((4, 4), np.nan), POSE[:3, 3]])
def test_what_is_no_pose_is_rejected(town: Scene, wrong: np.ndarray) -> None:
    for view in (WorldCamera(town).render, WorldCamera(town).colours):
        with pytest.raises(scan2sim.SettingError, match="T_world_cam: is no pose"):
            view(wrong, CAMERA)
    assert np.array_equal(
        WorldCamera(town).render(POSE.tolist(), CAMERA).rgb, WorldCamera(town).render(POSE, CAMERA).rgb
    )


@pytest.mark.parametrize(
    ("lens", "problem"),
    [
        (Camera("pinhole", 64, 48), "no focal length"),
        (Camera("pinhole", 64, 0, 50, 50), "64 x 0 pixels"),
        (replace(CAMERA, model=cast(Any, "pin-hole")), "unknown model 'pin-hole'"),
    ],
)
def test_a_camera_that_sees_nothing_is_rejected(town: Scene, lens: Camera, problem: str) -> None:
    for view in (WorldCamera(town).render, WorldCamera(town).colours):
        with pytest.raises(scan2sim.SettingError, match=problem):
            view(POSE, lens)


def test_views_elsewhere_continue_after_a_tile_that_cannot_be_read(town: Scene) -> None:
    green_ground().save(town.tiles[0].folder / SPLATS_FILE)
    mesh = town.tiles[1].folder / "terrain" / "mesh.npz"
    content = mesh.read_bytes()[:1000]
    mesh.unlink()  # its bytes are shared with another folder
    mesh.write_bytes(content)
    world = WorldCamera(town, farthest=5.0)
    before = world.render(view_of_tile(town, 0), CAMERA).rgb
    for _ in range(2):
        with pytest.raises(scan2sim.InputError, match="terrain: can't be read"):
            world.render(view_of_tile(town, 1), CAMERA)
        assert np.array_equal(world.render(view_of_tile(town, 0), CAMERA).rgb, before)


def test_tiles_of_a_survey_are_in_place(town: Scene) -> None:
    """The second tile's splats are 25 m from the first's, and a little lower."""
    folder = town.tiles[0].folder.parent.parent
    green_ground().save(town.tiles[1].folder / SPLATS_FILE)
    x, y, z = town.tiles[1].offset
    there = look_at((x - 4.0, y - 4.0, z + 3.0), (x, y, z + 0.5))
    shown = scan2sim.camera(folder).render(there, CAMERA).rgb[90:, 40:120].reshape(-1, 3).mean(axis=0) / 255
    assert np.abs(shown - GREEN).max() < 0.1


@pytest.mark.parametrize("tiles", [(), (0,), (0, 1)])
def test_colours_alone_are_those_of_the_image(town: Scene, tiles: tuple[int, ...]) -> None:
    for k in tiles:
        green_ground().save(town.tiles[k].folder / SPLATS_FILE)
    for k in (0, 1):
        image = WorldCamera(town).render(view_of_tile(town, k), CAMERA)
        assert np.array_equal(WorldCamera(town).colours(view_of_tile(town, k), CAMERA), image.rgb)


def view_of_tile(town: Scene, k: int) -> np.ndarray:
    """Pose of a camera beside a tile's house, looking at its ground."""
    x, y, z = town.tiles[k].offset
    return look_at((x - 4.0, y - 4.0, z + 3.0), (x, y, z + 0.5))


def test_tiles_without_splats_show_their_surfaces_beside_others(town: Scene) -> None:
    surfaces = WorldCamera(town).render(view_of_tile(town, 1), CAMERA)
    green_ground().save(town.tiles[0].folder / SPLATS_FILE)
    image = WorldCamera(town).render(view_of_tile(town, 1), CAMERA)
    near = np.isfinite(surfaces.range) & (surfaces.range < 8)
    assert near.mean() > 0.2 and np.array_equal(image.rgb[near], surfaces.rgb[near])
    sky = ~np.isfinite(image.range)
    assert sky.any() and np.abs(image.rgb[sky].astype(int) - surfaces.rgb[sky]).max() <= 1


def test_background_is_that_of_the_nearest_tile_whatever_was_seen_before(town: Scene) -> None:
    for tile, background in zip(town.tiles, (1.0, 0.2), strict=True):
        green_ground(background=background).save(tile.folder / SPLATS_FILE)
    there_and_back = WorldCamera(town)
    for k, level in ((0, 255), (1, 51), (0, 255)):
        image = there_and_back.render(view_of_tile(town, k), CAMERA)
        assert np.array_equal(image.rgb, WorldCamera(town).render(view_of_tile(town, k), CAMERA).rgb)
        assert np.abs(image.rgb[0].astype(int) - level).max() <= 2


def test_background_changes_gradually_from_tile_to_tile(town: Scene) -> None:
    for tile, background in zip(town.tiles, (1.0, 0.2), strict=True):
        green_ground(background=background).save(tile.folder / SPLATS_FILE)
    world, first, last, levels = WorldCamera(town), view_of_tile(town, 0), view_of_tile(town, 1), []
    for share in np.linspace(0, 1, 26):  # a metre each
        pose = first.copy()
        pose[:3, 3] += share * (last - first)[:3, 3]
        levels.append(float(world.render(pose, CAMERA).rgb[0].mean()))
    steps = np.diff(levels)
    assert levels[0] - levels[-1] > 200 and steps.max() <= 0 and steps.min() > -40


def test_sky_dome_of_a_survey_is_behind_surfaces_and_splats(town: Scene, tmp_path: Path) -> None:
    def sphere(scene: Scene, folder: Path) -> None:
        """A large box around the town; its walls have the colours of `synthetic.picture`."""
        house = synthetic.house(scene.frame)
        synthetic.textured(folder, replace(house, vertices=(house.vertices - (5.5, 3.0, 0.0)) * np.float32(60)))

    without = WorldCamera(town).render(view_of_tile(town, 1), CAMERA)
    domed = add_dome(town, tmp_path / "world", sphere)
    shown = WorldCamera(domed).render(view_of_tile(town, 1), CAMERA)
    sky = ~np.isfinite(without.range)
    assert np.array_equal(shown.rgb[~sky], without.rgb[~sky]) and np.array_equal(shown.range, without.range)
    assert (shown.rgb[sky] != without.rgb[sky]).any(axis=1).mean() > 0.9
    green_ground().save(town.tiles[0].folder / SPLATS_FILE)
    beside = WorldCamera(domed).render(view_of_tile(town, 1), CAMERA)
    assert np.abs(beside.rgb[0].astype(int) - shown.rgb[0]).max() <= 1


def test_tiles_beyond_the_distance_limit_are_not_drawn(town: Scene) -> None:
    x, y, z = town.tiles[1].offset
    across = look_at((0.0, -4.0, 3.0), (x, y, z))
    far = WorldCamera(town).render(across, CAMERA).range
    near = WorldCamera(town, farthest=5.0).render(across, CAMERA).range
    assert np.isfinite(far[np.isinf(near)]).any() and np.array_equal(near[np.isfinite(near)], far[np.isfinite(near)])
    lost = WorldCamera(town, farthest=5.0).render(look_at((x + 40.0, y, z + 2), (x, y, z)), CAMERA)
    assert np.isfinite(lost.range).any(), "the nearest tile is always drawn"


def test_instances_are_those_of_the_table_whatever_was_seen_before(town: Scene) -> None:
    world = WorldCamera(town)
    for k in (1, 0):
        image = world.render(view_of_tile(town, k), CAMERA)
        (house,) = np.unique(image.instance[(image.code == 6) & (image.range < 15)]).tolist()
        assert k * TILE_IDS < house <= (k + 1) * TILE_IDS
        shown = world.instances[house]
        assert (shown.kind, shown.code, shown.tile) == ("building", 6, f"tile{k}")
        offset = np.subtract(shown.position_m, town.tiles[k].offset)[:2]
        assert np.abs(offset - np.add(synthetic.HOUSE, (1.5, 1.0))).max() < 0.01
        assert not image.instance[np.isin(image.code, (0, 2))].any(), "neither sky nor ground is an instance"
        again = WorldCamera(town).render(view_of_tile(town, k), CAMERA)
        assert np.array_equal(again.instance, image.instance)


def parked_car(town: Scene, *, moved: bool = False) -> None:
    """A car that only the splats of the first tile show: green, 2 m long, 1 m wide and 1 m high, before the camera."""
    tile = town.tiles[0]
    ground_z = synthetic.height(np.array([-1.5]), np.array([-1.5]))[0]
    xyz = np.random.default_rng(3).uniform((-2.5, -2.0, 0.0), (-0.5, -1.0, 1.0), (20_000, 3)) + (0, 0, ground_z)
    splats = Splats.of(
        xyz, np.full((20_000, 3), 0.05), np.tile([1.0, 0, 0, 0], (20_000, 1)), np.full(20_000, 0.9),
        np.tile(GREEN, (20_000, 1)),
    )  # fmt: skip
    SplatLayer(splats, np.ones((512, 1024, 3), np.float32)).save(tile.folder / SPLATS_FILE)
    corners = tile.frame.to_crs(
        [(-2.5, -2, ground_z), (-0.5, -2, ground_z), (-0.5, -1, ground_z), (-2.5, -1, ground_z)]
    )
    ring = np.concatenate([corners, corners[:1]])
    properties = {"kind": "car", "height_m": 1.0, "ground_z": float(corners[0, 2]), "moved": moved}
    geojson.write_polygons(tile.folder / "instances.geojson", tile.frame.crs, [(ring[:, :2].tolist(), properties)])


def test_vehicles_that_only_splats_show_have_distance_class_and_instance(town: Scene) -> None:
    surfaces = WorldCamera(town).render(POSE, CAMERA)
    parked_car(town)
    world = WorldCamera(town)
    image = world.render(POSE, CAMERA)
    (car,) = (one for one in world.instances.values() if one.kind == "car")
    own = image.instance == car.id
    assert own.mean() > 0.01 and (image.code[own] == 66).all() and car.code == 66
    assert (image.range[own] < surfaces.range[own]).all(), "a robot behind it is hidden"
    assert np.abs(image.rgb[own].mean(axis=0) / 255 - GREEN).max() < 0.1
    assert np.array_equal(image.code[~own], surfaces.code[~own])
    hit = np.isfinite(surfaces.range) & ~own
    assert np.array_equal(image.range[hit], surfaces.range[hit])
    assert np.abs(np.subtract(car.position_m[:2], (-1.5, -1.5))).max() < 0.01


def test_vehicles_that_moved_are_no_instances(town: Scene) -> None:
    parked_car(town, moved=True)
    world = WorldCamera(town)
    image = world.render(POSE, CAMERA)
    assert "car" not in {one.kind for one in world.instances.values()} and not (image.code == 66).any()
