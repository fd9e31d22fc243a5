"""Rate control of a camera's video: additive increase, multiplicative decrease (AIMD), with each video report.

A queue that begins to grow is reported at once (`congestion`), with the rate that the links carry; the rate follows.
Between such reports delay counts like loss: a growing queue shows in it before packets are dropped. Until that happens
for the first time, the rate grows by half with each report, as in TCP's slow start.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from scan2sim.services.teleoperation.control.messages import CongestionReport, VideoReport

DECREASE_LOSS, INCREASE_LOSS_MAX = 0.05, 0.02
"""Packet loss above which the rate decreases, and below which it increases. Radio links lose 1 % at any rate."""
QUEUE_DELAY_MS = 40.0
"""Delay above the base delay that is attributed to a growing queue."""
BASE_DELAY_REPORTS = 30
"""Reports over which the base (minimum) delay is taken; it is limited as clocks drift and routes change."""
DECREASE_FACTOR = 0.75
REPORTS_IGNORED_AFTER_DECREASE = 1
"""Reports after a decrease that are ignored, since they describe the time before it."""
RELIEF_FACTOR = 0.85
"""Share of the rate that the links carry which is used once a queue grows (Google congestion control)."""
RELIEF_MIN = 0.25
"""Least share of the present rate that remains after a report; a lower rate needs another report."""
HOLD_REPORTS, AGAIN_SHARE = (2, 16), 0.8
"""Reports without an increase after relief, at first and at most: doubled if a queue grows again at about that rate."""
REPORTS_IGNORED_AFTER_RELIEF = 2
"""Reports after that which are ignored, since their delays are those of the queue."""
INCREASE_BPS, INCREASE_SHARE = 10_000, 0.05
"""Increase per report: bit/s, and share of the current rate; small, so as not to fill a narrow link in a second."""
SLOW_START_FACTOR = 1.5
"""Growth per report in slow start, until a link is full for the first time."""
BITRATE_STEP = 1.15
"""Ratio between two planned bit rates; they are quantized since each change needs a new encoder and a key frame."""
BITS_PER_PIXEL_MIN = 0.05
"""Bits per pixel below which a smaller frame size or frame rate gives a better image."""
QUALITY_LADDER = ((1.0, 1.0), (1.0, 2 / 3), (0.75, 2 / 3), (0.5, 2 / 3))
"""Scale of the image sides and share of the frame rate, from best to worst quality."""
STEP_UP_MARGIN = 1.25
"""Multiple of the bit rate needed for a level at which quality steps up to it again."""


class EncodingPlan(NamedTuple):
    """Encoding parameters of a camera.

    Attributes:
        bitrate: bit/s.
        fps: maximum frame rate, frames/s.
        scale: of the image sides, at most 1.
    """

    bitrate: int = 1_500_000
    fps: float = 30.0
    scale: float = 1.0


class BitrateBounds(NamedTuple):
    """Bounds of a camera's bit rate, bit/s."""

    lowest: int = 150_000
    highest: int = 2_500_000


class RateController:
    """Adapts a camera's encoding plan to its video reports.

    Attributes:
        plan: current plan.
    """

    def __init__(self, bounds: BitrateBounds, start: EncodingPlan) -> None:
        """`start`: initial plan, with the maximum frame rate."""
        self.plan = start
        self._bounds, self._fps = bounds, start.fps
        self._bitrate, self._slow_start_ended = float(start.bitrate), False
        self._delays: deque[float] = deque(maxlen=BASE_DELAY_REPORTS)
        self._level = self._ignored_reports = self._held = 0
        self._relieved, self._hold = math.inf, HOLD_REPORTS[0]

    def update(self, report: VideoReport, width: int, height: int) -> EncodingPlan:
        """Plan after a report, for frames of this size."""
        estimated = self._estimate(report)
        if estimated != self._bitrate:
            self._replan(estimated, width, height)
        return self.plan

    def relieve(self, report: CongestionReport, width: int, height: int) -> EncodingPlan:
        """Plan for links that carry `report.rate`: at once below it, so that the queue drains."""
        share = max(report.share, RELIEF_MIN) * self._bitrate  # a camera that sends little now doesn't get less
        lowered = max(self._bounds.lowest, RELIEF_FACTOR * max(report.rate, share))
        self._ignored_reports, self._slow_start_ended = REPORTS_IGNORED_AFTER_RELIEF, True
        if lowered < self._bitrate:
            again = lowered > AGAIN_SHARE * self._relieved
            self._hold = min(2 * self._hold, HOLD_REPORTS[1]) if again else HOLD_REPORTS[0]
            self._relieved, self._held = lowered, self._hold
            self._replan(lowered, width, height)
        return self.plan

    def _replan(self, bitrate: float, width: int, height: int) -> None:
        self._bitrate, quantized = bitrate, self._quantize(bitrate)
        self._choose_level(quantized, width * height * self._fps)
        scale, share = QUALITY_LADDER[self._level]
        self.plan = EncodingPlan(quantized, self._fps * share, scale)

    def _quantize(self, bitrate: float) -> int:
        """Quantize: the highest bit rate that is a whole number of steps below the maximum, and not above `bitrate`."""
        steps = math.ceil(math.log(self._bounds.highest / bitrate, BITRATE_STEP) - 1e-9)
        return max(self._bounds.lowest, round(self._bounds.highest / BITRATE_STEP**steps))

    def _estimate(self, report: VideoReport) -> float:
        """Estimate the bit rate that the links carry from a report."""
        sent = report.received + report.lost
        loss = report.lost / sent if sent else 0.0
        queue_delay = 0.0
        if report.delay is not None:
            self._delays.append(report.delay)
            queue_delay = report.delay - min(self._delays)
        if self._ignored_reports:
            self._ignored_reports -= 1
        elif loss > DECREASE_LOSS or queue_delay > QUEUE_DELAY_MS:
            self._ignored_reports, self._slow_start_ended = REPORTS_IGNORED_AFTER_DECREASE, True
            return max(self._bounds.lowest, DECREASE_FACTOR * self._bitrate)
        elif self._held:
            self._held -= 1
        elif report.delay is not None and loss < INCREASE_LOSS_MAX and queue_delay < QUEUE_DELAY_MS / 2:
            increased = (
                (1 + INCREASE_SHARE) * self._bitrate + INCREASE_BPS
                if self._slow_start_ended
                else SLOW_START_FACTOR * self._bitrate
            )
            return min(self._bounds.highest, increased)
        return self._bitrate

    def _choose_level(self, bitrate: int, pixels: float) -> None:
        """Step down as far as the bit rate requires, or up by one level."""
        while self._level + 1 < len(QUALITY_LADDER) and bitrate < _bitrate_needed(self._level, pixels):
            self._level += 1
        if self._level and bitrate > STEP_UP_MARGIN * _bitrate_needed(self._level - 1, pixels):
            self._level -= 1


def _bitrate_needed(level: int, pixels: float) -> float:
    """Bit rate that a level needs, bit/s, for a number of pixels/s at full quality."""
    scale, share = QUALITY_LADDER[level]
    return BITS_PER_PIXEL_MIN * pixels * scale**2 * share
