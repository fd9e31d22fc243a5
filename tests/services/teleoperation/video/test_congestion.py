"""Congestion is detected by the delay gradient, before packets are lost; jitter and stalled processes are none."""

from __future__ import annotations

import pytest

from tests.fakes.video_link import SimulatedLink, SimulatedVideo

FULL, NARROW = 20e6, 5e6
DROP_S, END_S = 15.0, 30.0


def drop(detect: bool) -> SimulatedVideo:
    return SimulatedVideo(SimulatedLink(lambda at: FULL if at < DROP_S else NARROW), END_S, detect=detect)


def test_rate_follows_a_link_that_becomes_narrow_before_its_queue_is_full() -> None:
    before, after = drop(detect=False), drop(detect=True)
    (slow, _), (peak, settled) = before.peak(DROP_S, 10), after.peak(DROP_S, 10)
    assert peak < 550 and settled < 1.5 and slow > 1000  # the queue has a second
    assert not [at for at in after.reliefs if at < DROP_S] and after.reliefs[0] < DROP_S + 0.15
    assert 0.7 * NARROW < after.mean_rate(DROP_S + 5) < NARROW


def test_rate_recovers_when_the_link_does() -> None:
    video = SimulatedVideo(SimulatedLink(lambda at: NARROW if 10 < at < 15 else FULL), 45)
    assert video.mean_rate(44) > 2.5 * NARROW


@pytest.mark.parametrize(
    ("link", "others"),
    [
        ({"jitter": 0.01, "loss": 0.01}, {}),
        ({"jitter": 0.02}, {}),
        ({"jitter": 0.01, "loss": 0.01}, {"cameras": 1}),
        ({}, {"stalls": 0.1}),
    ],
    ids=["mobile link", "jitter", "one camera", "stalled processes"],
)
def test_jitter_loss_and_stalls_are_no_congestion(link: dict[str, float], others: dict[str, float]) -> None:
    video = SimulatedVideo(SimulatedLink(lambda at: 5 * FULL, **link), 30, **others)  # type: ignore[arg-type]
    assert not video.reliefs and video.mean_rate(20) == video.mean_rate(29)
