"""Views of the world: rolling shutter, exposure, and a simulator's images in front by depth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Camera
from scan2sim.pipeline.io.worlds.instances import Instance
from scan2sim.services.world_camera.pose_source import pose_of
from scan2sim.services.world_camera.views import MAX_BANDS, View, composed, exposed, rendered

CAMERA = pinhole(40, 30, field=80)
GREY, RED = (90, 90, 90), (200, 10, 10)
VEHICLE, ROAD = 1, 11
HOUSE_ID = 70_000


@dataclass
class Image:
    rgb: U8
    code: U8
    instance: I32
    distance: F32

    def depth(self, camera: Camera) -> F32:
        return self.distance


@dataclass
class World:
    """A world whose brightness is its camera's position x, and whose depth is the row in the whole image."""

    asked: list[tuple[float, int]] = field(default_factory=list)
    instances: dict[int, Instance] = field(default_factory=dict)

    def render(self, T_world_cam: F64, camera: Camera) -> Image:
        x = float(T_world_cam[0, 3])
        self.asked.append((x, camera.height))
        shape = camera.height, camera.width
        rows = np.arange(camera.height) - camera.cy + CAMERA.cy
        depth = np.repeat(rows[:, None], camera.width, axis=1).astype(np.float32)
        ids = np.full(shape, HOUSE_ID, np.int32)
        return Image(np.full((*shape, 3), round(10 * x), np.uint8), np.full(shape, ROAD, np.uint8), ids, depth)


def along(*xs: float) -> F64:
    return np.stack([pose_of((x, 0, 0, 0, 0, 0)) for x in xs])


def test_one_pose_is_one_view_of_the_whole_image() -> None:
    world = World()
    view = rendered(world, CAMERA, along(15.0))
    assert world.asked == [(15.0, 30)] and (view.rgb == 150).all() and (view.code == ROAD).all()
    assert view.instance.shape == (30, 40) and (view.instance == HOUSE_ID).all()


def test_rows_of_a_rolling_shutter_are_seen_one_after_the_other() -> None:
    world = World()
    view = rendered(world, CAMERA, along(0, 10, 20))
    assert np.array_equal(view.depth[:, 0], np.arange(30)), "each row is where it is in the image"
    shade = view.rgb[:, 0, 0].astype(int)
    assert (np.diff(shade) >= 0).all() and len(world.asked) == MAX_BANDS
    assert np.abs(shade - 200 * np.arange(30) / 29).max() <= 200 / MAX_BANDS
    world = World()
    rendered(world, CAMERA, np.stack([np.eye(4)] * 9))
    assert len(world.asked) == 1, "a camera that doesn't move needs one view"
    rendered(world := World(), CAMERA, np.stack([pose_of((0, 0, 0, 0, 0, yaw)) for yaw in (0, 5)]))
    assert len(world.asked) == math.ceil(CAMERA.fx * math.radians(5))


def test_depth_beside_and_behind_a_wide_lens_is_unknown() -> None:
    view = rendered(World(), replace(CAMERA, cy=CAMERA.cy + 2), along(0.0))
    assert np.array_equal(view.depth[:, 0], [math.nan, math.nan, *range(28)], equal_nan=True)


def grey(depth: F32) -> View:
    ids = np.full(depth.shape, HOUSE_ID, np.int32)
    return View(np.full((*depth.shape, 3), GREY, np.uint8), depth, np.full(depth.shape, ROAD, np.uint8), ids)


def red(depth: F32) -> U8:
    return np.full((*depth.shape, 3), RED, np.uint8)


def test_what_is_nearer_in_the_simulator_is_in_front() -> None:
    world = np.full((6, 8), 10, np.float32)
    own = np.full((6, 8), np.inf, np.float32)
    own[2:4, 1:3], own[2:4, 5:7] = 4, 30  # a robot in front, one behind a wall
    view = composed(grey(world), red(own), own, 0.1)
    front = own == 4
    assert (view.rgb[front] == RED).all() and (view.rgb[~front] == GREY).all()
    assert (view.depth[front] == 4).all() and (view.depth[~front] == 10).all()
    assert (view.code[front] == VEHICLE).all() and (view.code[~front] == ROAD).all()
    assert (view.instance[front] == 0).all() and (view.instance[~front] == HOUSE_ID).all()
    assert view.instance.dtype == np.int32
    assert view.rgb.dtype == np.uint8 and view.depth.dtype == np.float32 and view.code.dtype == np.uint8


def test_the_simulators_own_picture_of_the_world_is_not_shown() -> None:
    world = np.full((6, 8), 10, np.float32)
    world[:, 4:] = 3  # an edge of a wall, which the simulator draws a pixel farther left
    own = world - 0.05
    own[:, 3] = 2.95
    view = composed(grey(world), red(own), own, 0.1)
    assert (view.rgb == GREY).all() and np.array_equal(view.depth, world)


@pytest.mark.parametrize("nothing", [np.nan, np.inf, 0.0])
def test_pixels_without_depth_are_the_worlds(nothing: float) -> None:
    own = np.full((6, 8), nothing, np.float32)
    view = composed(grey(np.full((6, 8), np.inf, np.float32)), red(own), own, 0.1)
    assert (view.rgb == GREY).all() and np.isinf(view.depth).all()


def test_robots_are_seen_before_the_sky_and_closer_than_the_sensor_measures() -> None:
    world = np.array([[np.inf, np.inf], [np.nan, np.nan]], np.float32)
    for near in (50.0, -np.inf):
        own = np.full((2, 2), near, np.float32)
        assert (composed(grey(world), red(own), own, 0.1).rgb == RED).all()


def test_exposure_changes_the_light_by_stops() -> None:
    ramp = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    assert exposed(ramp, 0.0) is ramp
    brighter, darker = exposed(ramp, 1.0), exposed(ramp, -1.0)
    light = ((119 / 255 + 0.055) / 1.055) ** 2.4
    assert brighter[7, 7, 0] == pytest.approx(255 * ((2 * light) ** (1 / 2.4) * 1.055 - 0.055), abs=1)
    assert (brighter >= ramp).all() and (darker <= ramp).all() and brighter.max() == 255
    assert np.abs(exposed(darker, 1.0).astype(int) - ramp)[5:].max() <= 3
    assert not exposed(ramp, -10.0)[:4].any() and (exposed(ramp, 10.0)[8:] == 255).all()
