"""How a camera's video follows what the links carry: additive increase, multiplicative decrease, report by report.

Late is as bad as lost: a queue that grows somewhere on the way shows in the delay before anything is dropped. Until
that happens for the first time, the rate grows by half each report, as TCP's does in its slow start.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from scan2sim.services.teleoperation.control.messages import Report

LOSSY, LOSSLESS = 0.05, 0.02
"""Parts of packets: where more are lost, less is sent; where fewer are, more. Radio links lose 1 % of any rate."""
GROWN = 40.0
"""Milliseconds over the least delay of late that a queue is taken for."""
REPORTS = 30
"""That the least delay is taken of: clocks drift, and links take other ways."""
DECREASE = 0.75
REST = 1
"""Reports after a decrease that tell of what was before it."""
INCREASE, SHARE = 10_000, 0.05
"""Bits a second that are added, and the part of what is sent, so that few bits don't fill a narrow link in a second."""
START = 1.5
"""Times what is sent, in place of that, until a link was full for the first time."""
STEP = 1.15
"""From one bit rate that is planned to the next: another means another encoder, and a key frame."""
BITS = 0.05
"""A pixel's, with fewer of which a smaller picture, or fewer of them, show more."""
LADDER = ((1.0, 1.0), (1.0, 2 / 3), (0.75, 2 / 3), (0.5, 2 / 3))
"""Scale of the sides, part of the pictures: what is given up, first to last."""
HIGHER = 1.25
"""Times the bit rate that a rung needs, before it is climbed again."""


class Plan(NamedTuple):
    """How a camera's pictures are sent.

    Attributes:
        bitrate: bits a second.
        fps: pictures a second, at most.
        scale: of the picture's sides, at most 1.
    """

    bitrate: int = 1_500_000
    fps: float = 30.0
    scale: float = 1.0


class Bounds(NamedTuple):
    """Of a camera's bit rate, bits a second."""

    lowest: int = 150_000
    highest: int = 2_500_000


class Adapting:
    """A camera's plan, report by report.

    Attributes:
        plan: from now on.
    """

    def __init__(self, bounds: Bounds, start: Plan) -> None:
        """`start`: at best so many pictures a second."""
        self.plan = start
        self._bounds, self._fps = bounds, start.fps
        self._bitrate, self._filled = float(start.bitrate), False
        self._delays: deque[float] = deque(maxlen=REPORTS)
        self._rung = self._rests = 0

    def follow(self, report: Report, width: int, height: int) -> Plan:
        """What is best after a report, for a camera of so many pixels."""
        carried = self._carried(report)
        if carried == self._bitrate:
            return self.plan
        self._bitrate, bitrate = carried, self._stepped(carried)
        self._climb(bitrate, width * height * self._fps)
        scale, part = LADDER[self._rung]
        self.plan = Plan(bitrate, self._fps * part, scale)
        return self.plan

    def _stepped(self, bitrate: float) -> int:
        """The next bit rate that is below the highest by whole steps."""
        steps = math.ceil(math.log(self._bounds.highest / bitrate, STEP) - 1e-9)
        return max(self._bounds.lowest, round(self._bounds.highest / STEP**steps))

    def _carried(self, report: Report) -> float:
        """What links carry of this camera's, as a report tells."""
        sent = report.received + report.lost
        loss = report.lost / sent if sent else 0.0
        grown = 0.0
        if report.delay is not None:
            self._delays.append(report.delay)
            grown = report.delay - min(self._delays)
        if self._rests:
            self._rests -= 1
        elif loss > LOSSY or grown > GROWN:
            self._rests, self._filled = REST, True
            return max(self._bounds.lowest, DECREASE * self._bitrate)
        elif report.delay is not None and loss < LOSSLESS and grown < GROWN / 2:
            more = (1 + SHARE) * self._bitrate + INCREASE if self._filled else START * self._bitrate
            return min(self._bounds.highest, more)
        return self._bitrate

    def _climb(self, bitrate: int, pixels: float) -> None:
        """Down the ladder as far as the bit rate wants, and up again a rung at a time."""
        while self._rung + 1 < len(LADDER) and bitrate < _needs(self._rung, pixels):
            self._rung += 1
        if self._rung and bitrate > HIGHER * _needs(self._rung - 1, pixels):
            self._rung -= 1


def _needs(rung: int, pixels: float) -> float:
    """Bits a second that a rung is good for, of so many pixels a second on the highest."""
    scale, part = LADDER[rung]
    return BITS * pixels * scale**2 * part
