"""Robustness of nodes: large, malformed and unknown messages, clock jumps, unreachable brokers, invalid settings."""

from __future__ import annotations

import json
import re
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
from tests.fakes.nodes import end_well, flows, json_lines
from tests.services.conftest import Start
from tests.waiting import until

STREAMS = Path(__file__).with_name("streams.py")
TOPIC = ("-m", "scan2sim.flows.cli", "monitor", "topic")
MONITOR_TOPIC = """
import sys
from scan2sim.services.monitoring.node.monitor import ros
from scan2sim.services.monitoring.node.topic_monitor import TopicMonitor
from scan2sim.services.monitoring.settings.monitor import TopicParams
from tests.fakes.nodes import spin_until_closed
ros.init()
node = TopicMonitor(TopicParams(topics=sys.argv[2:], log_file=sys.argv[1], period=0.5))
node.find(60)
spin_until_closed(ros, node)
node.destroy_node()
ros.shutdown()
"""


@pytest.mark.parametrize("transport", ["cyclone", pytest.param("rclpy", marks=pytest.mark.slow)])
def test_messages_of_ten_megabytes_are_monitored_by_nodes_and_topic_monitor(
    transport: str, tmp_path: Path, start: Start
) -> None:
    talks, hears, seen = (tmp_path / name for name in ("talk", "hear", "topic"))
    said = start(transport, STREAMS, "talk", talks, "image:10000000:2")
    heard = start(transport, STREAMS, "hear", hears, "image:10000000:2")
    watch = start(transport, "-c", MONITOR_TOPIC, seen, "image")
    until(lambda: all(sum(flow["messages"] for flow in flows(path, "/image")) >= 5 for path in (hears, seen)))
    end_well(said, heard, watch)
    size = max(flow["message size mean"] for flow in flows(talks, "/image", "outgoing"))
    assert 10_000_000 < size < 10_000_100
    for path in (hears, seen):
        assert max(flow["message size mean"] for flow in flows(path, "/image")) == size


@pytest.mark.parametrize(
    ("transport", "watching"),
    [
        ("cyclone", (STREAMS, "hear")),
        pytest.param("rclpy", (STREAMS, "hear"), marks=pytest.mark.slow),
        pytest.param("cyclone", ("-c", MONITOR_TOPIC), marks=pytest.mark.slow),
    ],
    ids=["inside", "inside rclpy", "outside"],
)
@pytest.mark.realtime
def test_large_topic_does_not_starve_a_small_one(
    transport: str, watching: tuple[str, ...], tmp_path: Path, start: Start
) -> None:
    streams = ("image:6220800:30", "small:100:10")
    topics = streams if "hear" in watching else ("image", "small")
    log = tmp_path / "watch"
    talk = start(transport, STREAMS, "talk", tmp_path / "talk", *streams)
    watch = start(transport, *watching, log, *topics)

    def received(topic: str) -> int:
        return sum(flow["messages"] for flow in flows(log, topic))

    until(lambda: received("/small") > 60 and received("/image") > 60)
    end_well(talk, watch)
    small = flows(log, "/small")
    assert sum(flow["lost messages"] for flow in small) == 0
    assert sum(flow["messages"] for flow in small) == sum(flow["published messages"] for flow in small) > 60


JUMPING_CLOCK = """
import time
now = 1_700_000_000 * 10**9
time.time_ns, time.time = (lambda: now), (lambda: now / 1e9)
from scan2sim.services.monitoring.node import clock_sync
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.transport import QoS

class Elapsed:  # for the clock's synchronization: only as fast as this program says
    elapsed = 0
    time_ns, monotonic = staticmethod(time.time_ns), staticmethod(time.monotonic)
    monotonic_ns = classmethod(lambda cls: cls.elapsed)

clock_sync.time = Elapsed
String = ros.message_type("std_msgs/msg/String")
ros.init()
talker, listener = Monitor("talker", period=3600), Monitor("listener", period=3600)
publisher, received = talker.create_publisher(String, "chatter", QoS()), []
listener.create_subscription(String, "chatter", received.append, QoS())
while not publisher.get_subscription_count():
    ros.spin_once(talker, 0.01)

def exchange(jump=0):
    global now
    publisher.publish(ros.message("std_msgs/msg/String", data="x"))
    expected = len(received) + 1
    now += 10**7 + jump * 10**9
    Elapsed.elapsed += 10**7
    while len(received) < expected:
        ros.spin_once(listener, 0.01)

for jump in (0, 3600, -10800):  # seconds, while a message is on its way
    for number in range(3):
        exchange(0)
        exchange(jump if number == 1 else 0)
        print(listener.record(0.5).json_line(), flush=True)
for node in (talker, listener):
    node.destroy_node()
ros.shutdown()
"""
"""Program whose clock is constant, except that messages take 10 ms, and jumps; prints records of two messages each."""


def test_clock_jump_is_reported_and_latencies_recover(start: Start) -> None:
    (output,) = end_well(start("cyclone", "-c", JUMPING_CLOCK))
    found = [json.loads(line) for line in output.splitlines()]
    jumps = {number: one["warnings"] for number, one in enumerate(found) if one["warnings"]}
    warning = "this machine's clock was set by {:+.3f} s; latencies of this period are wrong"
    assert jumps == {4: [warning.format(3600)], 7: [warning.format(-10800)]}
    latencies = [one["latency (nanoseconds)"] for one in found]
    assert latencies.pop(7) == 10**7, "the other message; that of the jump arrives before it was sent"
    assert latencies.pop(4) == 10**7 + 1800 * 10**9
    assert latencies == [10**7] * 7
    assert [one["messages"] for one in found] == [2] * 9 and not any(one["lost messages"] for one in found)


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
    hears = start(transport, STREAMS, "hear", tmp_path / "log", "chatter:10:1")

    def found() -> list[dict[str, Any]]:
        return [one for one in json_lines(tmp_path / "log") if one["messages"]]

    until(lambda: len(found()) > 5 and sum(one["messages"] for one in found()) > 50)
    end_well(hears)
    if transport == "cyclone":  # rclpy passes them on as empty messages
        unreadable = sum(one["flows"][0]["unreadable messages"] for one in found())
        assert 10 < unreadable < sum(one["messages"] for one in found()) - 10
        assert any("messages are not valid std_msgs/msg/String" in text for one in found() for text in one["warnings"])


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

    def records() -> list[dict[str, Any]]:
        return [one for one in json_lines(tmp_path / "log") if one["messages"] > 1]

    until(lambda: len(records()) > 3)
    watch.terminate()
    end_well(watch)
    found = records()
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


@pytest.mark.parametrize(
    ("servers", "cause"),
    [
        ("", "the server there isn't Kafka"),
        ("127.0.0.1:9", "Connection refused"),
        ("nowhere.invalid:9092", "Name or service not known|Temporary failure in name resolution"),
    ],
)
def test_connection_errors_name_their_cause(
    servers: str, cause: str, no_kafka: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kafka, "ACKNOWLEDGE_TIMEOUT_S", 0.5)
    servers = servers or no_kafka
    producer = kafka.TopicProducer(kafka.Cluster(servers), "monitor_data")

    def message() -> str:
        with pytest.raises(ConnectionError) as caught:
            producer.send([OutboxRecord(1, "a:1", b"body")])
        return str(caught.value)

    known = until(lambda: one if "no answer" not in (one := message()) else "", what="a cause")
    assert re.fullmatch(rf"no Kafka at {servers} \(({cause})\); check the address. The connection is retried", known)


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
