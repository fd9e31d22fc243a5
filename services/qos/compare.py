"""Compare measured metrics with requirements, and extrapolate resource needs to other image rates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from scan2sim.services.qos.measure import Measurement
from scan2sim.services.qos.requirements import MACHINE_METRICS, NETWORK_METRICS, Bound, Requirements

IMAGE_RATES = (1.0, 2.0, 5.0, 10.0, 25.0)
"""Image rates (images per second) for which resource needs are printed."""
MAX_CPU_LOAD = 0.7
"""Maximum share of CPU time; above it, images queue for long."""


@dataclass(frozen=True)
class MetricComparison:
    """Comparison of one metric; `passed` is None if it isn't required or can't be measured."""

    metric: str
    required: Bound | None
    measured: float | None
    passed: bool | None


class MetricSource(Protocol):
    """A measurement."""

    def values(self) -> dict[str, float | None]:
        """Values of the metrics of `Requirements`; None: not applicable."""


def compare_metrics(required: Requirements, measured: MetricSource) -> list[MetricComparison]:
    """Compare all metrics that are required or measured.

    Network requirements pass if there is no network. A request without a response fails the response time, even if none
    is required.
    """
    values = measured.values()
    found = []
    for metric in (*NETWORK_METRICS, *MACHINE_METRICS):
        bound, value = getattr(required, metric), values[metric]
        if bound is None and value is None:
            continue
        found.append(MetricComparison(metric, bound, value, _met(metric, bound, value)))
    return found


def _met(metric: str, bound: Bound | None, value: float | None) -> bool | None:
    if value is None:
        unused = metric.endswith("_usage")  # of a processor that doesn't exist
        return None if bound is None or unused else False
    if bound is None:
        return False if math.isinf(value) else None
    return bound.met(value)


def passed(found: list[MetricComparison], metrics: tuple[str, ...]) -> bool:
    """Whether none of the given metrics fails its requirement."""
    return all(row.passed is not False for row in found if row.metric in metrics)


@dataclass(frozen=True)
class ResourceNeeds:
    """Resources needed for an image rate.

    Attributes:
        rate: images per second.
        bandwidth: Mbit/s on the network, both ways; None: no network.
        cores: number of CPU cores like those of this machine.
    """

    rate: float
    bandwidth: float | None
    cores: float


def resource_needs(measured: Measurement, rate: float) -> ResourceNeeds:
    """Resources needed for an image rate; bytes and CPU time are proportional to the number of images."""
    sent = measured.requests.sent
    on_wire = measured.wire_bytes / sent * rate * 8e-6 if measured.probe else None
    return ResourceNeeds(rate, on_wire, measured.usage.cpu_seconds / sent * rate / MAX_CPU_LOAD)
