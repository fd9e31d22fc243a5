"""Bandwidth, loss and latency reported by monitors, compared with emulated links (part `link` of `bench.bus`).

A monitored node publishes in one network namespace, a monitor subscribes in another, and the link between them
(`services.qos.emulated_link`) has a given rate, delay or loss. Requires root, nftables and a backend for links.

- bandwidth: more is published than the link can carry. Truth: the configured rate, times the share of message bytes in
  the traffic received by the interface, which the kernel counts.
- loss: each message is one packet. Truth: packets sent by one interface minus packets received by the other, as counted
  by the kernel.
- latency: truth is the configured delay. The nodes' own latency is measured on a link without delay and subtracted.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any

from scan2sim.services.qos.counters import Counter
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.link_profile import LinkProfile
from tests.fakes.interpreters import PYTHONS
from tests.fakes.link_monitor import CLOCK_OFFSET_S, MESSAGE_BYTES, PACKET_BYTES, monitored

LINK_RATES_BPS = (1e6, 2e6, 8e6)
OVERLOAD, OVERLOAD_S = 2.0, 10.0
"""Published rate as a multiple of the link's rate, and duration of the measurement."""
LOSSES = ((LinkProfile(loss=0.01), 100.0), (LinkProfile(loss=0.05), 40.0), (LinkProfile(loss=0.05, burst=5), 40.0))
"""Link profiles and durations in seconds, with a thousand messages per second."""
DELAYS = ((0.005, False), (0.02, False), (0.1, False), (0.02, True))
"""Delays in seconds, and whether the ends act as two machines with separate clocks."""
LATENCY_S = 15.0
"""Duration of a latency measurement."""


@dataclass(frozen=True)
class Row:
    """Truth and measurement of one link, by transport.

    Attributes:
        what: bandwidth, loss or latency.
        link: description of the link.
        truth, measured: bytes per second, shares or seconds.
    """

    what: str
    transport: str
    link: str
    truth: float
    measured: float

    @property
    def error(self) -> float:
        """Relative error of the measurement."""
        return abs(self.measured / self.truth - 1)

    def line(self) -> str:
        """Row of a table."""
        truth, measured = (f"{value:.6g}" for value in (self.truth, self.measured))
        return f"{self.what:<10} {self.transport:<8} {self.link:<48} {truth:>10} {measured:>10} {self.error:>8.2%}"


def bandwidth(transport: str, rate: float) -> Row:
    """Publish more than a link's rate."""
    interval = MESSAGE_BYTES * 8 / (rate * OVERLOAD)
    with Link(LinkProfile(rate=rate)) as link, monitored(link, transport, interval) as log:
        time.sleep(2.0)
        incoming = Counter(link.far, "input", *PACKET_BYTES)
        before, began = link.far.counts().received_bytes, time.time()
        time.sleep(OVERLOAD_S)
        through, packets, ended = link.far.counts().received_bytes - before, incoming.read().packets, time.time()
    flows = [one for one in log.flows if began + one["period"] <= one["time"] <= ended]
    measured = sum(one["bandwidth"] * one["period"] for one in flows) / sum(one["period"] for one in flows)
    overload = sum(one["published messages"] for one in flows) / sum(one["messages"] for one in flows)
    actual = 8 * through / (ended - began) / 1e6
    description = f"{rate / 1e6:g} Mbit/s (actual {actual:.3f}), {overload:.1f}x published"
    return Row("bandwidth", transport, description, rate / 8 * MESSAGE_BYTES * packets / through, measured)


def loss(transport: str, profile: LinkProfile, seconds: float) -> Row:
    """Lose single packets, after discovery: before it, the monitor expects no messages."""
    with Link(LinkProfile()) as link:
        outgoing, incoming = Counter(link.near, "output", *PACKET_BYTES), Counter(link.far, "input", *PACKET_BYTES)
        with monitored(link, transport, 0.001) as log:
            before = outgoing.read().packets
            link.shape(profile)
            time.sleep(seconds)
        sent, lost = outgoing.read().packets - before, outgoing.read().packets - incoming.read().packets
    measured = sum(one["lost messages"] for one in log.flows)
    bursts = f", {profile.burst:g} in a row" if profile.burst > 1 else ""
    return Row("loss", transport, f"{profile.loss:.0%}{bursts}, of {sent} messages", lost / sent, measured / sent)


def latencies(transport: str) -> Iterator[Row]:
    """Latency for each delay, minus the nodes' own latency."""
    own = latency(transport, LinkProfile(), machines=False)
    for delay, machines in DELAYS:
        measured = latency(transport, LinkProfile(delay=delay), machines) - own
        clocks = f", two clocks {CLOCK_OFFSET_S[transport]:g} s apart" if machines else ""
        yield Row("latency", transport, f"{delay * 1e3:g} ms{clocks} (nodes: {own * 1e3:.2f} ms)", delay, measured)


def latency(transport: str, profile: LinkProfile, machines: bool) -> float:
    """Median of the reported latencies in seconds, once the clock offset is known."""
    with Link(profile) as link, monitored(link, transport, 0.005, machines) as log:
        log.wait_for(_clock_known)
        time.sleep(LATENCY_S)
    return median(one["latency (nanoseconds)"] for one in log.flows if one["messages"] and _clock_known(one)) / 1e9


def _clock_known(flow: dict[str, Any]) -> bool:
    return flow["clock offset (nanoseconds)"] is not None


def link() -> dict[str, float]:
    """Largest relative errors of all available transports."""
    worst: dict[str, float] = {}
    for row in _rows():
        print(row.line(), flush=True)
        key = f"{row.what}_error"
        worst[key] = round(max(worst.get(key, 0.0), row.error), 4)
    return worst


def _rows() -> Iterator[Row]:
    for transport, python in PYTHONS.items():
        if not python.exists():
            print(f"{transport}: skipped, {python} doesn't exist")
            continue
        for rate in LINK_RATES_BPS:
            yield bandwidth(transport, rate)
        for profile, seconds in LOSSES:
            yield loss(transport, profile, seconds)
        yield from latencies(transport)


if __name__ == "__main__":
    print("RESULT " + json.dumps(link()))
