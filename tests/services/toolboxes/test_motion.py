"""What moves is told from what stands, under a camera that shakes, and with things before one another."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.services.toolboxes.motion import Flow
from tests.services.toolboxes.moving_scene import RATE, SIZE, Scene, detected


def said(scene: Scene, seconds: float = 1.6) -> list[list[bool | None]]:
    """By patch, what was said of it over time."""
    flow, told = Flow(), list[dict[int, bool | None]]()
    for i in range(int(seconds * RATE)):
        image, found = scene.frame(i / RATE)
        told.append({track: motion.moving for track, motion in flow.update(image, i / RATE, found).items()})
    return [[one[track] for one in told] for track in sorted(told[0])]


@pytest.mark.parametrize("shake", [0.0, 1.5])
def test_what_moves_moves_and_what_stands_stands(shake: float) -> None:
    moving, standing = said(Scene((40, 60, 80, 60, 40.0, 0.0), (250, 120, 80, 60, 0.0, 0.0), shake=shake))
    assert all(moving[15:]) and not any(standing[15:])
    assert moving[0] is None and standing[0] is None


def test_what_comes_towards_the_camera_moves() -> None:
    (growing,) = said(Scene((150, 80, 80, 60, 0.0, 0.3)))
    assert all(growing[15:])


def test_what_stands_behind_something_that_drives_past_stands() -> None:
    standing, passing = said(Scene((150, 60, 90, 60, 0.0, 0.0), (100, 100, 60, 50, 60.0, 0.0)))
    assert not any(standing[15:]) and all(passing[15:])


def test_what_stops_stands_a_second_later() -> None:
    flow = Flow()
    scene, stopped = Scene((40, 60, 80, 60, 60.0, 0.0)), 1.0
    told = {}
    for i in range(int(3 * RATE)):
        image, found = scene.frame(min(i / RATE, stopped))
        told[i / RATE] = flow.update(image, i / RATE, found)[0].moving
    assert told[0.96] and not told[2.08]


def test_speed_is_in_pixels_of_the_image_a_second() -> None:
    import cv2

    scene, flow, speed = Scene((40, 60, 80, 60, 40.0, 0.0)), Flow(), 0.0
    for i in range(30):
        image, found = scene.frame(i / RATE)
        large = cv2.resize(image, None, fx=4, fy=4)
        left, top, right, bottom = (4 * v for v in found[0].box)
        speed = flow.update(large, i / RATE, {0: detected((left, top, right, bottom))})[0].speed or 0.0
    assert speed == pytest.approx(160, rel=0.1)


def test_after_a_gap_all_begins_anew() -> None:
    scene, flow = Scene((40, 60, 80, 60, 40.0, 0.0)), Flow()
    for seconds in (0.0, 0.04, 0.08, 5.0):
        image, found = scene.frame(seconds)
        motion = flow.update(image, seconds, found)[0]
    assert motion.moving is None


def test_an_image_without_anything_is_no_trouble() -> None:
    flow = Flow()
    for i in range(5):
        assert flow.update(np.zeros((*SIZE, 3), np.uint8), i / RATE, {1: detected((10, 10, 50, 50))})[1].moving is None
    assert flow.update(np.zeros((8, 8, 3), np.uint8), 1.0, {}) == {}
