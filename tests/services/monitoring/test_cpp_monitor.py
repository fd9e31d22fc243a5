"""The C++ monitor: its records are read by Python's nodes, and agree with theirs about the same messages."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from scan2sim.services.monitoring.dashboard.history import History
from scan2sim.services.monitoring.record import Record
from tests.conftest import ROOT
from tests.services.conftest import Start

HEADERS = ROOT / "services/monitoring/cpp"
SOURCE = Path(__file__).with_name("monitored.cpp")
READER = """
import pathlib, sys
from scan2sim.services.monitoring.node.monitor import Monitor, RECORDS_QOS, ros
String = ros.message_type("std_msgs/msg/String")

ros.init()
stop, role = pathlib.Path(sys.argv[1]), sys.argv[2]
node = Monitor("python_" + role, namespace="/robot", period=0.5, publisher_topic="/records")
reader = ros.Node("reader")
reader.create_subscription(String, "/records", lambda message: print(message.data, flush=True), RECORDS_QOS)
reader.create_subscription(String, "/robot/monitor_data", lambda message: print(message.data, flush=True), RECORDS_QOS)
if role == "listener":
    node.create_subscription(String, "/chatter", lambda message: None, 10)
else:
    publisher = node.create_publisher(String, "/chatter", 10)
    text = ros.message("std_msgs/msg/String", data="x" * 991)
    node.create_timer(0.02, lambda: publisher.publish(text))
print("ready", flush=True)
while not stop.exists():
    ros.spin_once(node, 0.02)
    ros.spin_once(reader, 0.0)
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
    script = tmp_path / "reader.py"
    script.write_text(READER, encoding="utf-8")
    other = "listener" if role == "talker" else "talker"
    python = start(transport, script, tmp_path / "stop", other)
    assert python.stdout and python.stdout.readline() == "ready\n"
    cpp = subprocess.run(
        [monitored, role, "8"], env=os.environ | {"ROS_DOMAIN_ID": domain}, capture_output=True, timeout=60, text=True
    )
    assert cpp.returncode == 0, cpp.stderr
    time.sleep(1.0)  # for the last record
    (tmp_path / "stop").touch()
    out, errors = python.communicate(timeout=60)
    assert python.returncode == 0, errors
    records = [Record.model_validate(json.loads(line)) for line in out.splitlines()]
    ours = [one for one in records if one.node_name == f"cpp_{role}"]
    theirs = [one for one in records if one.node_name == f"python_{other}"]
    assert len(ours) > 5 and len({one.id for one in ours}) == len(ours), "a record per period"
    assert {one.node_namespace for one in ours} == {"/robot"} and {tuple(one.topics) for one in ours} == {("/chatter",)}
    sent, received = (ours, theirs) if role == "talker" else (theirs, ours)
    published, arrived = sum(one.out_messages for one in sent), sum(one.in_messages for one in received)
    count = int(cpp.stdout)
    own = published if role == "talker" else arrived
    assert 50 < own <= count, "all but those before its records were subscribed to"
    assert arrived > 50
    flows = [flow for one in received for flow in one.flows if flow.messages]
    assert {flow.size for one in (*ours, *theirs) for flow in one.flows if flow.messages} == {1000.0}
    assert {flow.type for flow in flows} == {"std_msgs/msg/String"}
    assert all(flow.latency is not None and abs(flow.latency) < 1e9 for flow in flows)
    if role == "listener" or transport == "rclpy":
        assert {flow.lost for flow in flows} == {0}
    last = ours[-2]
    assert last.cpu_times["user"] > 0 and 0 < last.virtual_memory["percent"] < 100 and 0 < last.disk_usage[3] < 100
    (topic,) = last.endpoints
    (endpoint,) = topic.publishers or topic.subscriptions
    assert endpoint.node_name == f"cpp_{role}" and endpoint.qos.reliability == "RELIABLE" and len(endpoint.gid) == 16
    assert ours[-3].publishers == ours[-3].subscribers == 1
    page = History(0.0)
    for one in ours:
        page.add(one.json_line().encode())
    assert page.shown == len(ours) and not page.rejections.counts, "the page takes them"
