"""What was asked against what was measured, and what other rates would need."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from scan2sim.services.qos.measure import Measured
from scan2sim.services.qos.requirements import MACHINE, NETWORK, Bound, Requirements

RATES = (1.0, 2.0, 5.0, 10.0, 25.0)
"""Images a second that needs are told for."""
LOADED = 0.7
"""Share of a processor's time that may be taken: beyond it, images wait long for each other."""


@dataclass(frozen=True)
class Row:
    """Of a metric; passed is None where nothing is asked, or there is nothing to measure."""

    metric: str
    required: Bound | None
    measured: float | None
    passed: bool | None


class Valued(Protocol):
    """Whatever was measured."""

    def values(self) -> dict[str, float | None]:
        """By the metrics of `Requirements`; None: there is no such thing here."""


def rows(required: Requirements, measured: Valued) -> list[Row]:
    """Of all metrics that are asked or measured.

    What is asked of a network that isn't there is met; an answer that never came is too late, whatever is asked.
    """
    values = measured.values()
    found = []
    for metric in (*NETWORK, *MACHINE):
        bound, value = getattr(required, metric), values[metric]
        if bound is None and value is None:
            continue
        found.append(Row(metric, bound, value, _met(metric, bound, value)))
    return found


def _met(metric: str, bound: Bound | None, value: float | None) -> bool | None:
    if value is None:
        idle = metric.endswith("_usage")  # of a processor that isn't there
        return None if bound is None or idle else False
    if bound is None:
        return False if math.isinf(value) else None
    return bound.met(value)


def passed(found: list[Row], metrics: tuple[str, ...]) -> bool:
    """Whether all of some metrics are as asked."""
    return all(row.passed is not False for row in found if row.metric in metrics)


@dataclass(frozen=True)
class Needs:
    """Of a rate of images.

    Attributes:
        bandwidth: Mbit/s on the network, both ways; None: there is none.
        cores: of this machine's kind.
    """

    rate: float
    bandwidth: float | None
    cores: float


def needs(measured: Measured, rate: float) -> Needs:
    """What a rate needs: bytes and work are in proportion to the images."""
    sent = measured.answers.sent
    on_wire = measured.wire_bytes / sent * rate * 8e-6 if measured.seen else None
    return Needs(rate, on_wire, measured.usage.cpu_seconds / sent * rate / LOADED)
