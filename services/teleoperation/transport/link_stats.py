"""How good links are, as gateway and pages are told: with how much goes through them now."""

from __future__ import annotations

import math
import threading
import time

from scan2sim.services.teleoperation.gateway.protocol import LinkStatus
from scan2sim.services.teleoperation.transport.multipath import Bundle

SHORTEST = 0.5
"""Seconds that a rate is taken over, at least."""


class Rates:
    """Remembers what went through links before; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._before: dict[str, tuple[float, int]] = {}
        self._rates: dict[str, float] = {}

    def links(self, bundle: Bundle) -> tuple[LinkStatus, ...]:
        """All of a bundle's."""
        now = time.monotonic()
        with self._lock:
            return tuple(
                LinkStatus(
                    name=one.name[:60],
                    up=one.up,
                    round_trip=None if math.isnan(one.round_trip_ms) else round(one.round_trip_ms, 1),
                    loss=round(max(one.loss, one.loss_there), 4),
                    rate=self._rate(one.name, one.bytes_in + one.bytes_out, now),
                )
                for one in bundle.links
            )

    def _rate(self, name: str, count: int, now: float) -> float:
        """Mbit/s of a link by which so many bytes have gone."""
        since, before = self._before.get(name, (now, count))
        if name not in self._before or count < before or now - since >= SHORTEST:
            self._before[name] = now, count
            seconds = now - since
            self._rates[name] = max(0, count - before) * 8e-6 / seconds if seconds > 0 else 0.0
        return round(self._rates[name], 2)
