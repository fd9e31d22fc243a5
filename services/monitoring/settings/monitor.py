"""Settings of instrumented nodes, for their constructors and the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from scan2sim.pipeline.core.step import Params
from scan2sim.services.kafka import ClientConfig, Servers
from scan2sim.services.monitoring.settings.limits import Limit, Limits
from scan2sim.services.transport.names import TopicName

WhenFull = Literal["newest", "oldest"]
MAX_MESSAGE_BYTES = 16 * 2**20
"""Largest message of the example nodes."""


class MonitorParams(Params):
    """Settings of a monitor, named as in D3.2 (code snippet 3) where it has them."""

    period: Annotated[float, Field(ge=0.01, le=3600, description="Seconds between two records.")] = 1.0
    window_size: Annotated[
        int, Field(ge=1, le=1_000_000, description="Number of latest messages per topic whose latency is averaged.")
    ] = 100
    kafka_bootstrap_servers: Annotated[
        Servers | None,
        Field(description="Kafka servers to send the records to, HOST:PORT,...; retried until reachable."),
    ] = None
    kafka_config: ClientConfig = None
    publisher_topic: Annotated[TopicName, Field(description="ROS 2 and Kafka topic of the records.")] = "monitor_data"
    log_file: Annotated[Path | None, Field(description="Log file of the records, a line of JSON each.")] = None
    console: Annotated[bool, Field(description="Also write the records to standard error.")] = False
    prometheus_port: Annotated[
        int | None, Field(ge=0, le=65535, description="Port on 127.0.0.1 that serves the metrics for Prometheus.")
    ] = None
    outbox: Annotated[
        Path | None,
        Field(description="Outbox file for records not yet sent to Kafka; default: in the user's state folder."),
    ] = None
    limit: Limit = Limits()

    def monitor_settings(self) -> dict[str, Any]:
        """Arguments of the constructor of `Monitor`."""
        return {name: getattr(self, name) for name in MonitorParams.model_fields}


Topic = Annotated[TopicName, Field(description="Name of the topic, such as /camera/image.")]
NodeName = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,254}$",
        description="Name of the node; must be unique if several run.",
        json_schema_extra={"range": "letters, digits and underscores"},
    ),
]


class TopicParams(MonitorParams):
    """Settings of a node that monitors topics of other nodes."""

    topics: Annotated[list[TopicName], Field(min_length=1, description="Names of the topics, such as /camera/image.")]
    type: Annotated[
        str | None, Field(description="Message type, such as std_msgs/msg/String; default: discovered from publishers.")
    ] = None
    timeout: Annotated[
        float, Field(ge=0.1, le=86_400, description="Seconds to wait for the first publisher before giving up.")
    ] = 60.0
    depth: Annotated[
        int,
        Field(ge=1, le=100_000, description="QoS history depth: messages per topic that are queued before counting."),
    ] = 100
    best_effort: Annotated[
        bool,
        Field(description="Subscribe with best-effort reliability, which never slows down a publisher."),
    ] = False


class TalkerParams(MonitorParams):
    """Settings of the talker."""

    topic: Topic
    name: NodeName = "talker"
    size: Annotated[int, Field(ge=0, le=MAX_MESSAGE_BYTES, description="Characters per message.")] = 1000
    interval: Annotated[float, Field(ge=0.0001, le=3600, description="Seconds between two messages.")] = 1.0


class DatasetParams(MonitorParams):
    """Settings of the dataset talker."""

    topic: Topic
    name: NodeName = "dataset_talker"
    data: Annotated[Path, Field(description="CSV file with a line per message: seconds from the start, bytes.")]
    speed: Annotated[
        float, Field(ge=0.001, le=10_000, description="Playback speed: factor by which the times are shortened.")
    ] = 1.0
    subscribers: Annotated[int, Field(ge=0, le=1000, description="Start when there are this many subscribers.")] = 0
    size_as_field: Annotated[
        bool, Field(description="Send the size as a JSON field instead of a message of that size.")
    ] = False


class ListenerParams(MonitorParams):
    """Settings of the listener."""

    topic: Topic


class WorkParams(MonitorParams):
    """Settings of a node that queues a topic's messages for worker processes."""

    topic: Topic
    command: Annotated[
        str,
        Field(description="Worker program: reads a line of JSON per event and replies with a line when it is done."),
    ]
    max_workers: Annotated[int, Field(ge=1, le=1000, description="Maximum number of worker processes.")] = 5
    deadline: Annotated[
        float, Field(ge=0.01, le=86_400, description="Seconds per event; a worker that takes longer is killed.")
    ] = 60.0
    with_text: Annotated[
        bool, Field(description="Pass the text of the messages to the workers as well as their size.")
    ] = False
    queue_length: Annotated[int, Field(ge=1, le=10_000_000, description="Maximum number of waiting events.")] = 100_000
    when_full: Annotated[
        WhenFull, Field(description="Which event is dropped when the queue is full: the newest or the oldest.")
    ] = "newest"
    events_topic: Annotated[TopicName, Field(description="ROS 2 and Kafka topic of events.")] = "bus_events"
