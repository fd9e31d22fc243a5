"""Renderings of moving objects in a static scene: occlusion, camera shake and shadows."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.data_samples.crossing import look_at_pose
from scan2sim.data_samples.paints import ROAD, VEHICLE, Material, Paint
from scan2sim.data_samples.shapes import box, join
from scan2sim.data_samples.stage import Actor, Backdrop, Body, Light, Piece, Stage, centred_shake, with_margin
from scan2sim.pipeline.core.types import Camera

SIZE = (160, 120)
CAMERA = Camera("pinhole", *SIZE, 200.0, 200.0, 79.5, 59.5)
CUBE = Body(box((-1, -1, 0), (1, 1, 2), Paint(Material.PLAIN, (0.8, 0.1, 0.1), VEHICLE), bottom=True))


def stage(wall: bool) -> tuple[Stage, Backdrop]:
    ground = box((-50, -50, -1), (80, 50, 0), Paint(Material.PLAIN, (0.3, 0.3, 0.3), ROAD))
    parts = [ground, *([box((9, 0, 0), (9.2, 20, 6), Paint(Material.PLAIN, (0.6, 0.6, 0.6), ROAD))] if wall else [])]
    renderer = Stage(join(parts), Light(np.array([0.0, -0.6, 0.8]), 0.9, 0.4, 0.3))
    pose = look_at_pose(np.array([0.0, 0.0, 2.0]), np.array([20.0, 0.0, 1.0]))
    return renderer, renderer.backdrop(with_margin(CAMERA, 10), pose, 1)


def actor(x: float, y: float, track: int) -> Actor:
    return Actor("car", track, (Piece(CUBE, np.array([x, y, 0.0]), 0.0),))


def test_a_wall_occludes_its_share_of_an_object() -> None:
    renderer, backdrop = stage(wall=True)
    (occluded,) = renderer.frame(backdrop, [actor(20, 0, 1)], SIZE).visible
    assert occluded.visible == pytest.approx(0.5, abs=0.04)
    (unoccluded,) = renderer.frame(stage(wall=False)[1], [actor(20, 0, 1)], SIZE).visible
    assert unoccluded.visible == 1 and unoccluded.box == occluded.box


def test_a_near_object_occludes_a_far_one_in_any_order() -> None:
    renderer, backdrop = stage(wall=False)
    near, far = actor(12, 0, 1), actor(25, 0.5, 2)
    for order in ([near, far], [far, near]):
        frame = renderer.frame(backdrop, order, SIZE)
        by_track = {s.actor.track: s for s in frame.visible}
        assert by_track[1].visible == 1 and by_track[2].visible < 0.3
        assert frame.owner[60, 79] == order.index(near)


def test_camera_shake_moves_the_image_and_the_boxes() -> None:
    renderer, backdrop = stage(wall=False)
    still = renderer.frame(backdrop, [actor(20, 0, 1)], SIZE)
    moved = renderer.frame(backdrop, [actor(20, 0, 1)], SIZE, centred_shake(backdrop, SIZE, 0.0, (3.0, -2.0)))
    np.testing.assert_array_equal(np.array(moved.visible[0].box) - still.visible[0].box, [-3, 2, -3, 2])
    a, b = still.rgb[20:100, 20:140].astype(int), moved.rgb[22:102, 17:137].astype(int)
    assert np.abs(a - b).mean() < 1


def test_an_object_casts_its_shadow_away_from_the_sun() -> None:
    renderer, backdrop = stage(wall=False)
    empty, full = (renderer.frame(backdrop, actors, SIZE).rgb.astype(int) for actors in ([], [actor(20, 0, 1)]))
    darker = (empty - full).max(axis=2) > 25
    left, right = darker[66:72, 40:66].sum(), darker[66:72, 94:120].sum()
    assert left > 20 > right, "the sun is to the right: y < 0"
