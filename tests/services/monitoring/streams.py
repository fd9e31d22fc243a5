"""Instrumented node that publishes or subscribes until its input is closed.

streams.py talk|hear LOG TOPIC:BYTES:RATE ...
"""

from __future__ import annotations

import sys
from typing import Any

from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.transport import QoS
from tests.fakes.nodes import spin_until_closed

MAX_TEXT_BYTES = 100_000
"""Larger messages are images."""
IMAGE, TEXT = "sensor_msgs/msg/Image", "std_msgs/msg/String"


def message(size: int) -> Any:
    if size <= MAX_TEXT_BYTES:
        return ros.message(TEXT, data="x" * size)
    if ros.__name__.endswith("rclpy"):
        import array

        return ros.message(IMAGE, data=array.array("B", bytes(size)))
    import numpy as np

    return ros.message(IMAGE, data=np.zeros(size, np.uint8))


def main() -> None:
    role, log, *streams = sys.argv[1:]
    ros.init()
    node = Monitor(role, period=0.5, log_file=log)
    for stream in streams:
        topic, size, rate = stream.split(":")
        kind, qos = (IMAGE, QoS(depth=5)) if int(size) > MAX_TEXT_BYTES else (TEXT, QoS(depth=50))
        if role == "talk":
            publisher, sent = node.create_publisher(ros.message_type(kind), topic, qos), message(int(size))
            node.create_timer(1 / float(rate), lambda publisher=publisher, sent=sent: publisher.publish(sent))
        else:
            node.create_subscription(ros.message_type(kind), topic, lambda _: None, qos)
    spin_until_closed(ros, node)
    node.destroy_node()
    ros.shutdown()


if __name__ == "__main__":
    main()
