"""Transport over ROS 2 topics, with two implementations: rclpy if it is installed, else cyclonedds with ROS 2's names.

Services use no other ROS API. Both modules implement `Transport`; nodes of both are interoperable.
"""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Callable
from typing import Any, Protocol

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.transport.types import Arrival, Endpoint, QoS

log = logging.getLogger(__name__)

TRANSPORT_VARIABLE = "SCAN2SIM_TRANSPORT"
"""Environment variable that selects the transport; default: the first of `TRANSPORTS` that can be imported."""
TRANSPORTS = ("rclpy", "cyclone")


class Publisher(Protocol):
    """Sends messages on a topic."""

    def publish(self, message: Any) -> None:
        """Publish a message, or a serialized one (bytes of CDR with the encapsulation header)."""

    def get_subscription_count(self) -> int:
        """Number of currently matched subscriptions."""

    def wait_for_all_acked(self, timeout_sec: float) -> bool:
        """Whether all matched reliable subscriptions have acknowledged all messages within `timeout_sec`."""


class Node(Protocol):
    """A ROS 2 node; methods and arguments are those of rclpy.

    `published`, `received` and `unreadable` are hooks, called in the thread that sends or takes a message; a subclass
    that overrides them sees all traffic of the node (`services.monitoring.node.monitor`).
    """

    def __init__(self, node_name: str, *, namespace: str = "/", hidden: bool = False) -> None:
        """Create the node; `hidden`: without parameter services and /rosout (its name should begin with _)."""

    def get_name(self) -> str:
        """Name without namespace."""

    def get_namespace(self) -> str:
        """Namespace, beginning with a slash."""

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any) -> Any:
        """Create a `Publisher`; the profile is a `QoS`, or a history depth."""

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: Any, *, raw: bool = False
    ) -> Any:
        """Subscribe with `callback(message)`; `raw`: messages are bytes of CDR with the encapsulation header."""

    def raw_type(self, topic: str, type_name: str) -> Any:
        """Message type for a raw subscription to a topic.

        Raises:
            SettingError: the transport needs the definition of the type and doesn't have it.
        """

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> Any:
        """Call `callback()` periodically."""

    def endpoints(self, topic: str) -> tuple[Endpoint, ...]:
        """All discovered publishers and subscriptions of a topic, including this node's own."""

    def topics(self) -> dict[str, tuple[str, ...]]:
        """Discovered topics and the names of their types."""

    def destroy_node(self) -> Any:
        """Destroy the node."""

    def published(self, topic: str, size: int) -> None:
        """Hook, called after a message of `size` bytes was published."""

    def received(self, arrival: Arrival) -> None:
        """Hook, called before a received message is passed to the callback."""

    def unreadable(self, topic: str) -> None:
        """Hook, called after `received` instead of the callback if a message can't be deserialized."""


class Transport(Protocol):
    """Interface of the transport modules."""

    Node: type[Any]

    def init(self, domain: int | None = None) -> None:
        """Initialize the transport before any node is created; default domain: ROS_DOMAIN_ID."""

    def message_type(self, name: str) -> Any:
        """Message class by its name, such as "std_msgs/msg/String"."""

    def message(self, name: str, **fields: Any) -> Any:
        """Create a message; fields that aren't given are zero or empty."""

    def type_name(self, msg_type: Any) -> str:
        """Name of a message class."""

    def spin_once(self, node: Any, timeout_sec: float) -> None:
        """Process messages and timers of a node, waiting up to `timeout_sec`."""

    def shutdown(self) -> None:
        """Shut the transport down, with all nodes."""


def load(name: str | None = None) -> Any:
    """Load a `Transport`: by name, by the environment variable `TRANSPORT_VARIABLE`, or the first that works.

    Raises:
        SettingError: unknown name.
        UnavailableError: a required package isn't installed.
    """
    requested = name or os.environ.get(TRANSPORT_VARIABLE)
    if requested and requested not in TRANSPORTS:
        cause = f"unknown transport {requested!r}"
        raise SettingError(TRANSPORT_VARIABLE, cause, f"Choose one of: {', '.join(TRANSPORTS)}")
    chosen = requested or ("rclpy" if _has_rclpy() else "cyclone")
    packages = {"rclpy": ("rclpy",), "cyclone": ("cyclonedds", "rosbags")}[chosen]
    optional_deps.require(f"the transport {chosen}", *packages)
    return importlib.import_module(f"{__name__}.{chosen}")


def _has_rclpy() -> bool:
    """Whether rclpy can be imported: a sourced ROS 2 puts its own on the path, which may be of another Python."""
    if optional_deps.missing("rclpy"):
        return False
    try:
        importlib.import_module("rclpy")
    except ImportError as error:
        log.warning(
            "ROS 2 is sourced, but its rclpy doesn't work with this Python: nodes use Cyclone DDS, and see those of "
            "ROS 2 all the same (%s)", str(error).strip().partition("\n")[0],
        )  # fmt: skip
        return False
    return True


__all__ = ["Arrival", "Endpoint", "Node", "Publisher", "QoS", "Transport", "load"]
