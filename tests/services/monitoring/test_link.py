"""Monitored latency, losses and bandwidth match an emulated link and the kernel's counters."""

from __future__ import annotations

from statistics import median

import pytest

from scan2sim.services.qos.counters import Counter
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.link_profile import LinkProfile
from tests.fakes.interpreters import PYTHONS
from tests.fakes.link_monitor import MESSAGE_BYTES, PACKET_BYTES, monitored
from tests.services.qos.needed import need_link

DELAY_S, RATE_BPS, INTERVAL_S = 0.2, 3e5, 0.01
"""Profiles of the link, and pause between two messages: so few that they find room while a node stalls for seconds."""


@pytest.mark.realtime
@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_monitored_latency_losses_and_bandwidth_match_the_link(transport: str) -> None:
    need_link(None, "nft")
    if not PYTHONS[transport].exists():
        pytest.skip("rclpy isn't installed (.venv-ros, tests/services/ros-requirements.txt)")
    with Link(LinkProfile(delay=DELAY_S)) as link:
        left, came = (Counter(*side, *PACKET_BYTES) for side in ((link.near, "output"), (link.far, "input")))
        with monitored(link, transport, INTERVAL_S) as watch:
            link.shape(LinkProfile(delay=DELAY_S, loss=0.1))  # after discovery: losses before it aren't counted
            changed = watch.wait_for_records(4)
            link.shape(LinkProfile(rate=RATE_BPS))
            began = watch.wait_for_records(3)
            packets, through = came.read().packets, link.far.counts().received_bytes
            ended = watch.wait_for_records(7)
            packets, through = came.read().packets - packets, link.far.counts().received_bytes - through
        lost = left.read().packets - came.read().packets
    latencies = [
        flow["latency (nanoseconds)"] / 1e9 for flow in watch.flows if flow["messages"] and flow["time"] <= changed
    ]
    assert min(latencies) == pytest.approx(DELAY_S, rel=0.05)  # others may include stalls of the nodes
    assert sum(flow["lost messages"] for flow in watch.flows) == pytest.approx(lost, rel=0.02)
    narrow = [flow for flow in watch.flows if began < flow["time"] <= ended]
    share = packets * MESSAGE_BYTES / through
    assert median(flow["bandwidth"] for flow in narrow) == pytest.approx(RATE_BPS / 8 * share, rel=0.05)
    received = sum(flow["messages"] for flow in narrow)
    assert sum(flow["published messages"] for flow in narrow) > 2 * received > 0  # both rates are reported
