"""What is large, broken or unknown harms no node, and is told."""

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
from scan2sim.services.monitoring.settings.monitor import TopicParams, Watched
from scan2sim.services.outbox import Kept
from tests.services.conftest import Start

STREAMS = Path(__file__).with_name("streams.py")
TOPIC = ("-m", "scan2sim.flows.cli", "monitor", "topic")
WATCH = """
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
def test_messages_of_ten_megabytes_are_watched_from_inside_and_outside(
    transport: str, tmp_path: Path, start: Start
) -> None:
    talks, hears, seen = (tmp_path / name for name in ("talk", "hear", "topic"))
    heard = start(transport, STREAMS, "hear", "12", hears, "image:10000000:2")
    watch = start(transport, "-c", WATCH, seen, "image")
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
        pytest.param("cyclone", ("-c", WATCH), marks=pytest.mark.slow),
    ],
    ids=["inside", "inside rclpy", "outside"],
)
def test_a_large_topic_crowds_no_small_one_out(
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


JUMPS = """
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


def test_a_clock_that_jumps_is_told_and_latencies_are_right_again(tmp_path: Path, start: Start) -> None:
    process = start("cyclone", "-c", JUMPS, tmp_path / "log")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    found = records(tmp_path / "log")
    jumps = [number for number, one in enumerate(found) if any("clock was set" in text for text in one["remarks"])]
    assert ["+3600" in found[jumps[0]]["remarks"][0], "-10800" in found[jumps[-1]]["remarks"][0]] == [True, True]
    wrong = {number + after for number in jumps for after in (0, 1)}
    latencies = [
        one["latency (nanoseconds)"] for number, one in enumerate(found) if one["messages"] and number not in wrong
    ]
    assert len(latencies) > 8 and all(0 <= one < 2e9 for one in latencies)
    assert sum(one["lost messages"] or 0 for one in found) == 0


RUBBISH = r"""
import contextlib, random, time
from scan2sim.services.transport import QoS, load
ros, drawn = load(), random.Random(1)
ros.init()
node = ros.Node("rubbish")
publisher = node.create_publisher(ros.message_type("std_msgs/msg/String"), "chatter", QoS())
clock = node.create_publisher(ros.message_type("std_msgs/msg/String"), "monitor_clock", QoS())
while True:
    for bad in (bytes.fromhex("00010000 05000000 fffefdfc 00000000"), b"\0\1\0\0" + drawn.randbytes(40), b"\0\1\0\0"):
        with contextlib.suppress(Exception):  # some of it cyclonedds doesn't even send
            clock.publish(bad)
            publisher.publish(bad)
    for data in ("good", "[" * 20000, '{"to": "", "from": 1e999, "sent": 1e999}', '{"host": "h", "to": null}', "1"):
        publisher.publish(ros.message("std_msgs/msg/String", data=data))
        clock.publish(ros.message("std_msgs/msg/String", data=data))
    ros.spin_once(node, 0.1)
"""


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_messages_that_cannot_be_read_harm_no_node(transport: str, tmp_path: Path, start: Start) -> None:
    start("cyclone", "-c", RUBBISH)
    hears = start(transport, STREAMS, "hear", "6", tmp_path / "log", "chatter:10:1")
    _, errors = hears.communicate(timeout=60)
    assert hears.returncode == 0, errors
    found = [one for one in records(tmp_path / "log") if one["messages"]]
    assert len(found) > 5
    if transport == "cyclone":  # rclpy hands them on as if they were empty
        unreadable = sum(one["flows"][0]["unreadable messages"] for one in found)
        assert 10 < unreadable < sum(one["messages"] for one in found) - 10
        assert any("messages are no std_msgs/msg/String" in text for one in found for text in one["remarks"])


def test_a_topic_of_a_type_that_is_not_known_is_watched(tmp_path: Path, start: Start) -> None:
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
    assert [text for text in found[-1]["remarks"] if "is over its limit, 1" in text] == found[-1]["remarks"]


def test_rclpy_says_what_to_do_about_a_type_that_is_not_known(tmp_path: Path, start: Start) -> None:
    watch = start("rclpy", "-c", WATCH.replace("topics", "type='my_msgs/msg/Own', topics"), tmp_path / "log", "own")
    _, errors = watch.communicate(timeout=60)
    assert watch.returncode != 0
    assert "SettingError" in errors and "my_msgs/msg/Own" in errors and "SCAN2SIM_TRANSPORT=cyclone" in errors


@pytest.fixture
def no_kafka() -> Iterator[str]:
    """The address of what answers, but is no Kafka."""
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


def test_a_broker_that_is_none_is_told_by_cause(no_kafka: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kafka, "ACKNOWLEDGED_WITHIN", 2.0)
    for servers, cause in (
        (no_kafka, "what answers there is no Kafka"),
        ("127.0.0.1:9", "Connection refused"),
        ("nowhere.invalid:9092", "Name or service not known|Temporary failure"),
    ):
        with pytest.raises(ConnectionError, match=rf"no Kafka at {servers} \(({cause})\); check the address"):
            kafka.Topic(servers, "monitor_data").send([Kept(1, "a:1", b"body")])


@pytest.mark.parametrize("servers", ["", "a b:9092", "http://127.0.0.1:9092", "127.0.0.1:port", "a:1,,b:2", "größe:1"])
def test_an_address_that_can_be_none_is_refused(servers: str) -> None:
    with pytest.raises(SettingError, match="HOST:PORT"):
        Watched.of("", {"kafka_bootstrap_servers": servers})


@pytest.mark.parametrize("topic", ["größe", "画像", "a b", "9a", "a//b", "", "/"])
def test_names_that_ros_has_not_are_refused(topic: str) -> None:
    for fields in ({"publisher_topic": topic}, {"topics": [topic]}):
        model = TopicParams if "topics" in fields else Watched
        with pytest.raises(SettingError, match="letters a to z"):
            model.of("", fields)


def test_names_of_ros_are_names_in_kafka() -> None:
    assert kafka.topic_name("/robot_1/records") == "robot_1.records"


def test_what_is_no_event_is_counted_and_harms_nothing(caplog: pytest.LogCaptureFixture) -> None:
    events, taken = Events("me"), list[Any]()
    events.on("alarm", taken.append)
    bad = [b"\xff\xfe", b"", b"[]", b"1", b"no JSON", b"[" * 100_000, b'{"schema": "scan2sim-monitor-1"}',
           b'{"schema": "scan2sim-monitor-1", "record id": "x"}', b'{"schema": "scan2sim-event-1"}']  # fmt: skip
    for line in bad * 20:
        events.take(line)
    assert events.malformed == 180 and not taken
    assert len(caplog.records) == 3  # the 1st, the 10th and the 100th
