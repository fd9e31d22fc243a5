"""Camera node: images of files and cameras on a topic, in order, at a rate, with time stamps."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cyclonedds", reason="the extra bus isn't installed")

from scan2sim.services.toolboxes.settings import IMAGE
from tests.fakes.ports import free_port
from tests.services.conftest import Start
from tests.services.toolboxes import hearing, shaky
from tests.services.toolboxes.test_sources import film

COMMAND = ("-m", "scan2sim.flows.cli", "toolbox")
LEVELS = [10, 40, 70, 100, 130]
STRING = "std_msgs/msg/String"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder with one image per grey level, sorted by name."""
    made = tmp_path / "pictures"
    made.mkdir()
    for number, level in enumerate(LEVELS):
        Image.fromarray(shaky.image(level, (12, 16))).save(made / f"{number}.png")
    return made


def lines(process: Any) -> list[dict[str, Any]]:
    """Messages that a subscriber has received."""
    output, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    return [json.loads(line) for line in output.splitlines()]


@pytest.mark.realtime
def test_images_of_a_folder_are_published_in_order_at_the_rate(start: Start, folder: Path) -> None:
    began = time.time()
    listener = start("cyclone", Path(hearing.__file__), "/front", IMAGE, "5")
    camera = start("cyclone", *COMMAND, "camera", folder, "/front", "--rate", "5", "--subscribers", "1")
    heard = lines(listener)
    assert [one["level"] for one in heard] == LEVELS
    assert {(one["width"], one["height"], one["step"], one["encoding"]) for one in heard} == {(16, 12, 48, "rgb8")}
    stamps = np.array([one["stamp"] for one in heard])
    assert began < stamps[0] and stamps[-1] < time.time()
    assert np.median(np.diff(stamps)) == pytest.approx(0.2, abs=0.05)
    assert camera.wait(60) == 0, "it exits at the end of the folder"


@pytest.mark.realtime
def test_video_is_looped(start: Start, tmp_path: Path) -> None:
    listener = start("cyclone", Path(hearing.__file__), "/front", IMAGE, "8")
    start(
        "cyclone", *COMMAND, "camera", film(tmp_path / "f.avi", [20, 90, 160]), "/front", "--loop", "--subscribers", "1"
    )
    levels = [one["level"] for one in lines(listener)]
    assert np.allclose(levels, [20, 90, 160, 20, 90, 160, 20, 90], atol=6)


@pytest.mark.realtime
def test_stream_is_published_at_the_given_rate(start: Start, tmp_path: Path) -> None:
    listener = start("cyclone", Path(hearing.__file__), "/front", IMAGE, "5")
    stream = film(tmp_path / "f.avi", [20, 90, 160]).as_uri()  # is read at full speed, and again after its end
    start("cyclone", *COMMAND, "camera", stream, "/front", "--rate", "5", "--subscribers", "1")
    heard = lines(listener)
    assert all(min(abs(one["level"] - known) for known in (20, 90, 160)) <= 6 for one in heard)
    assert np.median(np.diff([one["stamp"] for one in heard])) == pytest.approx(0.2, abs=0.08)


def test_toolbox_node_processes_images_of_a_camera_node(start: Start, folder: Path) -> None:
    listener = start("cyclone", Path(hearing.__file__), "/seen", STRING, "6")
    node = ("node", shaky.__name__, "--images", "/front", "--results", "/seen", "--compressed")
    start("cyclone", *COMMAND, *node)
    start("cyclone", *COMMAND, "camera", folder, "/front", "--compressed", "--loop", "--rate", "5")
    began = time.time()
    for one in lines(listener):
        level = int(one["body"]["classes"][0]["label"])
        assert one["source"] == "/front" and min(abs(level - known) for known in LEVELS) <= 2
        assert abs(one["stamp"] * 1e-9 - began) < 60


def test_records_and_logs_of_an_unreachable_camera_hold_no_credentials(start: Start) -> None:
    address = f"rtsp://admin:hunter2@127.0.0.1:{free_port()}/live?token=s3cret"
    camera = start("cyclone", *COMMAND, "camera", address, "/front", "--console", "--period", "0.2")
    (limit := threading.Timer(120, camera.kill)).start()
    assert camera.stderr
    output = ""
    while "delivers no images" not in output or output.count('"record id"') < 3:
        line = camera.stderr.readline()
        assert line, output
        output += line
    limit.cancel()
    assert "rtsp://***@127.0.0.1" in output and "hunter2" not in output and "s3cret" not in output


def test_missing_folder_is_rejected_at_once(start: Start, tmp_path: Path) -> None:
    camera = start("cyclone", *COMMAND, "camera", tmp_path / "none", "/front")
    _, errors = camera.communicate(timeout=120)
    assert camera.returncode and "not found" in errors
