"""Publisher or subscriber for `bench.bus.overhead`, plain or monitored; prints its results as one line of JSON.

`python -m bench.bus.overhead_node talk|hear bare|watched SIZE RATE COUNT`; SCAN2SIM_TRANSPORT selects the transport.
Plain nodes are those of rclpy, or a cyclonedds writer and reader of the same type.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from scan2sim.services.transport import QoS, load

ros = load()
TEXT, IMAGE = "std_msgs/msg/String", "sensor_msgs/msg/Image"
TOPIC, QUEUE_DEPTH = "cost", 5
WARM_UP_SHARE = 0.1
"""Share of the messages at the beginning that are ignored."""


def main() -> None:
    """Publish or subscribe, and print the results."""
    role, kind = sys.argv[1], sys.argv[2]
    size, rate, count = int(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5])
    ros.init()
    result = (talk if role == "talk" else hear)(_node(role, kind), size, rate, count)
    print(json.dumps(result), flush=True)
    os._exit(0)  # skip the slow shutdown


def talk(node: Any, size: int, rate: float, count: int) -> dict[str, Any]:
    """Publish `count` messages at a rate; returns CPU milliseconds per message."""
    name = IMAGE if size > 100_000 else TEXT
    publisher = node.create_publisher(ros.message_type(name), TOPIC, QUEUE_DEPTH)
    while publisher.get_subscription_count() < 1:
        time.sleep(0.05)
    time.sleep(1.0)
    body: Any = _bytes(size)
    cpu, began = time.process_time(), time.perf_counter()
    for number in range(count):
        now = time.time_ns()
        stamp = f"{now:020d}"
        if name == IMAGE:
            message = ros.message(name, data=body, encoding=stamp)
        else:
            message = ros.message(name, data=stamp + "x" * (size - len(stamp)))
        publisher.publish(message)
        rest = began + (number + 1) / rate - time.perf_counter()
        if rest > 0:
            time.sleep(rest)
    result = {"cpu_ms": (time.process_time() - cpu) / count * 1e3}
    time.sleep(1.0)
    return result


def hear(node: Any, size: int, rate: float, count: int) -> dict[str, Any]:
    """Receive up to `count` messages; returns CPU milliseconds per message, latency and messages per second."""
    latencies: list[int] = []
    times: list[float] = []
    cpu = 0.0

    def take(message: Any) -> None:
        nonlocal cpu
        stamp = message.encoding if size > 100_000 else message.data[:20]
        latencies.append(time.time_ns() - int(stamp))
        times.append(time.perf_counter())
        if len(times) == 1:
            cpu = time.process_time()

    node.create_subscription(ros.message_type(IMAGE if size > 100_000 else TEXT), TOPIC, take, QUEUE_DEPTH)
    first_deadline = time.perf_counter() + 30
    while len(times) < count and time.perf_counter() < (times[-1] + 2 if times else first_deadline):
        node.spin_bare(0.2) if hasattr(node, "spin_bare") else ros.spin_once(node, 0.2)
    warm = int(WARM_UP_SHARE * len(times))
    return {
        "cpu_ms": (time.process_time() - cpu) / len(times) * 1e3,
        "p50_ms": median(latencies[warm:]) / 1e6,
        "per_second": (len(times) - 1) / (times[-1] - times[0]),
        "received": len(times),
    }


def _node(role: str, kind: str) -> Any:
    if kind == "watched":
        from scan2sim.services.monitoring.node.monitor import Monitor

        return Monitor(role, log_file=Path(os.environ.get("TMPDIR", "/tmp")) / f"cost-{role}.log")
    if ros.__name__.endswith("rclpy"):
        import rclpy

        node = rclpy.create_node(role)
        node.own_executor = None  # required by `spin_once`
        return node
    return _PlainNode()


class _PlainNode:
    """A cyclonedds writer or reader without monitoring."""

    def __init__(self) -> None:
        from cyclonedds.domain import Domain, DomainParticipant

        from scan2sim.services.transport.cyclone import DOMAIN_CONFIG

        ros.shutdown()
        domain = int(os.environ.get("ROS_DOMAIN_ID") or 0)
        self._domain = Domain(domain, DOMAIN_CONFIG.strip())
        self._participant = DomainParticipant(domain)

    def _topic(self, message_type: Any) -> Any:
        from cyclonedds.topic import Topic

        from scan2sim.services.transport import idl

        self._kind = ros.type_name(message_type)
        self._sample = idl.sample_type(self._kind)
        return Topic(self._participant, f"rt/{TOPIC}", self._sample)

    def create_publisher(self, message_type: Any, _: str, depth: int) -> Any:
        from cyclonedds.pub import DataWriter

        from scan2sim.services.transport.policies import policies

        self._writer = DataWriter(self._participant, self._topic(message_type), policies(QoS(depth=depth)))
        return self

    def publish(self, message: Any) -> None:
        from scan2sim.services.transport.idl import STORE

        self._writer.write(self._sample(bytes(STORE.serialize_cdr(message, self._kind))))

    def get_subscription_count(self) -> int:
        return len(self._writer.get_matched_subscriptions())

    def create_subscription(self, message_type: Any, _: str, callback: Callable[[Any], None], depth: int) -> None:
        from cyclonedds.core import ReadCondition, WaitSet
        from cyclonedds.sub import DataReader

        from scan2sim.services.transport.graph import ALIVE
        from scan2sim.services.transport.policies import policies

        self._reader = DataReader(self._participant, self._topic(message_type), policies(QoS(depth=depth)))
        self._callback = callback
        self._waiting = WaitSet(self._participant)
        self._condition = ReadCondition(self._reader, ALIVE)
        self._waiting.attach(self._condition)

    def spin_bare(self, timeout: float) -> None:
        from scan2sim.services.transport.idl import STORE

        self._waiting.wait(int(timeout * 1e9))
        for sample in self._reader.take(64):
            if sample.sample_info.valid_data:
                self._callback(STORE.deserialize_cdr(sample.data, self._kind))


def _bytes(size: int) -> Any:
    if ros.__name__.endswith("rclpy"):
        import array

        return array.array("B", bytes(size))
    import numpy as np

    return np.zeros(size, np.uint8)


if __name__ == "__main__":
    main()
