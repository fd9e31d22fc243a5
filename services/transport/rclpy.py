"""The transport over rclpy: ROS 2's own library, whatever middleware it is set to.

DDS wraps every message in a header of its own that holds what monitoring needs: the publisher's GID, a number and the
time of sending (DDSI-RTPS 2.5, sections 8.3.8.2 and 8.3.8.9), so messages go out as they are, at no cost.
"""

from __future__ import annotations

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
from scan2sim.services.transport.cdr import size
from scan2sim.services.transport.names import checked_type
from scan2sim.services.transport.types import INFINITE, Arrival, Endpoint, Kind, QoS


class _Publisher(RosPublisher):  # type: ignore[misc]
    """Reports to its node what it sends."""

    node: Node

    def publish(self, msg: Any) -> None:
        """Send, and report it."""
        super().publish(msg)
        self.node.published(self.topic_name, len(msg) if isinstance(msg, bytes) else size(msg))


class Node(rclpy.node.Node):  # type: ignore[misc]
    """A node of rclpy that reports every message (`services.transport.Node`)."""

    def __init__(self, node_name: str, *, namespace: str = "/", hidden: bool = False, **others: Any) -> None:
        if hidden:
            others |= {"start_parameter_services": False, "enable_rosout": False}
        super().__init__(node_name, namespace=namespace, **others)
        self.own_executor: Any = None

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **others: Any) -> Any:
        """As rclpy's; the profile may be ours."""
        made = super().create_publisher(msg_type, topic, _profile(qos_profile), publisher_class=_Publisher, **others)
        made.node = self
        return made

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: Any, **others: Any
    ) -> Any:
        """As rclpy's; the profile may be ours."""
        full = self.resolve_topic_name(topic)

        def taken(message: Any, info: Any) -> None:
            self.received(_arrival(full, message, info))
            callback(message)

        return super().create_subscription(msg_type, topic, taken, _profile(qos_profile), **others)

    def endpoints(self, topic: str) -> tuple[Endpoint, ...]:
        """Publishers and subscriptions of a topic, as rclpy lists them."""
        return tuple(
            [_endpoint(info, "PUBLISHER") for info in self.get_publishers_info_by_topic(topic)]
            + [_endpoint(info, "SUBSCRIPTION") for info in self.get_subscriptions_info_by_topic(topic)]
        )

    def topics(self) -> dict[str, tuple[str, ...]]:
        """Topics and the names of their types."""
        return {name: tuple(kinds) for name, kinds in self.get_topic_names_and_types()}

    def raw_type(self, topic: str, type_name: str) -> Any:
        """Of a topic; rclpy needs its definition.

        Raises:
            SettingError: its package isn't installed.
        """
        try:
            return message_type(type_name)
        except SettingError as error:
            remedy = f"{error.remedy}, or watch without it: SCAN2SIM_TRANSPORT=cyclone"
            raise SettingError(error.where, error.cause, remedy) from None

    def destroy_node(self) -> Any:
        """As rclpy's; what spun it ends with it."""
        if self.own_executor is not None:
            self.own_executor.shutdown()
        return super().destroy_node()

    def published(self, topic: str, size: int) -> None:
        """To be overridden: a message was sent."""

    def received(self, arrival: Arrival) -> None:
        """To be overridden: a message has come."""

    def unreadable(self, topic: str) -> None:
        """Never called: rclpy hands what isn't of its type on with its fields empty."""


def init(domain: int | None = None) -> None:
    """Join the network; signals are left to the program: rclpy's own way would end nodes before their last record."""
    if not rclpy.ok():
        rclpy.init(domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)


def message_type(name: str) -> Any:
    """The class of messages of that name.

    Raises:
        SettingError: its package isn't installed.
    """
    package, kind, leaf = checked_type(name).split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), leaf)
    except (ImportError, AttributeError) as error:
        raise SettingError(
            f"type {name}", f"not known here ({error})", "Source the workspace that defines it"
        ) from None


def message(name: str, **fields: Any) -> Any:
    """A message of that type."""
    return message_type(name)(**fields)


def type_name(msg_type: Any) -> str:
    """The name of a class of messages."""
    package, kind = msg_type.__module__.split(".")[:2]
    return f"{package}/{kind}/{msg_type.__name__}"


def spin_once(node: Node, timeout_sec: float) -> None:
    """Handle what comes within so long; nodes may be spun by threads of their own."""
    if node.own_executor is None:
        node.own_executor = SingleThreadedExecutor()
        node.own_executor.add_node(node)
    try:
        node.own_executor.spin_once(timeout_sec=timeout_sec)
    except ExternalShutdownException:
        raise KeyboardInterrupt from None


def shutdown() -> None:
    """Leave the network."""
    rclpy.try_shutdown()


def _arrival(topic: str, message: Any, info: Any) -> Arrival:
    gid = info.get("publisher_gid")
    return Arrival(
        topic=topic,
        size=len(message) if isinstance(message, bytes) else size(message),
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
    """Rclpy's profile of ours; its own, and depths, stay as they are."""
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
