"""Camera node for tests: publishes images and prints the received results. Arguments: TOPIC RESULTS COUNT [IMAGE]."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from scan2sim.services import transport
from scan2sim.services.transport import QoS


def main() -> None:
    topic, results, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    picture = Path(sys.argv[4]).read_bytes() if len(sys.argv) > 4 else b""
    ros = transport.load()
    ros.init()
    node = ros.Node("camera")
    kind = "sensor_msgs/msg/CompressedImage" if picture else "sensor_msgs/msg/Image"
    publisher = node.create_publisher(ros.message_type(kind), topic, QoS(reliability="BEST_EFFORT", depth=2))
    received: list[str] = []
    node.create_subscription(ros.message_type("std_msgs/msg/String"), results, lambda m: received.append(m.data), 10)
    sent = 0
    while len(received) < count:
        ros.spin_once(node, 0.05)
        if publisher.get_subscription_count():
            sent += 1
            publisher.publish(_message(ros, kind, sent, picture))
            time.sleep(0.05)
    print("\n".join(received), flush=True)
    node.destroy_node()
    ros.shutdown()


def _message(ros: object, kind: str, number: int, picture: bytes) -> object:
    stamp = ros.message("builtin_interfaces/msg/Time", sec=number, nanosec=5)  # type: ignore[attr-defined]
    header = ros.message("std_msgs/msg/Header", stamp=stamp, frame_id="front")  # type: ignore[attr-defined]
    make = ros.message  # type: ignore[attr-defined]
    if picture:
        return make(kind, header=header, format="png", data=np.frombuffer(picture, np.uint8))
    image = np.full((12, 16, 3), 10 * number % 200, np.uint8)
    fields = {"height": 12, "width": 16, "encoding": "rgb8", "step": 48, "data": image.ravel()}
    return make(kind, header=header, **fields)


if __name__ == "__main__":
    main()
