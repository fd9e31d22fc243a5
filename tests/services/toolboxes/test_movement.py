"""Things that are followed: by faint detections, and without any, for a moment."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Body, Moving
from scan2sim.services.toolboxes.tasks import movement
from tests.services.toolboxes.moving_scene import RATE, Scene, detected

pytest.importorskip("trackers")

Score = Callable[[float], float | None]
"""Of the thing's detection after some seconds; None: it isn't detected."""


def followed(scene: Scene, score: Score, seconds: float = 3.0, lost: float = 1.0) -> list[tuple[Moving, ...]]:
    """What is said of the scene's first patch, image by image."""
    follow = movement.follow(movement.Params(rate=RATE, lost=lost))
    assert follow
    told = []
    for i in range(int(seconds * RATE)):
        image, boxes = scene.frame(i / RATE)
        how_sure = score(i / RATE)
        found = () if how_sure is None else (detected(boxes[0].box, how_sure),)
        body = follow(
            Frame(str(i), "film", round(1e9 * i / RATE), image, lambda _: None), image, Body(detections=found)
        )
        told.append(tuple(one for one in body.detections or () if isinstance(one, Moving)))
    return told


@pytest.mark.parametrize("speed", [0.0, 30.0])
def test_what_the_detector_misses_for_a_moment_is_where_it_went(speed: float) -> None:
    scene = Scene((60, 60, 80, 60, speed, 0.0))
    told = followed(scene, lambda seconds: None if 1.5 < seconds < 2.1 else 0.9)
    assert all(len(things) == 1 for things in told[3:]), "once each, all the time"
    missed = told[45][0]
    assert not missed.detected and missed.moving is (speed > 0)
    assert missed.box == pytest.approx(scene.frame(45 / RATE)[1][0].box, abs=3)
    assert {thing.track for things in told for thing in things} == {1}
    assert told[-1][0].detected


def test_what_stays_away_is_forgotten() -> None:
    told = followed(Scene((60, 60, 80, 60, 0.0, 0.0)), lambda seconds: 0.9 if seconds < 1 else None)
    assert told[int(1.9 * RATE)] and not told[int(2.1 * RATE)]
    told = followed(Scene((60, 60, 80, 60, 0.0, 0.0)), lambda seconds: 0.9 if seconds < 1 else None, lost=0.0)
    assert told[int(0.9 * RATE)] and not told[int(1.1 * RATE)]


def test_a_faint_detection_continues_a_track_and_begins_none() -> None:
    scene = Scene((60, 60, 80, 60, 0.0, 0.0))
    assert not any(followed(scene, lambda _: 0.15))
    told = followed(scene, lambda seconds: 0.9 if seconds < 0.5 else 0.15)
    assert {thing.track for things in told for thing in things} == {1} and told[-1][0].detected
