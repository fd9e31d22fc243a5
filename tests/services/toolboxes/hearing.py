"""Subscriber for tests: prints the messages of a topic, a line of JSON each. Arguments: TOPIC TYPE COUNT."""

from __future__ import annotations

import json
import sys
from typing import Any

from scan2sim.services import transport
from scan2sim.services.toolboxes.settings import IMAGE
from scan2sim.services.transport import QoS


def main() -> None:
    topic, kind, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    ros = transport.load()
    ros.init()
    node = ros.Node("hearing")
    received: list[str] = []

    def take(message: Any) -> None:
        received.append(json.dumps(_image(message)) if kind == IMAGE else message.data)

    node.create_subscription(ros.message_type(kind), topic, take, QoS(depth=100))
    while len(received) < count:
        ros.spin_once(node, 0.1)
    print("\n".join(received), flush=True)
    node.destroy_node()
    ros.shutdown()


def _image(message: Any) -> dict[str, Any]:
    stamp = message.header.stamp
    size = {"height": message.height, "width": message.width, "encoding": message.encoding, "step": message.step}
    return {**size, "stamp": stamp.sec + 1e-9 * stamp.nanosec, "level": int(message.data[0])}


if __name__ == "__main__":
    main()
