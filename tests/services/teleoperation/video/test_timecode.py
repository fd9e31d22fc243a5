from __future__ import annotations

import itertools

import numpy as np
import pytest

from scan2sim.services.teleoperation.cameras import Picture
from scan2sim.services.teleoperation.video import timecode
from scan2sim.services.teleoperation.video.rate_control import Plan
from tests.services.teleoperation.video.videos import Drive, scenery

START = 987_654_321_000_000


@pytest.mark.parametrize("plan", [Plan(1_500_000), Plan(200_000), Plan(150_000, 15.0, 0.5)], ids=str)
def test_marks_are_read_from_what_was_decoded_however_few_the_bits(plan: Plan) -> None:
    drive = Drive(plan=plan)
    rng = np.random.default_rng(0)

    def marked(picture: Picture) -> Picture:
        noisy = np.clip(picture.image + rng.normal(0, 6, picture.image.shape), 0, 255).astype(np.uint8)
        timecode.mark(noisy, START + picture.captured)
        return Picture(noisy, picture.captured)

    drive.send(map(marked, itertools.islice(scenery(640, 480), 90)))
    read = [(timecode.read(image, START + 10**9, 640), frame.captured) for frame, image in drive.decoded()]
    assert len(read) == pytest.approx(90 * plan.fps / 30, abs=1)
    right = [time is not None and abs(time - START - captured) <= timecode.STEP for time, captured in read]
    assert np.mean(right) > 0.9 and all(good or time is None for good, (time, _) in zip(right, read, strict=True))


def test_a_time_is_read_as_the_one_that_is_near() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    for time in (
        0,
        5 * timecode.STEP,
        timecode.SPAN * timecode.STEP - timecode.STEP,
        START // timecode.STEP * timecode.STEP,
    ):
        timecode.mark(image, time)
        for near in (time, time + 3 * 10**9, time + 600 * 10**9, max(0, time - 10**9)):
            assert timecode.read(image, near, 640) == time


def test_what_is_no_mark_is_not_read() -> None:
    rng = np.random.default_rng(0)
    for image in (
        np.zeros((480, 640, 3), np.uint8),
        np.full((480, 640, 3), 128, np.uint8),
        np.full((20, 20, 3), 255, np.uint8),
        rng.integers(0, 255, (480, 640, 3), np.uint8),
        next(scenery(640, 480)).image,
    ):
        assert timecode.read(image, START, 640) is None
    image = np.zeros((480, 640, 3), np.uint8)
    timecode.mark(image, START)
    image[: timecode.SQUARE, : timecode.SQUARE] = timecode.LIGHT if image[0, 0, 0] == timecode.DARK else timecode.DARK
    assert timecode.read(image, START, 640) is None
