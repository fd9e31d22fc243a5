"""What both transports share: qualities of service, endpoints and what is known of a message that arrived.

Names and values are those of DDS and ROS 2 (OMG DDS 1.4, section 2.2.3; rclpy's `QoSProfile`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

INFINITE = 2**63 - 1
"""Nanoseconds that stand for "never", as ROS 2 writes them."""

Reliability = Literal["RELIABLE", "BEST_EFFORT"]
Durability = Literal["VOLATILE", "TRANSIENT_LOCAL"]
Liveliness = Literal["AUTOMATIC", "MANUAL_BY_TOPIC"]
Kind = Literal["PUBLISHER", "SUBSCRIPTION"]


@dataclass(frozen=True)
class QoS:
    """Quality of service of a publisher or a subscription; the defaults are ROS 2's.

    Attributes:
        depth: messages kept for who is slow or late; 0 keeps all.
        lifespan: nanoseconds after which a message isn't delivered any more.
        deadline: nanoseconds between messages, at most.
        lease: nanoseconds after which a publisher that said nothing counts as gone.
    """

    reliability: Reliability = "RELIABLE"
    durability: Durability = "VOLATILE"
    depth: int = 10
    lifespan: int = INFINITE
    deadline: int = INFINITE
    liveliness: Liveliness = "AUTOMATIC"
    lease: int = INFINITE


SENSOR_DATA = QoS(reliability="BEST_EFFORT", depth=5)
"""ROS 2's profile of that name: the newest matters, what is lost is lost."""


def as_qos(qos: QoS | int) -> QoS:
    """A profile, where a number is the depth of the default one, as in rclpy."""
    return QoS(depth=qos) if isinstance(qos, int) else qos


@dataclass(frozen=True)
class Endpoint:
    """A publisher or a subscription that was discovered.

    Attributes:
        type_name: as "std_msgs/msg/String".
        gid: 16 bytes (24 where ROS 2 is Humble or older), unlike any other's.
    """

    node_name: str
    node_namespace: str
    type_name: str
    kind: Kind
    gid: bytes
    qos: QoS


class Arrival(NamedTuple):
    """A message that arrived; one is made for each, so it is a tuple, which costs least.

    Attributes:
        topic: its full name.
        size: bytes in CDR, with its four bytes of encapsulation.
        received: nanoseconds since the epoch, by this machine's clock.
        sent: likewise by the sender's; None: unknown.
        publisher: its GID; None: unknown.
        number: that the publisher gave it, one more than the last one's; None: unknown, so losses can't be counted.
    """

    topic: str
    size: int
    received: int
    sent: int | None
    publisher: bytes | None
    number: int | None
