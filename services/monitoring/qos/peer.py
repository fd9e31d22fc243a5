"""Publisher and subscriber of events at the two ends of a network, on a ROS 2 topic with the event bus's QoS.

`python -m scan2sim.services.monitoring.qos.peer receive` and `... publish RATE BYTES SECONDS`; both ends must share a
clock, like two namespaces of one machine. At the end, the subscriber prints one line of JSON (`Received`).
"""

from __future__ import annotations

import json
import sys
import time
import zlib
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from scan2sim.services.monitoring.node.monitor import RECORDS_QOS, STRING, ros
from scan2sim.services.qos.confidence import share_bounds

TOPIC = "/qos_events"
DISCOVERY_TIMEOUT_S = 60.0
SILENCE_S = 15.0
"""Time without an event after which the subscriber ends."""
END = "end"
"""First word of the message after the last event; the second is the number of events."""


@dataclass(frozen=True)
class Received:
    """Events that the subscriber received.

    Attributes:
        sent: number of published events; as far as the subscriber knows, at least the received ones.
        received, corrupted: number of received events, and of those whose content has changed.
        delay: 95th percentile of the time from publishing to receiving, ms; infinite if none was received.
        jitter: mean difference between the delays of successive events (RFC 3393), ms.
        bytes: total size of the received events.
        seconds: from publishing the first to receiving the last one.
    """

    sent: int
    received: int
    corrupted: int
    delay: float
    jitter: float
    bytes: int
    seconds: float

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Confidence bounds of the shares of lost and of corrupted events."""
        return {
            "loss_rate": share_bounds(self.sent - self.received, self.sent),
            "error_rate": share_bounds(self.corrupted, max(1, self.received)),
        }


def publish(rate: float, size: int, seconds: float) -> None:
    """Publish `rate` events of `size` bytes per second for `seconds`, once there is a subscriber.

    Raises:
        TimeoutError: there is none.
    """
    node = ros.Node("qos_publisher")
    publisher = node.create_publisher(ros.message_type(STRING), TOPIC, RECORDS_QOS)
    began = time.monotonic()
    while publisher.get_subscription_count() == 0:
        if time.monotonic() - began > DISCOVERY_TIMEOUT_S:
            raise TimeoutError("no subscriber")
        ros.spin_once(node, 0.1)
    began, count, content = time.monotonic(), max(1, round(rate * seconds)), "x" * size
    checksum = zlib.crc32(content.encode())
    for number in range(count):
        while (pause := began + number / rate - time.monotonic()) > 0:
            ros.spin_once(node, pause)
        data = f"{number} {time.monotonic_ns()} {checksum} {content}"
        publisher.publish(ros.message(STRING, data=data))
    publisher.publish(ros.message(STRING, data=f"{END} {count}"))
    until = time.monotonic() + DISCOVERY_TIMEOUT_S
    while publisher.get_subscription_count() and time.monotonic() < until:  # which still receives what was lost
        ros.spin_once(node, 0.1)
    node.destroy_node()


class _Subscriber:
    """Counts events."""

    def __init__(self) -> None:
        self.delays: dict[int, int] = {}
        self.corrupted = self.bytes = 0
        self.sent: int | None = None
        self.first, self.last = float("inf"), time.monotonic()

    def take(self, message: Any) -> None:
        """Count a message."""
        self.last = time.monotonic()
        number, second, *rest = message.data.split(" ", 3)
        if number == END:
            self.sent = int(second)
            return
        checksum, content = rest
        self.delays[int(number)] = time.monotonic_ns() - int(second)
        self.first = min(self.first, int(second) / 1e9)
        self.corrupted += zlib.crc32(content.encode()) != int(checksum)
        self.bytes += len(message.data)

    def result(self) -> Received:
        """The result."""
        numbers = sorted(self.delays)
        delays = np.array([self.delays[number] for number in numbers]) / 1e6
        successive = np.diff(numbers) == 1
        return Received(
            sent=self.sent if self.sent is not None else max(numbers, default=0) + 1,
            received=len(numbers),
            corrupted=self.corrupted,
            delay=float(np.percentile(delays, 95)) if numbers else float("inf"),
            jitter=float(np.abs(np.diff(delays))[successive].mean()) if successive.any() else 0.0,
            bytes=self.bytes,
            seconds=max(0.0, self.last - self.first),
        )


def receive() -> Received:
    """Receive events until the last one, or `SILENCE_S` after a silence that follows the first."""
    node, subscriber = ros.Node("qos_subscriber"), _Subscriber()
    node.create_subscription(ros.message_type(STRING), TOPIC, subscriber.take, RECORDS_QOS)
    print("ready", flush=True)
    while subscriber.sent is None or len(subscriber.delays) < subscriber.sent:
        ros.spin_once(node, 0.1)
        allowed = SILENCE_S if subscriber.delays or subscriber.sent else DISCOVERY_TIMEOUT_S + SILENCE_S
        if time.monotonic() - subscriber.last > allowed:
            break
    node.destroy_node()
    return subscriber.result()


def main() -> None:
    """Publish or receive according to the arguments."""
    ros.init()
    if sys.argv[1] == "publish":
        publish(float(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
    else:
        print(json.dumps(asdict(receive())), flush=True)
    ros.shutdown()


if __name__ == "__main__":
    main()
