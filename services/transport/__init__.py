"""Topics of ROS 2, in two files behind one interface: rclpy where it imports, cyclonedds with ROS names elsewhere.

Services know nothing else of ROS. Both files have what `Transport` lists; nodes of both see each other's topics.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from typing import Any, Protocol

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.transport.types import Arrival, Endpoint, QoS

CHOICE = "SCAN2SIM_TRANSPORT"
"""Environment variable that names the transport; without it, the first of `NAMES` that imports here."""
NAMES = ("rclpy", "cyclone")


class Publisher(Protocol):
    """Sends messages on a topic."""

    def publish(self, message: Any) -> None:
        """Send a message, or one that is serialized already (bytes of CDR with its encapsulation)."""

    def get_subscription_count(self) -> int:
        """Subscriptions that are matched with it now."""


class Node(Protocol):
    """A node of ROS 2; methods are named as in rclpy, and their arguments mean the same.

    `published`, `received` and `unreadable` are called in the thread that sends a message or takes it; a subclass that
    overrides them sees all that goes through the node (`services.monitoring.node.monitor`).
    """

    def __init__(self, node_name: str, *, namespace: str = "/", hidden: bool = False) -> None:
        """Join the network; `hidden`: without parameters and a log of its own (its name should begin with _)."""

    def get_name(self) -> str:
        """Its name, without namespace."""

    def get_namespace(self) -> str:
        """Its namespace, which begins with a slash."""

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any) -> Any:
        """A `Publisher`; the profile is a `QoS`, or a depth."""

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: Any, *, raw: bool = False
    ) -> Any:
        """Have each message handed to `callback(message)`; `raw` as bytes of CDR with its encapsulation."""

    def raw_type(self, topic: str, type_name: str) -> Any:
        """Stands for messages of a topic, to subscribe to it raw.

        Raises:
            SettingError: the transport needs their definition, and doesn't have it.
        """

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> Any:
        """Have `callback()` called every so many seconds."""

    def endpoints(self, topic: str) -> tuple[Endpoint, ...]:
        """All publishers and subscriptions of a topic that were discovered so far, this node's own among them."""

    def topics(self) -> dict[str, tuple[str, ...]]:
        """Topics that were discovered, and the names of their types."""

    def destroy_node(self) -> Any:
        """Leave the network."""

    def published(self, topic: str, size: int) -> None:
        """Called after a message of so many bytes was sent."""

    def received(self, arrival: Arrival) -> None:
        """Called before a message is handed on."""

    def unreadable(self, topic: str) -> None:
        """Called instead of handing a message on that isn't of its type, after `received`."""


class Transport(Protocol):
    """What both files have."""

    Node: type[Any]

    def init(self, domain: int | None = None) -> None:
        """Join the network, before any node is made; the domain is ROS_DOMAIN_ID's without one."""

    def message_type(self, name: str) -> Any:
        """The class of messages, by a name as "std_msgs/msg/String"."""

    def message(self, name: str, **fields: Any) -> Any:
        """A message; fields that aren't given are zero or empty."""

    def type_name(self, msg_type: Any) -> str:
        """The name of a class of messages."""

    def spin_once(self, node: Any, timeout_sec: float) -> None:
        """Wait for messages and timers so long, and have them handled."""

    def shutdown(self) -> None:
        """Leave the network; all nodes end."""


def load(name: str | None = None) -> Any:
    """The transport that is asked for (argument, then `CHOICE`), else the first that imports here: a `Transport`.

    Raises:
        SettingError: there is none of that name.
        UnavailableError: what it needs isn't installed.
    """
    asked = name or os.environ.get(CHOICE)
    if asked and asked not in NAMES:
        raise SettingError(CHOICE, f"there is no transport {asked!r}", f"Choose one of: {', '.join(NAMES)}")
    chosen = asked or ("rclpy" if optional_deps.missing("rclpy") is None else "cyclone")
    optional_deps.need(f"the transport {chosen}", *{"rclpy": ("rclpy",), "cyclone": ("cyclonedds", "rosbags")}[chosen])
    return importlib.import_module(f"{__name__}.{chosen}")


__all__ = ["Arrival", "Endpoint", "Node", "Publisher", "QoS", "Transport", "load"]
