"""Tracking of objects with detections of low score, and through short gaps without detections."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Body, Moving
from scan2sim.services.toolboxes.tasks import movement
from tests.services.toolboxes.moving_scene import RATE, Scene, detected

pytest.importorskip("trackers")

Score = Callable[[float], float | None]
"""Function from seconds to the score of the object's detection; None: not detected."""


def tracked(scene: Scene, score: Score, seconds: float = 3.0, lost: float = 1.0) -> list[tuple[Moving, ...]]:
    """Results for the scene's first patch, image by image."""
    post_processor = movement.post_processor(movement.Params(rate=RATE, lost=lost))
    assert post_processor
    results = []
    for i in range(int(seconds * RATE)):
        image, boxes = scene.frame(i / RATE)
        current_score = score(i / RATE)
        found = () if current_score is None else (detected(boxes[0].box, current_score),)
        body = post_processor(
            Frame(str(i), "film", round(1e9 * i / RATE), image, lambda _: None), image, Body(detections=found)
        )
        results.append(tuple(one for one in body.detections or () if isinstance(one, Moving)))
    return results


@pytest.mark.parametrize("speed", [0.0, 30.0])
def test_missed_object_is_tracked_by_its_corners(speed: float) -> None:
    scene = Scene((60, 60, 80, 60, speed, 0.0))
    results = tracked(scene, lambda seconds: None if 1.5 < seconds < 2.1 else 0.9)
    assert all(len(objects) == 1 for objects in results[3:]), "exactly one object in every image"
    missed = results[45][0]
    assert not missed.detected and missed.moving is (speed > 0)
    assert missed.box == pytest.approx(scene.frame(45 / RATE)[1][0].box, abs=3)
    assert {one.track for objects in results for one in objects} == {1}
    assert results[-1][0].detected


def test_track_ends_after_a_long_gap() -> None:
    results = tracked(Scene((60, 60, 80, 60, 0.0, 0.0)), lambda seconds: 0.9 if seconds < 1 else None)
    assert results[int(1.9 * RATE)] and not results[int(2.1 * RATE)]
    results = tracked(Scene((60, 60, 80, 60, 0.0, 0.0)), lambda seconds: 0.9 if seconds < 1 else None, lost=0.0)
    assert results[int(0.9 * RATE)] and not results[int(1.1 * RATE)]


def test_low_score_continues_a_track_but_starts_none() -> None:
    scene = Scene((60, 60, 80, 60, 0.0, 0.0))
    assert not any(tracked(scene, lambda _: 0.15))
    results = tracked(scene, lambda seconds: 0.9 if seconds < 0.5 else 0.15)
    assert {one.track for objects in results for one in objects} == {1} and results[-1][0].detected
