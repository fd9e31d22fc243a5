"""Congestion detector: a queue that grows on the links shows in the one-way delay of packets, long before losses.

As in Google congestion control (Carlucci et al., 2016) and SCReAM (RFC 8298), the delay gradient triggers, and the rate
at which packets arrive while they queue is what the links carry. Minima over short windows are compared: they are free
of jitter, of the length of frames and of retransmissions, and increase only if every packet is late.
"""

from __future__ import annotations

from collections import deque

from scan2sim.services.teleoperation.control.messages import CongestionReport

WINDOW_S = 0.04
"""Length of each of the two windows whose minimum delays are compared: a frame of 30 frames/s, and some."""
RATE_WINDOW_S = 0.06
"""Time over which the arrival rate is measured."""
BASE_WINDOW_S, BASE_WINDOWS = 1.0, 30
"""The base delay is the minimum over 30 windows of a second: clocks drift and routes change."""
QUEUE_MIN_MS, RISE_MIN_MS = 20.0, 4.0
"""Delay above the base delay, and its increase from one window to the next, of a growing queue."""
CONFIRM_S = 0.025
"""Time for which a queue has to grow: processes are delayed, too, for a moment."""
REPORT_INTERVAL_S = 0.08
"""Minimum interval between two reports."""


class CongestionDetector:
    """Detects a growing queue from the ages and sizes of packets, of all cameras; has no clock."""

    def __init__(self) -> None:
        self._packets: deque[tuple[float, float, int]] = deque()  # arrival, age, size
        self._bases: deque[tuple[float, float]] = deque(maxlen=BASE_WINDOWS)  # start of a window, minimum age
        self._growing_since: float | None = None
        self._seen: dict[int, float] = {}  # when each camera's last packet arrived
        self._last_report = -REPORT_INTERVAL_S

    def add(self, now: float, age: float, size: int, camera: int) -> CongestionReport | None:
        """Add a packet that arrived at `now` (seconds), `age` ms after it was sent, with `size` bytes.

        Returns:
            A report, if a queue grows.
        """
        self._packets.append((now, age, size))
        self._seen[camera] = now
        while self._packets[0][0] < now - 2 * WINDOW_S:
            self._packets.popleft()
        if not self._bases or now >= self._bases[-1][0] + BASE_WINDOW_S:
            self._bases.append((now, age))
        elif age < self._bases[-1][1]:
            self._bases[-1] = self._bases[-1][0], age
        base = min(base for _, base in self._bases)
        if not self._queue_grows(now, base):
            self._growing_since = None
            return None
        self._growing_since = now if self._growing_since is None else self._growing_since
        if now < self._growing_since + CONFIRM_S or now < self._last_report + REPORT_INTERVAL_S:
            return None
        self._last_report = now
        recent = [one for one in self._packets if one[0] > now - RATE_WINDOW_S]
        cameras = sum(seen > now - BASE_WINDOW_S for seen in self._seen.values())
        rate = 8 * sum(amount for *_, amount in recent) / RATE_WINDOW_S / cameras
        sent = [at - one / 1e3 for at, one, _ in recent]
        share = min(1.0, (max(sent) - min(sent)) / RATE_WINDOW_S)
        return CongestionReport(round(rate), round(share, 3), round(age - base, 1))

    def _queue_grows(self, now: float, base: float) -> bool:
        """Whether all packets of the window are late, later than those before, and don't get earlier.

        After a process or a link stood still, delays decrease while what has accumulated arrives.
        """
        window = [(at, age) for at, age, _ in self._packets if at > now - WINDOW_S]
        newest = min(age for _, age in window)
        before = min((age for at, age, _ in self._packets if at <= now - WINDOW_S), default=newest)
        if newest < base + QUEUE_MIN_MS or newest < before + RISE_MIN_MS:
            return False
        first, last = ([age for at, age in window if (at > now - WINDOW_S / 2) is late] for late in (False, True))
        return bool(first) and sum(last) / len(last) > sum(first) / len(first) - RISE_MIN_MS
