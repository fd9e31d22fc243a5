"""Ways onto the bus for programs that only tell, and are no nodes: Kafka, a topic of ROS 2, or both."""

from __future__ import annotations

from functools import cache

from pydantic import TypeAdapter, ValidationError

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services import default_outbox, transport
from scan2sim.services.kafka import Servers
from scan2sim.services.monitoring.events.schema import Outlet
from scan2sim.services.monitoring.export.sinks import Kafka

ROS = "ros2"
"""Stands among Kafka's servers for a topic of ROS 2."""
TOPIC = "bus_events"


def check(where: str) -> None:
    """See that events can be told there from here; nothing needs to answer yet.

    Args:
        where: Kafka's servers as "host:port,host:port", and "ros2" among them or alone.

    Raises:
        SettingError: it says something else.
        UnavailableError: packages aren't installed.
    """
    servers = _servers(where)
    try:
        if where != ROS:
            TypeAdapter(Servers).validate_python(servers)
    except ValidationError:
        cause = f"must be HOST:PORT, {ROS}, or several of them parted by commas (got {where!r:.60})"
        raise SettingError("--bus", cause, "As localhost:9092") from None
    if ROS in where.split(","):
        transport.load()
    if servers:
        optional_deps.need("--bus", "confluent_kafka")


def opened(where: str) -> list[Outlet]:
    """Outlets to places as of `check`; what no broker takes, and the process leaves, the next one sends to the same."""
    servers = _servers(where)
    found: list[Outlet] = [Kafka(servers, TOPIC, default_outbox.opened(f"run.{servers}", TOPIC))] if servers else []
    return [*found, _ros()] if ROS in where.split(",") else found


def _servers(where: str) -> str:
    """Kafka's among the places; "" where there are none."""
    return ",".join(place for place in where.split(",") if place != ROS)


@cache
def _ros() -> Outlet:
    """A topic of ROS 2, of one hidden node a process: others need a moment to find it."""
    from scan2sim.services.monitoring.events.bus import Topic
    from scan2sim.services.monitoring.node.monitor import ros  # which loads the transport

    ros.init()
    return Topic(ros.Node("_scan2sim", hidden=True), TOPIC)
