"""Interoperability of both transports and of another DDS vendor, with the metadata that monitoring needs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.transport import load
from tests.fakes.nodes import end_well, wait_until_ready
from tests.services.conftest import Start
from tests.waiting import until

CROSSING = Path(__file__).with_name("crossing.py")
KINDS = {"String", "Bool", "Image", "Imu", "PointCloud2", "Float64MultiArray"}
ENOUGH = 11
"""Messages of each type after which a node has received enough."""


def report(process: subprocess.Popen[str], is_complete: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first report of a node, a line of JSON, that is complete."""
    wait_until_ready(process)
    latest: dict[str, Any] = {}

    def is_found() -> bool:
        nonlocal latest
        assert process.stdout
        latest = json.loads(process.stdout.readline())
        return is_complete(latest)

    until(is_found, what="messages", state=lambda: latest)
    return latest


@pytest.mark.parametrize(("first", "second"), [("cyclone", "cyclone"), ("rclpy", "cyclone"), ("rclpy", "rclpy")])
def test_messages_of_all_types_are_exchanged_between_transports(first: str, second: str, start: Start) -> None:
    running = [start(first, CROSSING, "one", "two"), start(second, CROSSING, "two", "one")]
    transports = [(first, second), (second, first)]
    results = []
    for (me, other), process, name in zip(transports, running, ("node_two", "node_one"), strict=True):
        has_names = not (me == "rclpy" and other == "cyclone")  # there, rclpy doesn't find the name of the node
        publisher = {"node": name} if has_names else {}

        def is_complete(found: dict[str, Any], publisher: dict[str, str] = publisher) -> bool:
            counts = [one["count"] for one in found["heard"].values()]
            are_known = [one | publisher == one for one in found["endpoints"]]
            return len(counts) == len(KINDS) and min(counts) >= ENOUGH and are_known == [True]

        results.append(report(process, is_complete))
    end_well(*running)
    for (me, other), found in zip(transports, results, strict=True):
        assert set(found["heard"]) == KINDS
        assert found["text"] == "Straße, 画像"
        assert all(abs(one["latency"]) < 5 for one in found["heard"].values())  # the source timestamp is valid
        # rclpy numbers all messages for rclpy; cyclonedds those of unbounded types, for both
        numbered = {kind for kind, one in found["heard"].items() if one["numbered"]}
        if me == "rclpy":
            assert numbered == set(found["heard"])
        elif other == "cyclone":
            assert numbered == {"String", "Image", "Imu", "PointCloud2", "Float64MultiArray"}
        assert [one["type"] for one in found["endpoints"]] == ["std_msgs/msg/String"]


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled program that uses another vendor's DDS."""
    program = tmp_path_factory.mktemp("peer") / "peer"
    if not shutil.which("g++") or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("Fast DDS isn't installed (tests/services/packages.txt)")
    source = Path(__file__).with_name("peer.cpp")
    subprocess.run(["g++", "-std=c++17", "-o", program, source, "-lfastrtps", "-lfastcdr"], check=True)
    return program


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
def test_messages_are_exchanged_with_another_dds_vendor(transport: str, start: Start, peer: Path, domain: str) -> None:
    node = start(transport, CROSSING, "one", "two")
    with subprocess.Popen(
        [peer, "two", "one"], env=os.environ | {"ROS_DOMAIN_ID": domain}, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as other:  # fmt: skip
        try:
            theirs = report(other, lambda found: found["count"] >= ENOUGH)
            mine = report(node, lambda found: found["heard"].get("String", {"count": 0})["count"] >= ENOUGH)
            end_well(node, other)
        finally:
            other.kill()
    assert theirs["text"] == mine["text"] == "Straße, 画像"
    assert abs(mine["heard"]["String"]["latency"]) < 5  # the source timestamp is valid


def test_unknown_transport_lists_available_ones() -> None:
    with pytest.raises(SettingError, match="rclpy, cyclone"):
        load("carrier pigeon")


def test_type_of_unknown_definition_is_rejected() -> None:
    with pytest.raises(SettingError, match="my_msgs/msg/Own"):
        load("cyclone").message_type("my_msgs/msg/Own")
