"""Node that publishes messages of several types and counts those it receives: crossing.py NAME OTHER.

It prints what it has received so far, a line of JSON twice a second, until its input is closed.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from scan2sim.services.transport import Arrival, QoS, load
from tests.fakes.nodes import spin_until_closed

TYPES = ["std_msgs/msg/String", "std_msgs/msg/Bool", "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu",
         "sensor_msgs/msg/PointCloud2", "std_msgs/msg/Float64MultiArray"]  # fmt: skip
FIELDS: dict[str, dict[str, Any]] = {
    "std_msgs/msg/String": {"data": "Straße, 画像"},
    "std_msgs/msg/Bool": {"data": True},
}


def main() -> None:
    ros = load()
    name, other = sys.argv[1:]
    ros.init()
    heard: dict[str, dict[str, Any]] = {}

    class Node(ros.Node):  # type: ignore[misc, name-defined]
        def received(self, arrival: Arrival) -> None:
            stats = heard.setdefault(arrival.topic.split("/")[-1], {"count": 0, "numbered": True})
            stats["count"] += 1
            stats["numbered"] &= arrival.number is not None and arrival.publisher is not None
            stats["latency"] = (arrival.received - (arrival.sent or 0)) / 1e9
            stats["size"] = arrival.size

    node = Node(f"node_{name}")
    latest: dict[str, Any] = {}
    publishers = {}
    for kind in TYPES:
        leaf = kind.split("/")[-1]
        publishers[kind] = node.create_publisher(ros.message_type(kind), f"{name}/{leaf}", QoS())
        node.create_subscription(
            ros.message_type(kind), f"{other}/{leaf}", lambda message, leaf=leaf: latest.update({leaf: message}), QoS()
        )

    def publish() -> None:
        for kind, publisher in publishers.items():
            publisher.publish(ros.message(kind, **FIELDS.get(kind, {})))

    def report() -> None:
        found = [one for one in node.endpoints(f"{other}/String") if one.kind == "PUBLISHER"]
        endpoints = [{"node": one.node_name, "type": one.type_name} for one in found]
        text = getattr(latest.get("String"), "data", None)
        print(json.dumps({"heard": heard, "text": text, "endpoints": endpoints}), flush=True)

    node.create_timer(0.1, publish)
    node.create_timer(0.5, report)
    spin_until_closed(ros, node)
    node.destroy_node()
    ros.shutdown()


if __name__ == "__main__":
    main()
