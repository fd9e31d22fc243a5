"""Record: the statistics that a monitor publishes once per period, with the field names of D3.2's code snippet 4.

`Record` defines the schema: `python -m scan2sim.services.monitoring.record` prints it as JSON Schema.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from scan2sim.services.monitoring.meter import Flow, Reading
from scan2sim.services.transport.types import Endpoint

SCHEMA = "scan2sim-monitor-1"
"""Schema identifier; changes whenever a field does."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class Profile(_Model):
    """QoS profile; durations in nanoseconds, 9223372036854775807 for infinite."""

    reliability: str
    durability: str
    lifespan: int = Field(alias="lifespan (nanoseconds)")
    deadline: int = Field(alias="deadline (nanoseconds)")
    liveliness: str
    lease: int = Field(alias="liveliness lease duration (nanoseconds)")


class EndpointInfo(_Model):
    """A publisher or a subscription; `GID` as numbers from 0 to 255."""

    node_name: str = Field(alias="node name")
    node_namespace: str = Field(alias="node namespace")
    topic_type: str = Field(alias="topic type")
    endpoint_type: Literal["PUBLISHER", "SUBSCRIPTION"] = Field(alias="endpoint type")
    gid: list[int] = Field(alias="GID")
    qos: Profile = Field(alias="QoS profile")


class TopicEndpoints(_Model):
    """Publishers and subscriptions of a topic."""

    topic_name: str = Field(alias="topic name")
    publishers: list[EndpointInfo] = Field(alias="publishers_info_by_topic")
    subscriptions: list[EndpointInfo] = Field(alias="subscriptions_info_by_topic")


class TopicFlow(_Model):
    """One direction of one topic over the period.

    Attributes:
        bandwidth: bytes per second.
        sent: messages published in the period by their sequence numbers; more than received if the subscriber is slow.
        latency: nanoseconds, mean over the window, corrected for the clock offset; `latency_p95` likewise.
        clock_offset: offset of the sender's clock, nanoseconds; positive: ahead; None: unknown, not instrumented.
        clock_uncertainty: uncertainty of the offset, nanoseconds.
        unreadable: received messages that could not be deserialized; always 0 with rclpy, which doesn't report them.
    """

    topic: str
    direction: Literal["incoming", "outgoing"]
    type: str
    bandwidth: float
    messages: int
    size: float = Field(alias="message size mean")
    sent: int | None = Field(None, alias="published messages")
    lost: int | None = Field(None, alias="lost messages")
    latency: int | None = Field(None, alias="latency (nanoseconds)")
    latency_p95: int | None = Field(None, alias="latency p95 (nanoseconds)")
    clock_offset: int | None = Field(None, alias="clock offset (nanoseconds)")
    clock_uncertainty: int | None = Field(None, alias="clock uncertainty (nanoseconds)")
    unreadable: int = Field(0, alias="unreadable messages")


class Record(_Model):
    """Traffic and load of a node over a period.

    Attributes:
        id: unique id NODE_ID:NUMBER; two records with the same id are duplicates.
        time: end of the period, seconds since the epoch.
        period: its length, seconds.
        node_id: unique for each start of the node.
        bandwidth: bytes per second, in and out; likewise `messages` and `size` (bytes).
        lost: None if no publisher numbers its messages.
        latency: mean over all received messages (of the window); None if no message has a source timestamp.
        clock_synchronised: whether NTP synchronises this machine's clock according to its kernel; None: unknown.
        warnings: warnings for the user, such as incompatible QoS profiles or exceeded limits.
        dropped: records and events dropped so far because the outbox was full.
        dropped_by: the same for records and for each kind of events.
    """

    schema_name: str = Field(SCHEMA, alias="schema")
    id: str = Field(alias="record id")
    time: float
    period: float
    node_name: str = Field(alias="node name")
    node_namespace: str = Field(alias="node namespace")
    node_id: str = Field(alias="node id")
    bandwidth: float
    messages: int
    size: float = Field(alias="message size mean")
    out_bandwidth: float = Field(alias="outgoing bandwidth")
    out_messages: int = Field(alias="outgoing messages")
    out_size: float = Field(alias="outgoing message size mean")
    in_bandwidth: float = Field(alias="incoming bandwidth")
    in_messages: int = Field(alias="incoming messages")
    in_size: float = Field(alias="incoming message size mean")
    latency: int | None = Field(alias="latency (nanoseconds)")
    latency_p95: int | None = Field(alias="latency p95 (nanoseconds)")
    clock_synchronised: bool | None = Field(None, alias="clock synchronised")
    lost: int | None = Field(alias="lost messages")
    publishers: int
    subscribers: int
    topics: list[str]
    flows: list[TopicFlow]
    hostname: str
    local_ip: str = Field(alias="local ip")
    local_ips: list[str] = Field(alias="local ips")
    endpoints: list[TopicEndpoints] = Field(alias="topics endpoint info")
    cpu_times: dict[str, float] = Field(alias="cpu times")
    cpu_percent: float = Field(alias="cpu percent")
    virtual_memory: dict[str, float] = Field(alias="virtual memory")
    disk_usage: list[float] = Field(alias="disk usage")
    warnings: list[str] = []
    dropped: int = Field(0, alias="dropped records")
    dropped_by: dict[str, int] = Field({}, alias="dropped by kind")

    @staticmethod
    def host_fields(read: Mapping[str, Any]) -> dict[str, Any]:
        """Host metrics (`host.HostMetrics.read`) by the field names of this class."""
        return {name.replace(" ", "_"): value for name, value in read.items()}

    @property
    def category(self) -> str:
        """Category in an outbox (`outbox.Outbox`)."""
        return "records"

    def json_line(self) -> str:
        """Serialize as one line of JSON."""
        return self.model_dump_json(by_alias=True)


def topic_flows(reading: Reading, types: Mapping[str, str], period: float) -> list[TopicFlow]:
    """Flows of a reading; `types` are the topics' type names, `period` is in seconds."""
    out = [
        TopicFlow(
            topic=topic,
            direction="outgoing",
            type=types.get(topic, ""),
            bandwidth=flow.size / period,
            messages=flow.messages,
            size=flow.mean(),
        )
        for topic, flow in reading.outgoing.items()
    ]
    incoming = [
        TopicFlow(
            topic=topic,
            direction="incoming",
            type=types.get(topic, ""),
            bandwidth=found.flow.size / period,
            messages=found.flow.messages,
            size=found.flow.mean(),
            sent=found.sent,
            lost=found.lost,
            latency=mean(found.latencies),
            latency_p95=p95(found.latencies),
            clock_offset=found.clock[0] if found.clock else None,
            clock_uncertainty=found.clock[1] if found.clock else None,
            unreadable=found.unreadable,
        )
        for topic, found in reading.incoming.items()
    ]
    return out + incoming


def totals(reading: Reading, period: float) -> dict[str, Any]:
    """Fields of a record that are totals over all topics."""
    out = _total(reading.outgoing.values())
    incoming = _total(found.flow for found in reading.incoming.values())
    both = Flow(out.messages + incoming.messages, out.size + incoming.size)
    latencies = [one for found in reading.incoming.values() for one in found.latencies]
    lost = [found.lost for found in reading.incoming.values() if found.lost is not None]
    return {
        "bandwidth": both.size / period,
        "messages": both.messages,
        "size": both.mean(),
        "out_bandwidth": out.size / period,
        "out_messages": out.messages,
        "out_size": out.mean(),
        "in_bandwidth": incoming.size / period,
        "in_messages": incoming.messages,
        "in_size": incoming.mean(),
        "latency": mean(latencies),
        "latency_p95": p95(latencies),
        "lost": sum(lost) if lost else None,
    }


def endpoint_info(endpoint: Endpoint) -> EndpointInfo:
    """Convert an endpoint to its form in a record."""
    qos = endpoint.qos
    return EndpointInfo(
        node_name=endpoint.node_name,
        node_namespace=endpoint.node_namespace,
        topic_type=endpoint.type_name,
        endpoint_type=endpoint.kind,
        gid=list(endpoint.gid),
        qos=Profile(
            reliability=qos.reliability,
            durability=qos.durability,
            lifespan=qos.lifespan,
            deadline=qos.deadline,
            liveliness=qos.liveliness,
            lease=qos.lease,
        ),
    )


def mean(values: Any) -> int | None:
    """Rounded mean of values in nanoseconds; None without values."""
    return round(sum(values) / len(values)) if values else None


def p95(values: Any) -> int | None:
    """95th percentile; None without values."""
    return sorted(values)[min(len(values) - 1, int(0.95 * len(values)))] if values else None


def _total(flows: Any) -> Flow:
    found = list(flows)
    return Flow(sum(flow.messages for flow in found), sum(flow.size for flow in found))


if __name__ == "__main__":
    print(json.dumps(Record.model_json_schema(by_alias=True), indent=2))
