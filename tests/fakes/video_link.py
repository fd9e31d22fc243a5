"""Video of several cameras over a simulated link, in simulated time: rate control as in the vehicle and the station."""

from __future__ import annotations

import heapq
import itertools
import random
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from scan2sim.services.teleoperation.control.messages import CongestionReport, VideoReport
from scan2sim.services.teleoperation.station.app import REPORT_SPREAD_S
from scan2sim.services.teleoperation.vehicle.app import drain_s
from scan2sim.services.teleoperation.video.capture import PAUSE_INTERVAL_MIN_S
from scan2sim.services.teleoperation.video.congestion import CongestionDetector
from scan2sim.services.teleoperation.video.rate_control import BitrateBounds, EncodingPlan, RateController

PACKET_BYTES, OVERHEAD_BYTES = 1150, 48 + 42

KEY_FRAME_SHARES = 3.0
"""Size of a key frame, in frames; a change of the plan begins with one."""


@dataclass
class SimulatedLink:
    """A link with a queue; `rate`: bit/s at a time; `queue`: seconds at the present rate; delays in seconds."""

    rate: Callable[[float], float]
    delay: float = 0.03
    jitter: float = 0.0
    loss: float = 0.0
    queue: float = 1.0
    free: float = 0.0

    def send(self, now: float, size: int, chance: random.Random) -> float | None:
        """Time of arrival; None: the packet is lost."""
        rate = self.rate(now)
        if max(self.free - now, 0.0) > self.queue or chance.random() < self.loss:
            return None
        self.free = max(self.free, now) + 8 * size / rate
        return self.free + self.delay + chance.uniform(0, self.jitter)


@dataclass
class _Camera:
    controller: RateController
    plan: EncodingPlan
    needs_key: bool = True
    paused_until: float = -1.0
    due: float = 0.0
    received: int = 0
    lost: int = 0
    newest: float = 0.0
    broken: bool = False
    delays: list[float] = field(default_factory=list)


class SimulatedVideo:
    """Runs on creation.

    Attributes:
        ages: every 10 ms, time and age of the oldest of the cameras' newest pictures, seconds and ms.
        rates: every 10 ms, time and the sum of the planned bit rates, bit/s.
        reliefs: times of congestion reports.
    """

    def __init__(
        self,
        link: SimulatedLink,
        seconds: float,
        *,
        cameras: int = 4,
        highest: int = 4_400_000,
        detect: bool = True,
        stalls: float = 0.0,
        seed: int = 1,
    ) -> None:
        """`stalls`: seconds for which sender and receiver each stop, once a second on average."""
        self._link, self._chance, self._detector = link, random.Random(seed), CongestionDetector() if detect else None
        bounds = BitrateBounds(highest=highest)
        self._cameras = [_Camera(RateController(bounds, EncodingPlan()), EncodingPlan()) for _ in range(cameras)]
        self._events: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._order = itertools.count()
        self._stalls, self._stall_ends = stalls, [0.0, 0.0]
        self.ages: list[tuple[float, float]] = []
        self.rates: list[tuple[float, float]] = []
        self.reliefs: list[float] = []
        for number in range(cameras):
            self._at(0.009 * number, self._capture, number)
            self._at(1.0 + REPORT_SPREAD_S * number / cameras, self._report, number)
        self._at(0.0, self._sample)
        while self._events and (event := heapq.heappop(self._events))[0] < seconds:
            self.now = event[0]
            event[2](*event[3])

    def peak(self, since: float, before: float) -> tuple[float, float]:
        """Highest extra age (ms) after `since`, relative to that from `before`; seconds until it stays below 100 ms."""
        usual = statistics.median(age for at, age in self.ages if before < at < since)
        extra = [(at, age - usual) for at, age in self.ages if at >= since]
        late = [at for at, age in extra if age > 100]
        return max(age for _, age in extra), round(late[-1] - since, 2) if late else 0.0

    def mean_rate(self, since: float) -> float:
        """Mean planned rate of all cameras, bit/s."""
        return statistics.fmean(rate for at, rate in self.rates if at > since)

    def _at(self, time: float, do: Callable[..., None], *arguments: Any) -> None:
        heapq.heappush(self._events, (time, next(self._order), do, arguments))

    def _stalled(self, end: int) -> float:
        """Time at which an end continues."""
        if self._stalls and self.now > self._stall_ends[end] and self._chance.random() < 0.002:
            self._stall_ends[end] = self.now + self._stalls
        return max(self.now, self._stall_ends[end])

    def _capture(self, number: int) -> None:
        one = self._cameras[number]
        self._at(self.now + 1 / 30, self._capture, number)
        if self.now < one.due - 1 / 120 or self.now < one.paused_until:
            return
        one.due = max(one.due, self.now - 1 / 60) + 1 / one.plan.fps
        key, one.needs_key = one.needs_key, False
        size = one.plan.bitrate / one.plan.fps / 8 * self._chance.uniform(0.85, 1.15) * (KEY_FRAME_SHARES if key else 1)
        count, sent = int(-(-size // PACKET_BYTES)), self._stalled(0)
        self._at(sent, self._send, number, self.now, count, key)

    def _send(self, number: int, captured: float, count: int, key: bool) -> None:
        one, last = self._cameras[number], 0.0
        for _ in range(count):
            overflow = self._link.free - self.now > self._link.queue
            arrival = self._link.send(self.now, PACKET_BYTES + OVERHEAD_BYTES, self._chance)
            if arrival is None:  # retransmitted, or not: the frame is late by a round trip, or there is a key frame
                one.lost += 1
                arrival = None if overflow else self.now + 0.1 + self._link.delay
            if arrival is None:
                one.broken = True
                continue
            last = max(last, arrival)
            self._at(arrival, self._receive, number, self.now)
        if key:
            one.broken = False
        if one.broken:
            self._at(self.now + 0.25, self._request_key, number)
        else:
            self._at(last, self._show, number, captured)

    def _receive(self, number: int, sent: float) -> None:
        read = self._stalled(1)
        if read > self.now:
            self._at(read, self._receive, number, sent)
            return
        self._cameras[number].received += 1
        if self._detector is None:
            return
        report = self._detector.add(self.now, 1e3 * (self.now - sent), PACKET_BYTES + 32, number)
        if report is not None:
            self.reliefs.append(self.now)
            self._at(self.now + self._link.delay, self._relieve, report)

    def _show(self, number: int, captured: float) -> None:
        one = self._cameras[number]
        one.newest = max(one.newest, captured)
        one.delays.append(1e3 * (self.now - captured))

    def _request_key(self, number: int) -> None:
        self._cameras[number].needs_key = True

    def _replan(self, one: _Camera, plan: EncodingPlan) -> None:
        one.needs_key = one.needs_key or plan != one.plan
        one.plan = plan

    def _relieve(self, report: CongestionReport) -> None:
        for one in self._cameras:
            self._replan(one, one.controller.relieve(report, 640, 480))
            if self.now > one.paused_until + PAUSE_INTERVAL_MIN_S:
                one.paused_until = self.now + drain_s(report, 2 * self._link.delay)

    def _report(self, number: int) -> None:
        one = self._cameras[number]
        delay = statistics.median(one.delays) if one.delays else None
        report = VideoReport(number, one.received, one.lost, delay, {})
        one.received, one.lost, one.delays = 0, 0, []
        self._replan(one, one.controller.update(report, 640, 480))
        self._at(self.now + 1.0, self._report, number)

    def _sample(self) -> None:
        self.ages.append((self.now, 1e3 * max(self.now - one.newest for one in self._cameras)))
        self.rates.append((self.now, float(sum(one.plan.bitrate for one in self._cameras))))
        self._at(self.now + 0.01, self._sample)
