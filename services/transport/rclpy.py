"""Transport over rclpy, ROS 2's Python client library, with any RMW implementation.

DDS sends every message with a header that has all that monitoring needs: the publisher's GID, a sequence number and
the source timestamp (DDSI-RTPS 2.5, sections 8.3.8.2 and 8.3.8.9), so messages are sent unchanged.
"""

from __future__ import annotations

import array
import importlib
import time
from collections.abc import Callable
from typing import Any

import rclpy
import rclpy.node
from rclpy.duration import Duration, Infinite
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.publisher import Publisher as RosPublisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.signals import SignalHandlerOptions

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.transport.cdr import serialized_size
from scan2sim.services.transport.names import checked_type
from scan2sim.services.transport.types import INFINITE, Arrival, Endpoint, Kind, QoS

BYTES = "sequence<uint8>"
"""Type of fields with the content of images."""


class _Publisher(RosPublisher):  # type: ignore[misc]
    """Publisher that reports each message to its node."""

    node: Node

    def publish(self, msg: Any) -> None:
        """Publish a message and report it."""
        super().publish(msg)
        self.node.published(self.topic_name, len(msg) if isinstance(msg, bytes) else serialized_size(msg))

    def wait_for_all_acked(self, timeout_sec: float) -> bool:
        """Whether all matched reliable subscriptions have acknowledged all messages within `timeout_sec`."""
        return bool(super().wait_for_all_acked(Duration(seconds=timeout_sec)))


class Node(rclpy.node.Node):  # type: ignore[misc]
    """An rclpy node that reports every message (`services.transport.Node`)."""

    def __init__(self, node_name: str, *, namespace: str = "/", hidden: bool = False, **others: Any) -> None:
        if hidden:
            others |= {"start_parameter_services": False, "enable_rosout": False}
        super().__init__(node_name, namespace=namespace, **others)
        self.own_executor: Any = None

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **others: Any) -> Any:
        """Like rclpy's `create_publisher`; the profile may be a `QoS`."""
        profile = _profile(qos_profile)
        publisher = super().create_publisher(msg_type, topic, profile, publisher_class=_Publisher, **others)
        publisher.node = self
        return publisher

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: Any, **others: Any
    ) -> Any:
        """Like rclpy's `create_subscription`; the profile may be a `QoS`."""
        full = self.resolve_topic_name(topic)

        def on_message(message: Any, info: Any) -> None:
            self.received(_arrival(full, message, info))
            callback(message)

        return super().create_subscription(msg_type, topic, on_message, _profile(qos_profile), **others)

    def endpoints(self, topic: str) -> tuple[Endpoint, ...]:
        """Discovered publishers and subscriptions of a topic."""
        return tuple(
            [_endpoint(info, "PUBLISHER") for info in self.get_publishers_info_by_topic(topic)]
            + [_endpoint(info, "SUBSCRIPTION") for info in self.get_subscriptions_info_by_topic(topic)]
        )

    def topics(self) -> dict[str, tuple[str, ...]]:
        """Discovered topics and the names of their types."""
        return {name: tuple(kinds) for name, kinds in self.get_topic_names_and_types()}

    def raw_type(self, topic: str, type_name: str) -> Any:
        """Message type for a raw subscription; rclpy needs its definition.

        Raises:
            SettingError: its package isn't installed.
        """
        try:
            return message_type(type_name)
        except SettingError as error:
            remedy = f"{error.remedy}, or monitor the topic without its definition: SCAN2SIM_TRANSPORT=cyclone"
            raise SettingError(error.where, error.cause, remedy) from None

    def destroy_node(self) -> Any:
        """Destroy the node and its executor."""
        if self.own_executor is not None:
            self.own_executor.shutdown()
        return super().destroy_node()

    def published(self, topic: str, size: int) -> None:
        """Hook: a message was published."""

    def received(self, arrival: Arrival) -> None:
        """Hook: a message was received."""

    def unreadable(self, topic: str) -> None:
        """Never called: rclpy passes malformed messages on with empty fields."""


def init(domain: int | None = None) -> None:
    """Initialize rclpy without its signal handlers, which would end nodes before they publish their last record."""
    if not rclpy.ok():
        rclpy.init(domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)


def message_type(name: str) -> Any:
    """Message class by its name.

    Raises:
        SettingError: its package isn't installed.
    """
    package, kind, leaf = checked_type(name).split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), leaf)
    except (ImportError, AttributeError) as error:
        raise SettingError(
            f"type {name}", f"its definition is unknown ({error})", "Source the workspace that defines it"
        ) from None


def message(name: str, **fields: Any) -> Any:
    """Create a message with the given fields."""
    kind = message_type(name)
    kinds = kind.get_fields_and_field_types()
    return kind(**{field: _bytes(value) if kinds.get(field) == BYTES else value for field, value in fields.items()})


def _bytes(value: Any) -> array.array[int]:
    """Array of a field of type `BYTES`: rclpy copies arrays at once, and other sequences value by value."""
    return value if isinstance(value, array.array) else array.array("B", bytes(value))


def type_name(msg_type: Any) -> str:
    """Name of a message class."""
    package, kind = msg_type.__module__.split(".")[:2]
    return f"{package}/{kind}/{msg_type.__name__}"


def spin_once(node: Node, timeout_sec: float) -> None:
    """Process messages and timers of a node, waiting up to `timeout_sec`; each node has its own executor."""
    if node.own_executor is None:
        node.own_executor = SingleThreadedExecutor()
        node.own_executor.add_node(node)
    try:
        node.own_executor.spin_once(timeout_sec=timeout_sec)
    except ExternalShutdownException:
        raise KeyboardInterrupt from None


def shutdown() -> None:
    """Shut rclpy down."""
    rclpy.try_shutdown()


def _arrival(topic: str, message: Any, info: Any) -> Arrival:
    gid = info.get("publisher_gid")
    return Arrival(
        topic=topic,
        size=len(message) if isinstance(message, bytes) else serialized_size(message),
        received=time.time_ns(),
        sent=info["source_timestamp"] or None,
        publisher=gid["data"] if gid else None,
        number=info.get("publication_sequence_number"),
    )


def _endpoint(info: Any, kind: Kind) -> Endpoint:
    return Endpoint(
        node_name=info.node_name,
        node_namespace=info.node_namespace,
        type_name=info.topic_type,
        kind=kind,
        gid=bytes(info.endpoint_gid),
        qos=_qos(info.qos_profile),
    )


def _profile(qos: Any) -> Any:
    """Convert a `QoS` to rclpy's profile; rclpy's own profiles and depths are unchanged."""
    if not isinstance(qos, QoS):
        return qos
    return QoSProfile(
        reliability=ReliabilityPolicy[qos.reliability],
        durability=DurabilityPolicy[qos.durability],
        history=HistoryPolicy.KEEP_LAST if qos.depth else HistoryPolicy.KEEP_ALL,
        depth=qos.depth,
        lifespan=_duration(qos.lifespan),
        deadline=_duration(qos.deadline),
        liveliness=LivelinessPolicy[qos.liveliness],
        liveliness_lease_duration=_duration(qos.lease),
    )


def _duration(nanoseconds: int) -> Any:
    return Infinite if nanoseconds == INFINITE else Duration(nanoseconds=nanoseconds)


def _qos(info: Any) -> QoS:
    return QoS(
        reliability=info.reliability.name,
        durability=info.durability.name,
        depth=info.depth,
        lifespan=info.lifespan.nanoseconds,
        deadline=info.deadline.nanoseconds,
        liveliness=info.liveliness.name,
        lease=info.liveliness_lease_duration.nanoseconds,
    )
