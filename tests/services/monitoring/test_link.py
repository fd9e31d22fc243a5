"""Monitored latency, losses and bandwidth match an emulated link and the kernel's counters."""

from __future__ import annotations

import time
from statistics import median

import pytest

from scan2sim.services.qos.counters import Counter
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.link_profile import LinkProfile
from tests.fakes.interpreters import PYTHONS
from tests.fakes.link_monitor import MESSAGE_BYTES, PACKET_BYTES, monitored
from tests.services.qos.needed import need_link


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_monitored_latency_losses_and_bandwidth_match_the_link(transport: str) -> None:
    need_link(None, "nft")
    if not PYTHONS[transport].exists():
        pytest.skip("rclpy isn't installed (.venv-ros, tests/services/ros-requirements.txt)")
    delay, rate = 0.05, 1e6
    with Link(LinkProfile(delay=delay)) as link:
        left, came = (Counter(*side, *PACKET_BYTES) for side in ((link.near, "output"), (link.far, "input")))
        with monitored(link, transport, 0.002) as watch:
            link.shape(LinkProfile(delay=delay, loss=0.1))  # after discovery: losses before it aren't counted
            time.sleep(1.5)
            changed = time.time()
            link.shape(LinkProfile(rate=rate))
            time.sleep(1.0)
            packets, through = came.read().packets, link.far.counts().received_bytes
            time.sleep(2.5)
            packets, through = came.read().packets - packets, link.far.counts().received_bytes - through
            ended = time.time()
        lost = left.read().packets - came.read().packets
    late = [flow["latency (nanoseconds)"] for flow in watch.flows if flow["messages"] and flow["time"] < changed]
    assert median(late) / 1e9 == pytest.approx(delay, rel=0.05)
    assert sum(flow["lost messages"] for flow in watch.flows) == pytest.approx(lost, rel=0.02)
    narrow = [flow for flow in watch.flows if changed + 2 < flow["time"] < ended]
    share = packets * MESSAGE_BYTES / through
    assert median(flow["bandwidth"] for flow in narrow) == pytest.approx(rate / 8 * share, rel=0.05)
    assert all(flow["published messages"] > 2 * flow["messages"] > 0 for flow in narrow)  # both rates are reported
