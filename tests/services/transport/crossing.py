"""Node that publishes messages of several types and counts those it receives: crossing.py NAME OTHER SECONDS."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from scan2sim.services.transport import Arrival, QoS, load

TYPES = ["std_msgs/msg/String", "std_msgs/msg/Bool", "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu",
         "sensor_msgs/msg/PointCloud2", "std_msgs/msg/Float64MultiArray"]  # fmt: skip
FIELDS: dict[str, dict[str, Any]] = {
    "std_msgs/msg/String": {"data": "Straße, 画像"},
    "std_msgs/msg/Bool": {"data": True},
}


def main() -> None:
    ros = load()
    name, other, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
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
    endpoints: list[dict[str, str]] = []
    publishers = {}
    for kind in TYPES:
        leaf = kind.split("/")[-1]
        publishers[kind] = node.create_publisher(ros.message_type(kind), f"{name}/{leaf}", QoS())
        node.create_subscription(
            ros.message_type(kind), f"{other}/{leaf}", lambda message, leaf=leaf: latest.update({leaf: message}), QoS()
        )
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        began = time.monotonic()
        while time.monotonic() - began < 0.1:
            ros.spin_once(node, 0.05)
        if found := [one for one in node.endpoints(f"{other}/String") if one.kind == "PUBLISHER"]:
            endpoints = [{"node": one.node_name, "type": one.type_name} for one in found]
        for kind, publisher in publishers.items():
            publisher.publish(ros.message(kind, **FIELDS.get(kind, {})))
    print(json.dumps({"heard": heard, "text": getattr(latest.get("String"), "data", None), "endpoints": endpoints}))
    node.destroy_node()
    ros.shutdown()


if __name__ == "__main__":
    main()
