"""Ways onto the bus for programs that only tell, and are no nodes: Kafka, a topic of ROS 2, or both."""

from __future__ import annotations

import re
from functools import cache

from scan2sim.pipeline import extras
from scan2sim.pipeline.errors import SettingError
from scan2sim.services import spools, transport
from scan2sim.services.monitoring.events import Outlet
from scan2sim.services.monitoring.sinks import Kafka

ROS = "ros2"
"""Stands among Kafka's servers for a topic of ROS 2."""
TOPIC = "bus_events"
SERVER = re.compile(r"[^\s:,]+:\d{1,5}|\[[0-9a-fA-F:.]+\]:\d{1,5}")


def check(where: str) -> None:
    """See that events can be told there from here; nothing needs to answer yet.

    Args:
        where: Kafka's servers as "host:port,host:port", and "ros2" among them or alone.

    Raises:
        SettingError: it says something else.
        UnavailableError: packages aren't installed.
    """
    places = where.split(",")
    for place in places:
        if place != ROS and not SERVER.fullmatch(place):
            raise SettingError("--bus", f"must be HOST:PORT,... or {ROS} (got {place!r:.60})", "As localhost:9092")
    if ROS in places:
        transport.load()
    if set(places) != {ROS}:
        extras.need("--bus", "confluent_kafka")


def opened(where: str) -> list[Outlet]:
    """Outlets to places as of `check`; what no broker takes, and the process leaves, the next one sends to the same."""
    places = where.split(",")
    servers = ",".join(place for place in places if place != ROS)
    found: list[Outlet] = [Kafka(servers, TOPIC, spools.opened(f"run.{servers}", TOPIC))] if servers else []
    return [*found, _ros()] if ROS in places else found


@cache
def _ros() -> Outlet:
    """A topic of ROS 2, of one hidden node a process: others need a moment to find it."""
    from scan2sim.services.monitoring.bus import Topic
    from scan2sim.services.monitoring.monitor import ros  # which loads the transport

    ros.init()
    return Topic(ros.Node("_scan2sim", hidden=True), TOPIC)
