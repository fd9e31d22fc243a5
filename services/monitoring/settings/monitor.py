"""How a node is watched: a monitor's settings, in its constructor as on the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from scan2sim.pipeline.core.step import Params
from scan2sim.services.kafka import Servers
from scan2sim.services.monitoring.settings.limits import Limit, Limits
from scan2sim.services.transport.names import TopicName

WhenFull = Literal["newest", "oldest"]
LARGEST = 16 * 2**20
"""Bytes of a message of the test nodes, at most."""


class Watched(Params):
    """The names are D3.2's (code snippet 3), as far as it has them."""

    period: Annotated[float, Field(ge=0.01, le=3600, description="Seconds between records.")] = 1.0
    window_size: Annotated[int, Field(ge=1, le=1_000_000, description="Latencies that go into a record, at most.")] = (
        100
    )
    kafka_bootstrap_servers: Annotated[
        Servers | None, Field(description="Kafka for the records, as host:port,host:port; it need not be there yet.")
    ] = None
    publisher_topic: Annotated[TopicName, Field(description="Topic of ROS 2 and of Kafka for the records.")] = (
        "monitor_data"
    )
    log_file: Annotated[Path | None, Field(description="File for the records, a line each.")] = None
    console: Annotated[bool, Field(description="Write records to standard error, too.")] = False
    prometheus_port: Annotated[
        int | None, Field(ge=0, le=65535, description="Port where the last figures are shown to Prometheus.")
    ] = None
    spool: Annotated[
        Path | None, Field(description="File for records that wait for Kafka; default: in the user's state folder.")
    ] = None
    limit: Limit = Limits()

    def monitored(self) -> dict[str, Any]:
        """What a monitor's constructor takes of it."""
        return {name: getattr(self, name) for name in Watched.model_fields}


Topic = Annotated[TopicName, Field(description="Its name, as /camera/image.")]
NodeName = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,254}$",
        description="The node's name: each of several has its own.",
        json_schema_extra={"range": "letters, digits and underscores"},
    ),
]


class TopicParams(Watched):
    """Of a node that watches topics from outside."""

    topics: Annotated[list[TopicName], Field(min_length=1, description="Their names, as /camera/image.")]
    type: Annotated[str | None, Field(description="Of their messages; default: as publishers say.")] = None
    timeout: Annotated[float, Field(ge=0.1, le=86_400, description="Seconds to wait for a publisher.")] = 60.0
    depth: Annotated[
        int, Field(ge=1, le=100_000, description="Messages of a topic that may wait to be counted; then the oldest go.")
    ] = 100
    best_effort: Annotated[
        bool, Field(description="Ask for no lost message again: watching never slows who publishes.")
    ] = False


class TalkerParams(Watched):
    """Of a node that sends messages of a size at an interval."""

    topic: Topic
    name: NodeName = "talker"
    size: Annotated[int, Field(ge=0, le=LARGEST, description="Characters of a message.")] = 1000
    interval: Annotated[float, Field(ge=0.0001, le=3600, description="Seconds between messages.")] = 1.0


class DatasetParams(Watched):
    """Of a node that sends messages when, and as large as, a file says."""

    topic: Topic
    name: NodeName = "dataset_talker"
    data: Annotated[Path, Field(description="CSV: seconds from the start, bytes.")]
    speed: Annotated[float, Field(ge=0.001, le=10_000, description="So many times as fast as the file says.")] = 1.0
    subscribers: Annotated[int, Field(ge=0, le=1000, description="Subscriptions to wait for before it begins.")] = 0
    size_as_field: Annotated[bool, Field(description="Send sizes as JSON, not so many bytes.")] = False


class ListenerParams(Watched):
    """Of a node that listens."""

    topic: Topic


class WorkParams(Watched):
    """Of a node that has events worked on."""

    topic: Topic
    command: Annotated[
        str, Field(description="Worker: a program that reads a line of JSON an event, and answers it with a line.")
    ]
    max_workers: Annotated[int, Field(ge=1, le=1000, description="Workers that it starts, at most.")] = 5
    deadline: Annotated[
        float, Field(ge=0.01, le=86_400, description="Seconds for an event; then its worker is killed.")
    ] = 60.0
    with_text: Annotated[bool, Field(description="Tell workers messages' text as well as their size.")] = False
    queue_length: Annotated[int, Field(ge=1, le=10_000_000, description="Events that wait, at most.")] = 100_000
    when_full: Annotated[
        WhenFull, Field(description="Which event is refused when as many wait: the newest, or the oldest.")
    ] = "newest"
    events_topic: Annotated[TopicName, Field(description="Topic of ROS 2 and of Kafka with events.")] = "bus_events"
