"""Compare measured metrics with requirements, and extrapolate resource needs to other image rates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from scan2sim.services.qos.measure import Measurement
from scan2sim.services.qos.requirements import MACHINE_METRICS, NETWORK_METRICS, Bound, Requirements

IMAGE_RATES = (1.0, 2.0, 5.0, 10.0, 25.0)
"""Image rates (images per second) for which resource needs are printed."""
NOT_MEASURED, NOT_DECIDED = "not measured", "not decided"
"""Notes on metrics that can't be measured here, and on shares whose confidence bounds contain the limit."""
MAX_CPU_LOAD = 0.7
"""Maximum share of CPU time; above it, images queue for long."""


@dataclass(frozen=True)
class MetricComparison:
    """Comparison of one metric.

    Attributes:
        metric: its name.
        required: limit; None: not required.
        measured: value; None: not measured; infinite: some requests had no response.
        passed: None: not required, not measured or not decided.
        bounds: confidence bounds of a measured share.
        note: why a required metric neither passed nor failed.
    """

    metric: str
    required: Bound | None
    measured: float | None
    passed: bool | None
    bounds: tuple[float, float] | None = None
    note: str = ""


class MetricSource(Protocol):
    """A measurement."""

    def values(self) -> dict[str, float | None]:
        """Values of the metrics of `Requirements`; None: not applicable."""

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Confidence bounds of metrics that are shares, by name."""


def compare_metrics(required: Requirements, measured: MetricSource) -> list[MetricComparison]:
    """Compare all metrics that are required or measured.

    What can't be measured here, such as a GPU, neither passes nor fails. A share passes or fails if its confidence
    bounds are on one side of the limit, unless that is zero. A request without a response fails the response time, even
    if none is required.
    """
    values, bounds = measured.values(), measured.bounds()
    found = []
    for metric in (*NETWORK_METRICS, *MACHINE_METRICS):
        bound, value = getattr(required, metric), values[metric]
        if bound is None and value is None:
            continue
        found.append(_compared(metric, bound, value, bounds.get(metric)))
    return found


def _compared(
    metric: str, required: Bound | None, value: float | None, bounds: tuple[float, float] | None
) -> MetricComparison:
    if value is None:
        return MetricComparison(metric, required, None, None, note=NOT_MEASURED)
    if required is None:
        return MetricComparison(metric, None, value, False if math.isinf(value) else None, bounds)
    if bounds is None or required.value == 0 or required.met(bounds[0]) == required.met(bounds[1]):
        return MetricComparison(metric, required, value, required.met(value), bounds)
    return MetricComparison(metric, required, value, None, bounds, NOT_DECIDED)


def summary(found: list[MetricComparison], metrics: tuple[str, ...]) -> str:
    """Outcome of the given metrics in words."""
    outcome = "passed" if passed(found, metrics) else "FAILED"
    for note in (NOT_MEASURED, NOT_DECIDED):
        names = [row.metric.replace("_", " ") for row in found if row.note == note and row.metric in metrics]
        outcome += f"; {note}: {', '.join(names)}" if names else ""
    return outcome


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
