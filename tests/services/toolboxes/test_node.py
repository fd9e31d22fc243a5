"""Toolbox as a ROS 2 node: images on a topic in, results on a topic out, with both transports."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

pytest.importorskip("cyclonedds", reason="the extra bus isn't installed")

from tests.services.conftest import Start
from tests.services.toolboxes import camera, shaky
from tests.waiting import until

TASK = shaky.__name__


@pytest.mark.parametrize("transport", ["cyclone", "rclpy"])
@pytest.mark.parametrize("compressed", [False, True], ids=["raw", "compressed"])
def test_node_publishes_results_for_images_of_a_topic(
    start: Start, transport: str, compressed: bool, tmp_path: Path
) -> None:
    picture = tmp_path / "picture.png"
    Image.fromarray(shaky.image(90, (12, 16))).save(picture)
    command = ["-m", "scan2sim.flows.cli", "toolbox", "node", TASK, "--images", "/front", "--results", "/seen"]
    start("cyclone", *command, *(["--compressed"] if compressed else []))
    sender = start(transport, Path(camera.__file__), "/front", "/seen", "3", *([picture] if compressed else []))
    lines, errors = sender.communicate(timeout=240)
    results = [json.loads(line) for line in lines.splitlines()]
    assert len(results) >= 3, errors
    for one in results:
        number, rest = divmod(one["stamp"], 10**9)
        assert rest == 5 and one["source"] == "/front" and one["size"] == [16, 12]
        assert int(one["body"]["classes"][0]["label"]) == (90 if compressed else 10 * number % 200)


def test_node_is_monitored(start: Start, tmp_path: Path) -> None:
    log = tmp_path / "records.log"
    command = ["-m", "scan2sim.flows.cli", "toolbox", "node", TASK, "--images", "/a", "--results", "/b"]
    start("cyclone", *command, "--log", log, "--period", "0.5")
    sender = start("cyclone", Path(camera.__file__), "/a", "/b", "20")
    sender.communicate(timeout=240)

    def flows() -> set[tuple[str, str]]:
        """Topics and directions of the messages in the log, which its process still writes."""
        text = log.read_text(encoding="utf-8")
        records = map(json.loads, text[: text.rfind("\n") + 1].splitlines())
        return {(one["topic"], one["direction"]) for record in records for one in record["flows"] if one["messages"]}

    until(lambda: {("/a", "incoming"), ("/b", "outgoing")} <= flows())
