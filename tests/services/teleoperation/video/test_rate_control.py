from __future__ import annotations

import itertools

import numpy as np
import pytest

from scan2sim.services.teleoperation.control.messages import VideoReport
from scan2sim.services.teleoperation.video.rate_control import BitrateBounds, EncodingPlan, RateController

PACKET = 8 * 1150


class Link:
    """A bottleneck with a queue of 400 ms that four cameras share; simulated second by second.

    Attributes:
        rates: (seconds, cameras) bit/s; `delays`: ms in each second.
    """

    def __init__(
        self, capacity: float, loss: float = 0.0, starts: tuple[int, ...] = (1_500_000,) * 4, highest: int = 2_500_000
    ) -> None:
        self.capacity, self.loss = capacity, loss
        self.cameras = [RateController(BitrateBounds(highest=highest), EncodingPlan(start)) for start in starts]
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
                camera.update(VideoReport(i, packets - lost, lost, delay, {}), 640, 480)
            self.rates.append(rates)
            self.delays.append(delay)
            self.losses.append(loss)

    def utilization(self, seconds: int) -> float:
        """Utilization of the link over the last seconds, 0 to 1."""
        return float(np.sum(self.rates[-seconds:], axis=1).mean() / self.capacity)


@pytest.mark.parametrize("capacity", [1.5e6, 4e6, 8e6])
def test_link_is_used_and_its_queue_stays_short(capacity: float) -> None:
    link = Link(capacity)
    link.run(120)
    assert 0.7 < link.utilization(60) <= 1.02
    assert np.percentile(link.delays[-60:], 95) < 45 + 150 and np.median(link.delays[-60:]) < 45 + 40
    assert max(link.losses[-60:]) == 0.0


def test_slow_start_uses_a_wide_link_within_seconds_and_limits_overshoot() -> None:
    wide, narrow = Link(100e6, highest=5_500_000), Link(16e6, highest=5_500_000)
    wide.run(5)
    assert wide.rates[-1] == [5_500_000] * 4
    narrow.run(30)
    assert max(narrow.delays) < 45 + 350 and max(narrow.losses) == 0.0 and narrow.utilization(20) > 0.6


def test_planned_bit_rates_are_quantized_since_each_change_costs_a_key_frame() -> None:
    link = Link(8e6)
    link.run(120)
    for camera in range(4):
        rates = [each[camera] for each in link.rates]
        steps = [max(a, b) / min(a, b) for a, b in itertools.pairwise(rates) if a != b]
        assert min(steps) > 1.1 and len(steps) < 120 / 2


def test_rate_follows_a_degraded_link_within_seconds() -> None:
    link = Link(8e6)
    link.run(60)
    link.capacity = 2e6
    link.run(15)
    assert np.sum(link.rates[-1]) < 1.1 * 2e6
    link.run(45)
    assert np.percentile(link.delays[-30:], 95) < 45 + 150
    link.capacity = 8e6
    link.run(90)
    assert link.utilization(20) > 0.7


def test_cameras_share_fairly() -> None:
    link = Link(4e6, starts=(2_500_000, 150_000, 1_500_000, 1_500_000))
    link.run(180)
    shares = np.mean(link.rates[-60:], axis=0)
    assert shares.max() < 2.5 * shares.min()


def test_random_loss_of_radio_links_does_not_reduce_the_rate() -> None:
    link = Link(20e6, loss=0.01)
    link.run(60)
    assert link.rates[-1] == [BitrateBounds().highest] * 4


def test_quality_steps_down_with_the_bit_rate_and_respects_the_bounds() -> None:
    camera = RateController(BitrateBounds(), EncodingPlan())
    plans = [camera.plan]
    while len(plans) < 60:
        plans.append(camera.update(VideoReport(0, 50, 50, 45.0, {}), 640, 480))
    assert plans[-1] == EncodingPlan(BitrateBounds().lowest, 20.0, 0.5)
    assert all(
        later.fps * later.scale**2 <= earlier.fps * earlier.scale**2 for earlier, later in itertools.pairwise(plans)
    )
    for _ in range(60):
        plans.append(camera.update(VideoReport(0, 100, 0, 45.0, {}), 640, 480))
    assert plans[-1] == EncodingPlan(BitrateBounds().highest, 30.0, 1.0)
    for plan in plans:
        assert plan.bitrate >= 0.9 * 0.05 * 640 * 480 * plan.fps * plan.scale**2 or plan.scale == 0.5


def test_quality_does_not_oscillate_between_two_levels() -> None:
    camera = RateController(BitrateBounds(), EncodingPlan(470_000))
    sizes = []
    for i in range(60):
        report = VideoReport(0, 100, 30 if i % 4 == 0 else 0, 45.0, {})
        plan = camera.update(report, 640, 480)
        sizes.append((plan.fps, plan.scale))
    assert sum(a != b for a, b in itertools.pairwise(sizes)) <= 8


def test_report_without_video_changes_nothing() -> None:
    camera = RateController(BitrateBounds(), EncodingPlan(800_000))
    for _ in range(20):
        assert camera.update(VideoReport(0, 0, 0, None, {}), 640, 480).bitrate == 800_000


def test_report_without_a_complete_frame_is_not_used_as_delay() -> None:
    camera = RateController(BitrateBounds(), EncodingPlan(800_000))
    assert camera.update(VideoReport(0, 20, 0, None, {}), 640, 480).bitrate == 800_000
    for _ in range(10):
        camera.update(VideoReport(0, 100, 0, 95.0, {}), 640, 480)
    assert camera.plan.bitrate == BitrateBounds().highest
