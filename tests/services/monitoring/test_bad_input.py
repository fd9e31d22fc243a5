"""Robustness of nodes: large, malformed and unknown messages, clock jumps, unreachable brokers, invalid settings."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services import kafka
from scan2sim.services.monitoring.events.schema import Events
from scan2sim.services.monitoring.settings.monitor import MonitorParams, TopicParams
from scan2sim.services.outbox import OutboxRecord
from tests.services.conftest import Start

STREAMS = Path(__file__).with_name("streams.py")
TOPIC = ("-m", "scan2sim.flows.cli", "monitor", "topic")
MONITOR_TOPIC = """
import sys, time
from scan2sim.services.monitoring.node.monitor import ros
from scan2sim.services.monitoring.node.topic_monitor import TopicMonitor
from scan2sim.services.monitoring.settings.monitor import TopicParams
ros.init()
node = TopicMonitor(TopicParams(topics=sys.argv[2:], log_file=sys.argv[1], period=0.5))
node.find(20)
end = time.monotonic() + 6
while time.monotonic() < end:
    ros.spin_once(node, 0.1)
node.destroy_node()
ros.shutdown()
"""


def records(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def flows(path: Path, topic: str, direction: str = "incoming") -> list[dict[str, Any]]:
    return [
        flow
        for one in records(path)
        for flow in one["flows"]
        if (flow["topic"], flow["direction"]) == (topic, direction)
    ]


@pytest.mark.parametrize("transport", ["cyclone", pytest.param("rclpy", marks=pytest.mark.slow)])
def test_messages_of_ten_megabytes_are_monitored_by_nodes_and_topic_monitor(
    transport: str, tmp_path: Path, start: Start
) -> None:
    talks, hears, seen = (tmp_path / name for name in ("talk", "hear", "topic"))
    heard = start(transport, STREAMS, "hear", "12", hears, "image:10000000:2")
    watch = start(transport, "-c", MONITOR_TOPIC, seen, "image")
    said = start(transport, STREAMS, "talk", "10", talks, "image:10000000:2")
    for process in (said, heard, watch):
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
    size = max(flow["message size mean"] for flow in flows(talks, "/image", "outgoing"))
    assert 10_000_000 < size < 10_000_100
    for path in (hears, seen):
        assert sum(flow["messages"] for flow in flows(path, "/image")) >= 5
        assert max(flow["message size mean"] for flow in flows(path, "/image")) == size


@pytest.mark.parametrize(
    ("transport", "watching"),
    [
        ("cyclone", (STREAMS, "hear", "11")),
        pytest.param("rclpy", (STREAMS, "hear", "11"), marks=pytest.mark.slow),
        pytest.param("cyclone", ("-c", MONITOR_TOPIC), marks=pytest.mark.slow),
    ],
    ids=["inside", "inside rclpy", "outside"],
)
def test_large_topic_does_not_starve_a_small_one(
    transport: str, watching: tuple[str, ...], tmp_path: Path, start: Start
) -> None:
    streams = ("image:6220800:30", "small:100:10")
    topics = streams if "hear" in watching else ("image", "small")
    watch = start(transport, *watching, tmp_path / "watch", *topics)
    talk = start(transport, STREAMS, "talk", "9", tmp_path / "talk", *streams)
    for process in (talk, watch):
        _, errors = process.communicate(timeout=90)
        assert process.returncode == 0, errors
    small = flows(tmp_path / "watch", "/small")
    assert sum(flow["lost messages"] for flow in small) == 0
    assert sum(flow["messages"] for flow in small) == sum(flow["published messages"] for flow in small) > 30
    assert sum(flow["messages"] for flow in flows(tmp_path / "watch", "/image")) > 20


JUMPING_CLOCK = """
import sys, time
ahead, real, real_ns, began = [0], time.time, time.time_ns, time.monotonic()
time.time = lambda: real() + ahead[0]
time.time_ns = lambda: real_ns() + ahead[0] * 10**9
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.transport import QoS
String = ros.message_type("std_msgs/msg/String")
ros.init()
talker, listener = Monitor("talker"), Monitor("listener", period=0.5, log_file=sys.argv[1])
publisher = talker.create_publisher(String, "chatter", QoS())
talker.create_timer(0.05, lambda: publisher.publish(ros.message("std_msgs/msg/String", data="x")))
listener.create_subscription(String, "chatter", lambda _: None, QoS())
while time.monotonic() < began + 9:
    ahead[0] = 0 if time.monotonic() < began + 3 else 3600 if time.monotonic() < began + 6 else -7200
    for node in (talker, listener):
        ros.spin_once(node, 0.02)
for node in (talker, listener):
    node.destroy_node()
ros.shutdown()
"""


def test_clock_jump_is_reported_and_latencies_recover(tmp_path: Path, start: Start) -> None:
    process = start("cyclone", "-c", JUMPING_CLOCK, tmp_path / "log")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    found = records(tmp_path / "log")
    jumps = [number for number, one in enumerate(found) if any("clock was set" in text for text in one["warnings"])]
    assert ["+3600" in found[jumps[0]]["warnings"][0], "-10800" in found[jumps[-1]]["warnings"][0]] == [True, True]
    wrong = {number + after for number in jumps for after in (0, 1)}
    latencies = [
        one["latency (nanoseconds)"] for number, one in enumerate(found) if one["messages"] and number not in wrong
    ]
    assert len(latencies) > 8 and all(0 <= one < 2e9 for one in latencies)
    assert sum(one["lost messages"] or 0 for one in found) == 0


SEND_MALFORMED = r"""
import contextlib, random, time
from scan2sim.services.transport import QoS, load
ros, rng = load(), random.Random(1)
ros.init()
node = ros.Node("rubbish")
publisher = node.create_publisher(ros.message_type("std_msgs/msg/String"), "chatter", QoS())
clock = node.create_publisher(ros.message_type("std_msgs/msg/String"), "monitor_clock", QoS())
while True:
    for bad in (bytes.fromhex("00010000 05000000 fffefdfc 00000000"), b"\0\1\0\0" + rng.randbytes(40), b"\0\1\0\0"):
        with contextlib.suppress(Exception):  # cyclonedds refuses to send some of them
            clock.publish(bad)
            publisher.publish(bad)
    for data in ("good", "[" * 20000, '{"to": "", "from": 1e999, "sent": 1e999}', '{"host": "h", "to": null}', "1"):
        publisher.publish(ros.message("std_msgs/msg/String", data=data))
        clock.publish(ros.message("std_msgs/msg/String", data=data))
    ros.spin_once(node, 0.1)
"""


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_malformed_messages_are_counted_and_harmless(transport: str, tmp_path: Path, start: Start) -> None:
    start("cyclone", "-c", SEND_MALFORMED)
    hears = start(transport, STREAMS, "hear", "6", tmp_path / "log", "chatter:10:1")
    _, errors = hears.communicate(timeout=60)
    assert hears.returncode == 0, errors
    found = [one for one in records(tmp_path / "log") if one["messages"]]
    assert len(found) > 5
    if transport == "cyclone":  # rclpy passes them on as empty messages
        unreadable = sum(one["flows"][0]["unreadable messages"] for one in found)
        assert 10 < unreadable < sum(one["messages"] for one in found) - 10
        assert any("messages are not valid std_msgs/msg/String" in text for one in found for text in one["warnings"])


def test_topic_of_an_unknown_type_is_monitored(tmp_path: Path, start: Start) -> None:
    own = (
        "from rosbags.typesys import get_types_from_msg\n"
        "from scan2sim.services.transport import idl\n"
        "idl.STORE.register(get_types_from_msg('float64 x\\nstring[] names', 'my_msgs/msg/Own'))\n"
        "from scan2sim.services.transport import QoS, load\n"
        "ros = load()\nros.init()\nnode = ros.Node('talker')\n"
        "kind = ros.message_type('my_msgs/msg/Own')\n"
        "publisher = node.create_publisher(kind, 'own', QoS())\n"
        "while True:\n    publisher.publish(ros.message('my_msgs/msg/Own', names=['a', 'b']))\n"
        "    ros.spin_once(node, 0.1)\n"
    )
    start("cyclone", "-c", own)
    watch = start("cyclone", *TOPIC, "own", "nobody", "--log", tmp_path / "log", "--period", "0.5",
                  "--limit", "messages=1", "--limit", "size=1e6")  # fmt: skip
    with pytest.raises(Exception, match="timed out"):
        watch.communicate(timeout=9)
    watch.terminate()
    watch.communicate(timeout=30)
    found = [one for one in records(tmp_path / "log") if one["messages"] > 1]
    assert len(found) > 3
    flow = found[-1]["flows"][0]
    assert (flow["type"], flow["lost messages"]) == ("my_msgs/msg/Own", 0)
    assert 24 < flow["message size mean"] < 50
    assert [text for text in found[-1]["warnings"] if "exceeds the limit 1" in text] == found[-1]["warnings"]


def test_unknown_type_with_rclpy_suggests_the_other_transport(tmp_path: Path, start: Start) -> None:
    program = MONITOR_TOPIC.replace("topics", "type='my_msgs/msg/Own', topics")
    watch = start("rclpy", "-c", program, tmp_path / "log", "own")
    _, errors = watch.communicate(timeout=60)
    assert watch.returncode != 0
    assert "SettingError" in errors and "my_msgs/msg/Own" in errors and "SCAN2SIM_TRANSPORT=cyclone" in errors


@pytest.fixture
def no_kafka() -> Iterator[str]:
    """Address of a server that isn't Kafka."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            while True:
                try:
                    peer, _ = server.accept()
                    peer.recv(1000)
                    peer.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
                    peer.close()
                except OSError:
                    return

        threading.Thread(target=answer, daemon=True).start()
        yield f"127.0.0.1:{server.getsockname()[1]}"


def test_connection_errors_name_their_cause(no_kafka: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kafka, "ACKNOWLEDGE_TIMEOUT_S", 2.0)
    for servers, cause in (
        (no_kafka, "the server there isn't Kafka"),
        ("127.0.0.1:9", "Connection refused"),
        ("nowhere.invalid:9092", "Name or service not known|Temporary failure"),
    ):
        with pytest.raises(ConnectionError, match=rf"no Kafka at {servers} \(({cause})\); check the address"):
            kafka.TopicProducer(kafka.Cluster(servers), "monitor_data").send([OutboxRecord(1, "a:1", b"body")])


@pytest.mark.parametrize("servers", ["", "a b:9092", "http://127.0.0.1:9092", "127.0.0.1:port", "a:1,,b:2", "größe:1"])
def test_malformed_server_addresses_are_rejected(servers: str) -> None:
    with pytest.raises(SettingError, match="HOST:PORT"):
        MonitorParams.of("", {"kafka_bootstrap_servers": servers})


@pytest.mark.parametrize("topic", ["größe", "画像", "a b", "9a", "a//b", "", "/"])
def test_invalid_topic_names_are_rejected(topic: str) -> None:
    for fields in ({"publisher_topic": topic}, {"topics": [topic]}):
        model = TopicParams if "topics" in fields else MonitorParams
        with pytest.raises(SettingError, match="letters a to z"):
            model.of("", fields)


def test_ros_topic_names_are_mapped_to_kafka() -> None:
    assert kafka.topic_name("/robot_1/records") == "robot_1.records"


def test_malformed_events_are_counted_and_logged_sparsely(caplog: pytest.LogCaptureFixture) -> None:
    events, received = Events("me"), list[Any]()
    events.on("alarm", received.append)
    bad = [b"\xff\xfe", b"", b"[]", b"1", b"no JSON", b"[" * 100_000, b'{"schema": "scan2sim-monitor-1"}',
           b'{"schema": "scan2sim-monitor-1", "record id": "x"}', b'{"schema": "scan2sim-event-1"}']  # fmt: skip
    for line in bad * 20:
        events.receive(line)
    assert events.rejections.counts.total() == 180 and not received
    assert len(caplog.records) == 3  # the 1st, the 10th and the 100th
