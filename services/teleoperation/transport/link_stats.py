"""Link statistics for gateway and pages: round trip, loss, and current data rate."""

from __future__ import annotations

import math
import threading
import time

from scan2sim.services.teleoperation.gateway_protocol import LinkStatus
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection

RATE_PERIOD_MIN_S = 0.5
"""Minimum period over which a rate is measured."""


class LinkRates:
    """Data rates of links, from byte counts; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._before: dict[str, tuple[float, int]] = {}
        self._rates: dict[str, float] = {}

    def links(self, connection: MultipathConnection) -> tuple[LinkStatus, ...]:
        """Status of all links of a connection."""
        now = time.monotonic()
        with self._lock:
            return tuple(
                LinkStatus(
                    name=one.name[:60],
                    up=one.up,
                    round_trip=None if math.isnan(one.round_trip_ms) else round(one.round_trip_ms, 1),
                    loss=round(max(one.loss, one.loss_there), 4),
                    rate=self._rate(one.name, one.bytes_in + one.bytes_out, now),
                    silent_ms=None if math.isnan(one.silent_s) else round(one.silent_s * 1e3),
                )
                for one in connection.links
            )

    def _rate(self, name: str, bytes_total: int, now: float) -> float:
        """Data rate of a link, Mbit/s, from its byte count."""
        since, before = self._before.get(name, (now, bytes_total))
        if name not in self._before or bytes_total < before or now - since >= RATE_PERIOD_MIN_S:
            self._before[name] = now, bytes_total
            seconds = now - since
            self._rates[name] = max(0, bytes_total - before) * 8e-6 / seconds if seconds > 0 else 0.0
        return round(self._rates[name], 2)
