"""Image sources: folders, videos, cameras with reconnection; drawn results."""

from __future__ import annotations

import json
import threading
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
from scan2sim.services.toolboxes.sources import CameraReader, Cameras
from tests.fakes.virtual_clock import VirtualClock
from tests.services.toolboxes import shaky
from tests.waiting import until

TASK = shaky.__name__


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    made = Engine(TASK, ToolboxParams(deadline=offline.OFFLINE_DEADLINE_S))
    yield made
    made.close()


def film(path: Path, levels: list[int]) -> Path:
    """Video with one frame per grey level, ten per second."""
    import cv2

    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 24))
    for level in levels:
        writer.write(shaky.image(level, (24, 32)))
    writer.release()
    return path


def levels(out: Path) -> list[int]:
    lines = [json.loads(line) for line in (out / offline.RESULTS_FILE).open()]
    return [round(int(one["body"]["classes"][0]["label"]), -1) for one in lines if one["state"] == "done"]


def test_images_of_a_folder_are_processed_in_order_and_drawn(engine: Engine, tmp_path: Path) -> None:
    for level in (30, 10, 20):
        Image.fromarray(shaky.image(level)).save(tmp_path / f"{level}.png")
    (tmp_path / "notes.txt").write_text("no picture", encoding="utf-8")
    (tmp_path / "25.jpg").write_bytes(b"broken")
    ended = offline.process_files(engine, tmp_path, tmp_path / "out", silent)
    assert ended == {"done": 3, "rejected": 1} and levels(tmp_path / "out") == [10, 20, 30]
    drawn = sorted(one.name for one in (tmp_path / "out" / offline.IMAGES_FOLDER).iterdir())
    assert drawn == ["10.jpg", "20.jpg", "30.jpg"]


def test_images_that_cant_be_written_are_an_error(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.fromarray(shaky.image(10)).save(tmp_path / "10.png")
    monkeypatch.setattr("cv2.imwrite", lambda *_: False)  # a full disk
    with pytest.raises(OSError, match="No space left"):
        offline.process_files(engine, tmp_path, tmp_path / "out", silent)


def test_video_gives_results_with_time_stamps_and_a_video(engine: Engine, tmp_path: Path) -> None:
    expected = [10 * i for i in range(15)]
    path = film(tmp_path / "video.avi", expected)
    offline.process_files(engine, path, tmp_path / "out", silent)
    assert levels(tmp_path / "out") == expected
    stamps = [json.loads(line)["stamp"] for line in (tmp_path / "out" / offline.RESULTS_FILE).open()]
    assert np.allclose(np.diff(stamps), 1e8)
    assert sources.count(tmp_path / "out" / offline.VIDEO_FILE) == 15


@pytest.mark.parametrize("name", ["nowhere", "empty", "broken.mp4"])
def test_sources_without_images_are_rejected(engine: Engine, tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.mp4").write_bytes(b"no film")
    with pytest.raises(InputError, match=name):
        offline.process_files(engine, tmp_path / name, tmp_path / "out", silent)


def test_camera_is_reconnected_and_not_read_in_standby(
    engine: Engine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "camera.avi"
    cameras = Cameras(engine, [str(path)])

    def images() -> int:
        return int(cameras.states()[str(path)]["images"])

    def is_available() -> bool:
        return bool(cameras.states()[str(path)]["connected"])

    def is_read() -> bool:
        return any(thread.name == str(path) for thread in threading.enumerate())

    cameras.start()
    try:
        until(lambda: "delivers no images" in caplog.text)
        assert cameras.running() and not is_available()
        # the end of the file acts as a lost camera, reading it again as a reconnection
        film(tmp_path / "new.avi", [50] * 5).rename(path)
        until(lambda: images() >= 11 and is_available())
        until(cameras.last)
        assert abs(shaky.level_of(cameras.last()[0].body) - 50) < 3 and cameras.last("other") == []
        cameras.stop()
        assert not cameras.running() and cameras.last() == []
        until(lambda: not is_read())
        count = images()
        cameras.start()
        until(lambda: images() > count)
    finally:
        cameras.stop()


def test_camera_is_retried_after_growing_pauses_and_unavailable_after_a_timeout(tmp_path: Path) -> None:
    path, clock = tmp_path / "camera.avi", VirtualClock()
    attempts: list[tuple[float, bool]] = []

    def wait(stopped: threading.Event, pause: float) -> bool:
        attempts.append((pause, reader.is_available()))
        clock.sleep(pause)
        if len(attempts) == 8:
            film(path, [50] * 3)
        if len(attempts) == 10:
            path.unlink()
        if len(attempts) == 17:
            stopped.set()
        return stopped.is_set()

    images: list[object] = []
    reader = CameraReader(str(path), images.append, clock=clock, wait=wait)
    reader.start()
    until(lambda: len(attempts) == 17 and not reader.running())
    reader.stop()
    pauses = [pause for pause, _ in attempts]
    assert pauses == pytest.approx([0, 0.2, 0.4, 0.8, 1.6, 3.2, 5, 5, 0.2, 0.2, 0.4, 0.8, 1.6, 3.2, 5, 5, 5])
    # its last image, at the 10th attempt, is 5 s old during the 14th pause
    assert [available for _, available in attempts] == [False] * 8 + [True] * 6 + [False] * 3
    assert len(images) == reader.count == 6
