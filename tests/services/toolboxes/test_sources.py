"""Folders, videos and cameras as sources: in order, drawn, and a camera that vanishes comes back."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.services.toolboxes import offline, sources
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.sources import Cameras
from tests.services.toolboxes import shaky

BOX = shaky.__name__


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    made = Engine(BOX, ToolboxParams(deadline=offline.PATIENT))
    yield made
    made.close()


def film(path: Path, levels: list[int]) -> Path:
    """One frame a level, ten a second."""
    import cv2

    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 24))
    for level in levels:
        writer.write(shaky.image(level, (24, 32)))
    writer.release()
    return path


def levels(out: Path) -> list[int]:
    lines = [json.loads(line) for line in (out / offline.RESULTS).open()]
    return [round(int(one["body"]["classes"][0]["label"]), -1) for one in lines if one["state"] == "done"]


def test_a_folders_pictures_are_worked_on_in_order_and_drawn(engine: Engine, tmp_path: Path) -> None:
    for level in (30, 10, 20):
        Image.fromarray(shaky.image(level)).save(tmp_path / f"{level}.png")
    (tmp_path / "notes.txt").write_text("no picture", encoding="utf-8")
    (tmp_path / "25.jpg").write_bytes(b"broken")
    ended = offline.work_through(engine, tmp_path, tmp_path / "out", silent)
    assert ended == {"done": 3, "refused": 1} and levels(tmp_path / "out") == [10, 20, 30]
    assert sorted(one.name for one in (tmp_path / "out" / offline.PICTURES).iterdir()) == ["10.jpg", "20.jpg", "30.jpg"]


def test_a_video_becomes_results_with_its_times_and_a_film(engine: Engine, tmp_path: Path) -> None:
    wanted = [10 * i for i in range(15)]
    path = film(tmp_path / "video.avi", wanted)
    offline.work_through(engine, path, tmp_path / "out", silent)
    assert levels(tmp_path / "out") == wanted
    stamps = [json.loads(line)["stamp"] for line in (tmp_path / "out" / offline.RESULTS).open()]
    assert np.allclose(np.diff(stamps), 1e8)
    assert sources.count(tmp_path / "out" / offline.FILM) == 15


@pytest.mark.parametrize("name", ["nowhere", "empty", "broken.mp4"])
def test_what_holds_no_images_is_told(engine: Engine, tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.mp4").write_bytes(b"no film")
    with pytest.raises(InputError, match=name):
        offline.work_through(engine, tmp_path / name, tmp_path / "out", silent)


def test_a_camera_that_vanishes_comes_back_and_standby_reads_nothing(engine: Engine, tmp_path: Path) -> None:
    path = tmp_path / "camera.avi"
    cameras = Cameras(engine, [str(path)])
    cameras.start()
    try:
        time.sleep(0.5)
        assert cameras.running() and not cameras.states()[str(path)]["there"]
        film(path, [50] * 5)  # a file that ends is a camera that is gone, and there again

        def images() -> int:
            return int(cameras.states()[str(path)]["images"])

        deadline = time.monotonic() + 20
        while images() < 11 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert images() >= 11 and cameras.states()[str(path)]["there"]
        assert abs(shaky.level_of(cameras.last()[0].body) - 50) < 3 and cameras.last("other") == []
        cameras.stop()
        count = images()
        time.sleep(0.3)
        assert images() == count and not cameras.running() and cameras.last() == []
        cameras.start()
        while images() == count and time.monotonic() < deadline:
            time.sleep(0.05)
        assert images() > count
    finally:
        cameras.stop()
