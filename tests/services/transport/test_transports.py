"""Interoperability of both transports and of another DDS vendor, with the metadata that monitoring needs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.transport import load
from tests.services.conftest import Start

CROSSING = Path(__file__).with_name("crossing.py")
SECONDS = "8"


@pytest.mark.parametrize(("first", "second"), [("cyclone", "cyclone"), ("rclpy", "cyclone"), ("rclpy", "rclpy")])
def test_messages_of_all_types_are_exchanged_between_transports(first: str, second: str, start: Start) -> None:
    running = [start(first, CROSSING, "one", "two", SECONDS), start(second, CROSSING, "two", "one", SECONDS)]
    results = []
    for process in running:
        out, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
        results.append(json.loads(out.splitlines()[-1]))
    for (me, other), found in zip([(first, second), (second, first)], results, strict=True):
        assert set(found["heard"]) == {"String", "Bool", "Image", "Imu", "PointCloud2", "Float64MultiArray"}
        assert min(one["count"] for one in found["heard"].values()) > 10
        assert found["text"] == "Straße, 画像"
        assert all(abs(one["latency"]) < 5 for one in found["heard"].values())  # the source timestamp is valid
        # rclpy numbers all messages for rclpy; cyclonedds those of unbounded types, for both
        numbered = {kind for kind, one in found["heard"].items() if one["numbered"]}
        if me == "rclpy":
            assert numbered == set(found["heard"])
        elif other == "cyclone":
            assert numbered == {"String", "Image", "Imu", "PointCloud2", "Float64MultiArray"}
        publishers = found["endpoints"]
        assert [one["type"] for one in publishers] == ["std_msgs/msg/String"]
        if not (me == "rclpy" and other == "cyclone"):  # there, rclpy doesn't find the name of the node
            assert publishers[0]["node"] == ("node_two" if found is results[0] else "node_one")


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
    node = start(transport, CROSSING, "one", "two", SECONDS)
    other = subprocess.run(
        [peer, "two", "one", SECONDS], env=os.environ | {"ROS_DOMAIN_ID": domain}, capture_output=True, timeout=60
    )
    theirs = json.loads(other.stdout)
    out, errors = node.communicate(timeout=60)
    assert node.returncode == 0, errors
    mine = json.loads(out.splitlines()[-1])
    assert theirs["text"] == mine["text"] == "Straße, 画像"
    assert theirs["count"] > 10 and mine["heard"]["String"]["count"] > 10
    assert abs(mine["heard"]["String"]["latency"]) < 5  # the source timestamp is valid


def test_unknown_transport_lists_available_ones() -> None:
    with pytest.raises(SettingError, match="rclpy, cyclone"):
        load("carrier pigeon")


def test_type_of_unknown_definition_is_rejected() -> None:
    with pytest.raises(SettingError, match="my_msgs/msg/Own"):
        load("cyclone").message_type("my_msgs/msg/Own")
