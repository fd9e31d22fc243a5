"""Settings of programs on the bus, for code and command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.step import Params
from scan2sim.services.kafka import ClientConfig, Servers
from scan2sim.services.monitoring.settings.monitor import MonitorParams
from scan2sim.services.monitoring.settings.scaling import MAX_WORKERS, ScalingParams
from scan2sim.services.transport.names import TopicName


class BusParams(Params):
    """Topics and servers of events and records."""

    kafka_bootstrap_servers: Annotated[
        Servers | None,
        Field(description="Kafka servers in addition to ROS 2, HOST:PORT,...; retried until reachable."),
    ] = None
    kafka_config: ClientConfig = None
    records_topic: Annotated[TopicName, Field(description="ROS 2 and Kafka topic of records.")] = "monitor_data"
    events_topic: Annotated[TopicName, Field(description="ROS 2 and Kafka topic of events.")] = "bus_events"

    @classmethod
    def of_node(cls, node: MonitorParams, events_topic: str) -> BusParams:
        """Those of an instrumented node that sends and receives events, too."""
        return cls(
            kafka_bootstrap_servers=node.kafka_bootstrap_servers,
            kafka_config=node.kafka_config,
            records_topic=node.publisher_topic,
            events_topic=events_topic,
        )


class ScaleParams(BusParams, ScalingParams):
    """Settings of the autoscaler node."""

    history: Annotated[
        Path | None,
        Field(
            description="CSV file of past events, seconds from a Monday's midnight and bytes, whole days: forecast by"
            " the daily profile instead of --forecast."
        ),
    ] = None
    log_file: Annotated[Path | None, Field(description="Log file of the decisions, a line of JSON each.")] = None


class WorkerPoolParams(BusParams):
    """Settings of a node that scales workers as the autoscaler requests."""

    queue: Annotated[
        str | None, Field(description="Queue whose worker requests are applied; default: the name of what is scaled.")
    ] = None
    min_workers: Annotated[int, Field(ge=0, le=MAX_WORKERS, description="Minimum number of workers.")] = 1
    max_workers: Annotated[int, Field(ge=1, le=MAX_WORKERS, description="Maximum number of workers.")] = 5


class PoolParams(WorkerPoolParams):
    """Settings of a node that scales the workers of a Prefect work pool."""

    pool: Annotated[str, Field(description="Name of an existing Prefect work pool, such as scan2sim-process.")]


class AlarmsParams(BusParams):
    """Settings of the alarm node."""

    rules: Annotated[Path, Field(description="TOML file of alarm rules (docs/monitoring.md).")]
    state: Annotated[
        Path | None,
        Field(description="File with the raised alarms, read after a restart; default: in ~/.local/state/scan2sim."),
    ] = None


class AlarmCommandParams(Params):
    """Where a command to the alarm node goes, and from whom."""

    kafka_bootstrap_servers: Annotated[
        Servers | None, Field(description="Kafka servers of `monitor alarms`, HOST:PORT,...; default: ROS 2.")
    ] = None
    kafka_config: ClientConfig = None
    events_topic: Annotated[TopicName, Field(description="ROS 2 and Kafka topic of events.")] = "bus_events"
    by: Annotated[
        str | None, Field(min_length=1, max_length=100, description="Your name; default: your login name.")
    ] = None


RuleName = Annotated[
    str, Field(min_length=1, max_length=100, description="Name of the alarm rule, or a pattern like '*'.")
]
Subject = Annotated[
    str,
    Field(min_length=1, max_length=1000, description="Subject of the alarm as printed, or a pattern like '/camera*'."),
]


class AcknowledgeParams(AlarmCommandParams):
    """Settings of the acknowledgement of raised alarms."""

    rule: RuleName
    subject: Subject


class MuteParams(AlarmCommandParams):
    """Settings of the muting of alarms."""

    rule: RuleName
    subject: Subject
    seconds: Annotated[
        float, Field(ge=0, le=31_536_000, description="Seconds for which nobody is notified; 0 ends it.")
    ] = 3600.0


class RetireParams(AlarmCommandParams):
    """Settings of the retirement of a node."""

    node: Annotated[str, Field(min_length=1, max_length=1000, description="Full name of the node, such as /camera.")]
