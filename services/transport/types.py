"""Types of both transports: QoS profiles, endpoints and metadata of received messages.

Names and values are those of DDS and ROS 2 (OMG DDS 1.4, section 2.2.3; rclpy's `QoSProfile`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

INFINITE = 2**63 - 1
"""Infinite duration in nanoseconds, as in ROS 2."""

Reliability = Literal["RELIABLE", "BEST_EFFORT"]
Durability = Literal["VOLATILE", "TRANSIENT_LOCAL"]
Liveliness = Literal["AUTOMATIC", "MANUAL_BY_TOPIC"]
Kind = Literal["PUBLISHER", "SUBSCRIPTION"]


@dataclass(frozen=True)
class QoS:
    """QoS profile of a publisher or a subscription; the defaults are ROS 2's.

    Attributes:
        depth: history depth, messages; 0: keep all.
        lifespan: nanoseconds after which a message is no longer delivered.
        deadline: maximum time between two messages, nanoseconds.
        lease: liveliness lease duration, nanoseconds.
    """

    reliability: Reliability = "RELIABLE"
    durability: Durability = "VOLATILE"
    depth: int = 10
    lifespan: int = INFINITE
    deadline: int = INFINITE
    liveliness: Liveliness = "AUTOMATIC"
    lease: int = INFINITE


def as_qos(qos: QoS | int) -> QoS:
    """Convert a history depth to the default profile with that depth, as in rclpy."""
    return QoS(depth=qos) if isinstance(qos, int) else qos


@dataclass(frozen=True)
class Endpoint:
    """A discovered publisher or subscription.

    Attributes:
        type_name: such as "std_msgs/msg/String".
        gid: globally unique id, 16 bytes (24 with ROS 2 Humble or older).
    """

    node_name: str
    node_namespace: str
    type_name: str
    kind: Kind
    gid: bytes
    qos: QoS


class Arrival(NamedTuple):
    """Metadata of a received message; a tuple because one is created per message.

    Attributes:
        topic: full name of the topic.
        size: serialized size in CDR, bytes, with the encapsulation header of four bytes.
        received: time of arrival, nanoseconds since the epoch by this machine's clock.
        sent: source timestamp by the sender's clock; None: unknown.
        publisher: GID of the publisher; None: unknown.
        number: sequence number of the publisher, increasing by one; None: unknown, losses can't be counted.
    """

    topic: str
    size: int
    received: int
    sent: int | None
    publisher: bytes | None
    number: int | None
