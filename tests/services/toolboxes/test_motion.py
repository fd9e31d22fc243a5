"""Motion detection: moving and stationary objects, camera shake, occlusions."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.services.toolboxes.motion import MotionDetector
from tests.services.toolboxes.moving_scene import RATE, SIZE, Scene, detected


def moving_states(scene: Scene, seconds: float = 1.6) -> list[list[bool | None]]:
    """`moving` over time for each patch."""
    detector, states = MotionDetector(), list[dict[int, bool | None]]()
    for i in range(int(seconds * RATE)):
        image, found = scene.frame(i / RATE)
        states.append({track: motion.moving for track, motion in detector.update(image, i / RATE, found).items()})
    return [[one[track] for one in states] for track in sorted(states[0])]


@pytest.mark.parametrize("shake", [0.0, 1.5])
def test_moving_and_stationary_objects_are_distinguished(shake: float) -> None:
    scene = Scene((40, 60, 80, 60, 40.0, 0.0), (250, 120, 80, 60, 0.0, 0.0), shake=shake)
    moving, stationary = moving_states(scene)
    assert all(moving[15:]) and not any(stationary[15:])
    assert moving[0] is None and stationary[0] is None


def test_approaching_object_moves() -> None:
    (growing,) = moving_states(Scene((150, 80, 80, 60, 0.0, 0.3)))
    assert all(growing[15:])


def test_stationary_object_behind_a_passing_one_does_not_move() -> None:
    stationary, passing = moving_states(Scene((150, 60, 90, 60, 0.0, 0.0), (100, 100, 60, 50, 60.0, 0.0)))
    assert not any(stationary[15:]) and all(passing[15:])


def test_stopped_object_is_stationary_a_second_later() -> None:
    detector = MotionDetector()
    scene, stopped = Scene((40, 60, 80, 60, 60.0, 0.0)), 1.0
    states = {}
    for i in range(int(3 * RATE)):
        image, found = scene.frame(min(i / RATE, stopped))
        states[i / RATE] = detector.update(image, i / RATE, found)[0].moving
    assert states[0.96] and not states[2.08]


def test_speed_is_in_pixels_of_the_original_image() -> None:
    import cv2

    scene, detector, speed = Scene((40, 60, 80, 60, 40.0, 0.0)), MotionDetector(), 0.0
    for i in range(30):
        image, found = scene.frame(i / RATE)
        large = cv2.resize(image, None, fx=4, fy=4)
        left, top, right, bottom = (4 * v for v in found[0].box)
        speed = detector.update(large, i / RATE, {0: detected((left, top, right, bottom))})[0].speed or 0.0
    assert speed == pytest.approx(160, rel=0.1)


def test_long_gap_resets_the_state() -> None:
    scene, detector = Scene((40, 60, 80, 60, 40.0, 0.0)), MotionDetector()
    for seconds in (0.0, 0.04, 0.08, 5.0):
        image, found = scene.frame(seconds)
        motion = detector.update(image, seconds, found)[0]
    assert motion.moving is None


def test_image_without_texture_gives_unknown_motion() -> None:
    detector = MotionDetector()
    for i in range(5):
        assert (
            detector.update(np.zeros((*SIZE, 3), np.uint8), i / RATE, {1: detected((10, 10, 50, 50))})[1].moving is None
        )
    assert detector.update(np.zeros((8, 8, 3), np.uint8), 1.0, {}) == {}
