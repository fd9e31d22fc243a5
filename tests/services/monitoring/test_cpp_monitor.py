"""The C++ monitor: its records are read by Python's nodes, and agree with theirs about the same messages."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from scan2sim.services.monitoring.dashboard.history import History
from scan2sim.services.monitoring.record import Record
from tests.conftest import ROOT
from tests.fakes.nodes import end_well, wait_until_ready
from tests.services.conftest import Start
from tests.waiting import until

HEADERS = ROOT / "services/monitoring/cpp"
SOURCE = Path(__file__).with_name("monitored.cpp")
READER = """
import sys
from scan2sim.services.monitoring.node.monitor import Monitor, RECORDS_QOS, ros
from scan2sim.services.transport import QoS
from tests.fakes.nodes import spin_until_closed
String = ros.message_type("std_msgs/msg/String")

ros.init()
role, kept = sys.argv[1], QoS(depth=1000)  # nothing is lost if a node stalls for 20 s
node = Monitor("python_" + role, namespace="/robot", period=0.5, publisher_topic="/records")
reader = ros.Node("reader")
reader.create_subscription(String, "/records", lambda message: print(message.data, flush=True), RECORDS_QOS)
reader.create_subscription(String, "/robot/monitor_data", lambda message: print(message.data, flush=True), RECORDS_QOS)
if role == "listener":
    node.create_subscription(String, "/chatter", lambda message: None, kept)
else:
    publisher = node.create_publisher(String, "/chatter", kept)
    text = ros.message("std_msgs/msg/String", data="x" * 991)
    node.create_timer(0.02, lambda: publisher.publish(text))
spin_until_closed(ros, node, reader)
node.destroy_node()
ros.shutdown()
"""
WARNINGS = ("-Wall", "-Wextra", "-Werror")


@pytest.fixture(scope="module")
def monitored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled nodes of the C++ monitor, over Fast DDS."""
    if not shutil.which("g++") or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("Fast DDS isn't installed (tests/services/packages.txt)")
    program = tmp_path_factory.mktemp("cpp") / "monitored"
    headers = "-I", HEADERS, "-isystem", "/usr/include/fastdds"
    subprocess.run(
        ["g++", "-std=c++17", *WARNINGS, *headers, "-o", program, SOURCE, "-lfastrtps", "-lfastcdr"], check=True
    )
    return program


@pytest.mark.parametrize("role", ["talker", "listener"])
@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_records_of_cpp_nodes_agree_with_those_of_python(
    transport: str, role: str, monitored: Path, start: Start, tmp_path: Path, domain: str
) -> None:
    other = "listener" if role == "talker" else "talker"
    python = start(transport, "-c", READER, other)
    wait_until_ready(python)
    records: list[Record] = []

    def of(name: str) -> list[Record]:
        return [one for one in records if one.node_name == name]

    def is_complete() -> bool:
        assert python.stdout
        records.append(Record.model_validate_json(python.stdout.readline()))
        sent, received = of(f"cpp_{role}"), of(f"python_{other}")
        if role == "listener":
            sent, received = received, sent
        matched = [one for one in of(f"cpp_{role}") if one.publishers == one.subscribers == 1]
        counts = sum(one.out_messages for one in sent), sum(one.in_messages for one in received)
        return len(matched) > 5 and min(counts) > 50

    with subprocess.Popen(
        [monitored, role], env=os.environ | {"ROS_DOMAIN_ID": domain}, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as cpp:  # fmt: skip
        try:
            until(is_complete, what="records")
            (count,) = map(int, end_well(cpp))
        finally:
            cpp.kill()
    (rest,) = end_well(python)
    records += [Record.model_validate_json(line) for line in rest.splitlines()]
    ours, theirs = of(f"cpp_{role}"), of(f"python_{other}")
    assert len(ours) > 5 and len({one.id for one in ours}) == len(ours), "a record per period"
    assert {one.node_namespace for one in ours} == {"/robot"} and {tuple(one.topics) for one in ours} == {("/chatter",)}
    sent, received = (ours, theirs) if role == "talker" else (theirs, ours)
    published, arrived = sum(one.out_messages for one in sent), sum(one.in_messages for one in received)
    own = published if role == "talker" else arrived
    assert 50 < own <= count, "all but those before its records were subscribed to"
    assert arrived > 50
    flows = [flow for one in received for flow in one.flows if flow.messages]
    assert {flow.size for one in (*ours, *theirs) for flow in one.flows if flow.messages} == {1000.0}
    assert {flow.type for flow in flows} == {"std_msgs/msg/String"}
    assert all(flow.latency is not None and abs(flow.latency) < 5e9 for flow in flows)
    if role == "listener" or transport == "rclpy":
        assert {flow.lost for flow in flows} == {0}
    last = [one for one in ours if one.publishers == one.subscribers == 1][-1]
    assert last.cpu_times["user"] > 0 and 0 < last.virtual_memory["percent"] < 100 and 0 < last.disk_usage[3] < 100
    (topic,) = last.endpoints
    (endpoint,) = topic.publishers or topic.subscriptions
    assert endpoint.node_name == f"cpp_{role}" and endpoint.qos.reliability == "RELIABLE" and len(endpoint.gid) == 16
    page = History(0.0)
    for one in ours:
        page.add(one.json_line().encode())
    assert page.shown == len(ours) and not page.rejections.counts, "the page takes them"
