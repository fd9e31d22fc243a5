"""How programs join the bus: their settings, in code as on the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.step import Params
from scan2sim.services.kafka import Servers
from scan2sim.services.monitoring.autoscale.policy import MOST, ScalingParams
from scan2sim.services.transport.names import TopicName


class BusParams(Params):
    """Where events and records go and come from."""

    kafka_bootstrap_servers: Annotated[
        Servers | None, Field(description="Kafka beside ROS 2, as host:port,host:port; it need not be there yet.")
    ] = None
    records_topic: Annotated[TopicName, Field(description="Topic of ROS 2 and of Kafka with records.")] = "monitor_data"
    events_topic: Annotated[TopicName, Field(description="Topic of ROS 2 and of Kafka with events.")] = "bus_events"


class ScaleParams(BusParams, ScalingParams):
    """Of a node that asks for workers."""

    history: Annotated[
        Path | None,
        Field(
            description="CSV of whole days, seconds from a Monday's midnight: forecast as on other days at that hour."
        ),
    ] = None
    log_file: Annotated[Path | None, Field(description="File for what was decided, a line of JSON each time.")] = None


class FollowedParams(BusParams):
    """Of a node that starts and stops workers."""

    queue: Annotated[
        str | None, Field(description="Queue whose events are followed; default: called as what is scaled.")
    ] = None
    min_workers: Annotated[int, Field(ge=0, le=MOST, description="Workers, at least.")] = 1
    max_workers: Annotated[int, Field(ge=1, le=MOST, description="Workers, at most.")] = 5


class PoolParams(FollowedParams):
    """Of a node that starts and stops workers of a Prefect pool."""

    pool: Annotated[str, Field(description="Its name, as scan2sim-process; it must be there.")]


class AlarmsParams(BusParams):
    """Of a node that sends alarms."""

    rules: Annotated[Path, Field(description="TOML file of rules (docs/event-bus.md).")]
