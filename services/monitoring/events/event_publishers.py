"""Outlets for programs that publish events without being nodes: Kafka, a ROS 2 topic, or both (`--bus`)."""

from __future__ import annotations

from functools import cache

from pydantic import TypeAdapter, ValidationError

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services import default_outbox, transport
from scan2sim.services.kafka import Cluster, Servers
from scan2sim.services.monitoring.events.schema import Outlet
from scan2sim.services.monitoring.export.sinks import KafkaSink

ROS = "ros2"
"""Entry in the list of Kafka servers that selects the ROS 2 topic."""
TOPIC = "bus_events"


def check_address(where: str) -> None:
    """Check that events can be published to an address; the brokers need not be reachable yet.

    Args:
        where: Kafka servers as "host:port,host:port", with "ros2" among them or alone.

    Raises:
        SettingError: the address is malformed.
        InputError: the file that SCAN2SIM_KAFKA_CONFIG names is invalid.
        UnavailableError: a required package isn't installed.
    """
    servers = _servers(where)
    try:
        if where != ROS:
            TypeAdapter(Servers).validate_python(servers)
    except ValidationError:
        cause = f"must be HOST:PORT, {ROS}, or several separated by commas (got {where!r:.60})"
        raise SettingError("--bus", cause, "For example localhost:9092") from None
    if ROS in where.split(","):
        transport.load()
    if servers:
        optional_deps.require("--bus", "confluent_kafka")
        Cluster.read(servers, None)


def open_outlets(where: str) -> list[Outlet]:
    """Open the outlets of an address (`check_address`); unsent events are sent by the next process that opens it."""
    servers = _servers(where)
    outlets: list[Outlet] = []
    if servers:
        outlets.append(
            KafkaSink(Cluster.read(servers, None), TOPIC, default_outbox.open_outbox(f"run.{servers}", TOPIC))
        )
    if ROS in where.split(","):
        outlets.append(_ros_outlet())
    return outlets


def _servers(where: str) -> str:
    """The Kafka servers of an address; "" without any."""
    return ",".join(place for place in where.split(",") if place != ROS)


@cache
def _ros_outlet() -> Outlet:
    """Outlet to the ROS 2 topic through one hidden node per process, as discovery by other nodes takes a moment."""
    from scan2sim.services.monitoring.events.bus import RosOutlet
    from scan2sim.services.monitoring.node.monitor import ros  # which loads the transport

    ros.init()
    return RosOutlet(ros.Node("_scan2sim", hidden=True), TOPIC)
