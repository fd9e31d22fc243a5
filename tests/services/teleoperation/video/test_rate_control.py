from __future__ import annotations

import itertools

import numpy as np
import pytest

from scan2sim.services.teleoperation.control.messages import Report
from scan2sim.services.teleoperation.video.rate_control import Adapting, Bounds, Plan

PACKET = 8 * 1150


class Link:
    """A bottleneck with a queue of 400 ms that four cameras share; simulated second by second.

    Attributes:
        rates: (seconds, cameras) bits a second; `delays`: ms of each second.
    """

    def __init__(
        self, capacity: float, loss: float = 0.0, starts: tuple[int, ...] = (1_500_000,) * 4, highest: int = 2_500_000
    ) -> None:
        self.capacity, self.loss = capacity, loss
        self.cameras = [Adapting(Bounds(highest=highest), Plan(start)) for start in starts]
        self.queue = 0.0
        self.rates: list[list[int]] = []
        self.delays: list[float] = []
        self.losses: list[float] = []

    def run(self, seconds: int) -> None:
        for _ in range(seconds):
            rates = [camera.plan.bitrate for camera in self.cameras]
            self.queue = max(0.0, self.queue + sum(rates) - self.capacity)
            over = max(0.0, self.queue - 0.4 * self.capacity)
            self.queue -= over
            loss = over / sum(rates) + self.loss
            delay = 45 + 1e3 * self.queue / self.capacity
            for i, (camera, rate) in enumerate(zip(self.cameras, rates, strict=True)):
                packets = rate // PACKET
                lost = round(loss * packets)
                camera.follow(Report(i, packets - lost, lost, delay, {}), 640, 480)
            self.rates.append(rates)
            self.delays.append(delay)
            self.losses.append(loss)

    def used(self, seconds: int) -> float:
        """Part of the link that was used lately."""
        return float(np.sum(self.rates[-seconds:], axis=1).mean() / self.capacity)


@pytest.mark.parametrize("capacity", [1.5e6, 4e6, 8e6])
def test_the_link_is_used_and_its_queue_stays_short(capacity: float) -> None:
    link = Link(capacity)
    link.run(120)
    assert 0.7 < link.used(60) <= 1.02
    assert np.percentile(link.delays[-60:], 95) < 45 + 150 and np.median(link.delays[-60:]) < 45 + 40
    assert max(link.losses[-60:]) == 0.0


def test_a_link_that_carries_much_is_used_within_seconds_and_is_not_filled_far_beyond() -> None:
    wide, narrow = Link(100e6, highest=5_500_000), Link(16e6, highest=5_500_000)
    wide.run(5)
    assert wide.rates[-1] == [5_500_000] * 4
    narrow.run(30)
    assert max(narrow.delays) < 45 + 350 and max(narrow.losses) == 0.0 and narrow.used(20) > 0.6


def test_what_is_planned_goes_in_steps_as_each_costs_a_key_frame() -> None:
    link = Link(8e6)
    link.run(120)
    for camera in range(4):
        rates = [each[camera] for each in link.rates]
        steps = [max(a, b) / min(a, b) for a, b in itertools.pairwise(rates) if a != b]
        assert min(steps) > 1.1 and len(steps) < 120 / 2


def test_a_link_that_worsens_is_followed_within_seconds() -> None:
    link = Link(8e6)
    link.run(60)
    link.capacity = 2e6
    link.run(15)
    assert np.sum(link.rates[-1]) < 1.1 * 2e6
    link.run(45)
    assert np.percentile(link.delays[-30:], 95) < 45 + 150
    link.capacity = 8e6
    link.run(90)
    assert link.used(20) > 0.7


def test_cameras_share_fairly() -> None:
    link = Link(4e6, starts=(2_500_000, 150_000, 1_500_000, 1_500_000))
    link.run(180)
    shares = np.mean(link.rates[-60:], axis=0)
    assert shares.max() < 2.5 * shares.min()


def test_what_radio_loses_anyway_is_no_reason_for_less() -> None:
    link = Link(20e6, loss=0.01)
    link.run(60)
    assert link.rates[-1] == [Bounds().highest] * 4


def test_the_picture_gets_smaller_before_it_gets_unreadable_and_never_beyond_its_bounds() -> None:
    camera = Adapting(Bounds(), Plan())
    plans = [camera.plan]
    while len(plans) < 60:
        plans.append(camera.follow(Report(0, 50, 50, 45.0, {}), 640, 480))
    assert plans[-1] == Plan(Bounds().lowest, 20.0, 0.5)
    assert all(
        later.fps * later.scale**2 <= earlier.fps * earlier.scale**2 for earlier, later in itertools.pairwise(plans)
    )
    for _ in range(60):
        plans.append(camera.follow(Report(0, 100, 0, 45.0, {}), 640, 480))
    assert plans[-1] == Plan(Bounds().highest, 30.0, 1.0)
    for plan in plans:
        assert plan.bitrate >= 0.9 * 0.05 * 640 * 480 * plan.fps * plan.scale**2 or plan.scale == 0.5


def test_at_a_rate_between_two_rungs_it_does_not_go_up_and_down() -> None:
    camera = Adapting(Bounds(), Plan(470_000))
    sizes = []
    for i in range(60):
        report = Report(0, 100, 30 if i % 4 == 0 else 0, 45.0, {})
        plan = camera.follow(report, 640, 480)
        sizes.append((plan.fps, plan.scale))
    assert sum(a != b for a, b in itertools.pairwise(sizes)) <= 8


def test_without_video_nothing_is_concluded() -> None:
    camera = Adapting(Bounds(), Plan(800_000))
    for _ in range(20):
        assert camera.follow(Report(0, 0, 0, None, {}), 640, 480).bitrate == 800_000


def test_a_beginning_without_a_whole_picture_is_no_measure_of_delays() -> None:
    camera = Adapting(Bounds(), Plan(800_000))
    assert camera.follow(Report(0, 20, 0, None, {}), 640, 480).bitrate == 800_000
    for _ in range(10):
        camera.follow(Report(0, 100, 0, 95.0, {}), 640, 480)
    assert camera.plan.bitrate == Bounds().highest
