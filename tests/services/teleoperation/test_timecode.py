from __future__ import annotations

import itertools

import numpy as np
import pytest

from scan2sim.services.teleoperation import timecode
from scan2sim.services.teleoperation.cameras import CameraFrame
from scan2sim.services.teleoperation.video.rate_control import EncodingPlan
from tests.services.teleoperation.video.videos import Drive, scenery

START = 987_654_321_000_000


@pytest.mark.parametrize(
    "plan", [EncodingPlan(1_500_000), EncodingPlan(200_000), EncodingPlan(150_000, 15.0, 0.5)], ids=str
)
def test_timecode_is_read_after_decoding_at_low_bit_rates(plan: EncodingPlan) -> None:
    drive = Drive(plan=plan)
    rng = np.random.default_rng(0)

    def with_timecode(frame: CameraFrame) -> CameraFrame:
        noisy = np.clip(frame.image + rng.normal(0, 6, frame.image.shape), 0, 255).astype(np.uint8)
        timecode.draw(noisy, START + frame.captured)
        return CameraFrame(noisy, frame.captured)

    drive.send(map(with_timecode, itertools.islice(scenery(640, 480), 90)))
    read = [(timecode.read(image, START + 10**9, 640), frame.captured) for frame, image in drive.decoded()]
    assert len(read) == pytest.approx(90 * plan.fps / 30, abs=1)
    right = [time is not None and abs(time - START - captured) <= timecode.TICK_NS for time, captured in read]
    assert np.mean(right) > 0.9 and all(correct or time is None for correct, (time, _) in zip(right, read, strict=True))


def test_time_nearest_to_the_given_one_is_read() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    for time in (
        0,
        5 * timecode.TICK_NS,
        timecode.TICK_RANGE * timecode.TICK_NS - timecode.TICK_NS,
        START // timecode.TICK_NS * timecode.TICK_NS,
    ):
        timecode.draw(image, time)
        for near in (time, time + 3 * 10**9, time + 600 * 10**9, max(0, time - 10**9)):
            assert timecode.read(image, near, 640) == time


def test_invalid_timecode_is_not_read() -> None:
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
    timecode.draw(image, START)
    image[: timecode.SQUARE_PX, : timecode.SQUARE_PX] = (
        timecode.LIGHT if image[0, 0, 0] == timecode.DARK else timecode.DARK
    )
    assert timecode.read(image, START, 640) is None
