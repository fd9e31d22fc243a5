"""Every frame gets one answer: overload, missed deadlines, damaged images, a model that fails, dies or hangs."""

from __future__ import annotations

import io
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import MAX_PIXELS, Frame, Raw
from scan2sim.services.toolboxes.results import Result, State
from scan2sim.services.toolboxes.settings import ToolboxParams
from tests.services.toolboxes import shaky
from tests.services.toolboxes.shaky import DIES, FAILS, HANGS, RAISES, SLOW, SLOWER, image, level_of

TASK = shaky.__name__


class Client:
    """Submits frames and waits for their results."""

    def __init__(self, engine: Engine) -> None:
        self.engine, self.results = engine, list[Result]()
        self._changed = threading.Condition()
        self._sent = 0

    def send(self, picture: U8 | bytes | Raw, source: str = "camera", **more: Any) -> None:
        self._sent += 1
        self.engine.submit(Frame(str(self._sent), source, self._sent, picture, self._take, **more))

    def _take(self, result: Result) -> None:
        with self._changed:
            self.results.append(result)
            self._changed.notify_all()

    def wait(self) -> list[Result]:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.results) >= self._sent, 30)
        return sorted(self.results, key=lambda one: int(one.id))

    def one(self, picture: U8 | bytes | Raw) -> Result:
        self.send(picture)
        return self.wait()[-1]


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    made = Engine(TASK, ToolboxParams(waiting=4, deadline=10, hangs=1))
    yield made
    made.close()


@pytest.fixture
def client(engine: Engine) -> Client:
    return Client(engine)


def encoded(kind: str, picture: U8) -> bytes:
    out = io.BytesIO()
    Image.fromarray(picture).save(out, kind)
    return out.getvalue()


def test_result_has_id_stamp_source_and_size_of_the_frame(client: Client) -> None:
    result = client.one(image(7, (4, 6)))
    assert (result.id, result.stamp, result.source, result.size) == ("1", 1, "camera", (6, 4))
    assert result.state == State.DONE and level_of(result.body) == 7 and result.times and result.times.worked > 0


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_encoded_images_are_decoded(client: Client, kind: str) -> None:
    assert abs(level_of(client.one(encoded(kind, image(90, (16, 16)))).body) - 90) <= 1


@pytest.mark.parametrize(
    ("encoding", "pixel", "expected"),
    [
        ("rgb8", (10, 20, 30), 20), ("bgr8", (10, 20, 30), 20), ("rgba8", (10, 20, 30, 99), 20),
        ("mono8", (50,), 50), ("mono16", (0, 50), 50), ("bayer_rggb8", (60,), 60),
    ],
)  # fmt: skip
def test_ros_image_encodings_are_converted(
    client: Client, encoding: str, pixel: tuple[int, ...], expected: int
) -> None:
    row = bytes(pixel) * 8 + b"padding"
    assert level_of(client.one(Raw(row * 8, 8, 8, encoding, len(row))).body) == expected


def test_damaged_images_are_rejected_and_the_next_is_processed(client: Client) -> None:
    whole = encoded("JPEG", np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    huge = encoded("PNG", np.zeros((20_000, 2_000, 3), np.uint8))
    assert MAX_PIXELS < 20_000 * 2_000
    bad: list[bytes | Raw] = [
        whole[: len(whole) // 2], b"", b"GIF89a", huge, Raw(b"", 0, 0, "rgb8", 0), Raw(b"12", 8, 8, "rgb8", 24),
        Raw(bytes(192), 8, 8, "32FC1", 32), Raw(b"", 20_000, 20_000, "rgb8", 60_000),
    ]  # fmt: skip
    for picture in bad:
        result = client.one(picture)
        assert result.state == State.REFUSED and result.error
    assert client.one(image(5)).state == State.DONE


def test_overload_drops_the_oldest_frames_of_that_source_only(client: Client) -> None:
    for _ in range(20):
        client.send(image(SLOW), "flooding")
    client.send(image(3), "quiet")
    results = client.wait()
    assert results[-1].state == State.DONE
    states = [one.state for one in results[:-1]]
    assert State.DROPPED in states and states[-4:] == [State.DONE] * 4


def test_frame_past_its_deadline_is_late(client: Client) -> None:
    client.send(image(3), received=time.monotonic() - 60)
    assert client.wait()[0].state == State.LATE


def test_model_is_tried_again_after_a_slow_batch() -> None:
    engine = Engine(TASK, ToolboxParams(deadline=0.5))
    try:
        client = Client(engine)
        assert client.one(image(SLOWER)).state == State.DONE
        assert State.DONE in [client.one(image(1)).state for _ in range(20)]
    finally:
        engine.close()


@pytest.mark.parametrize("level", [FAILS, RAISES])
def test_failure_of_the_model_is_reported_and_the_next_frame_processed(client: Client, level: int) -> None:
    result = client.one(image(level))
    assert result.state == State.FAILED and result.error
    assert client.one(image(1)).state == State.DONE


@pytest.mark.parametrize("level", [DIES, HANGS])
def test_model_that_dies_or_hangs_is_restarted(client: Client, level: int) -> None:
    restarts = client.engine.counts["restarts"]
    assert client.one(image(level)).state == State.FAILED
    assert client.one(image(1)).state == State.DONE
    assert client.engine.counts["restarts"] > restarts


def test_killed_model_is_not_ready_until_restarted_and_no_frame_is_lost(client: Client) -> None:
    assert client.one(image(1)).state == State.DONE
    pid = client.engine.pid()
    assert pid
    for _ in range(3):
        client.send(image(SLOW))
    os.kill(pid, signal.SIGKILL)
    deadline = time.monotonic() + 1
    while client.engine.is_ready() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not client.engine.is_ready()
    assert [one.state for one in client.wait()] == [State.DONE] * 4 and client.engine.is_ready()


def test_fatal_image_does_not_affect_the_others_of_its_batch() -> None:
    engine = Engine(TASK, ToolboxParams(batch=4, linger=1, waiting=8, deadline=30))
    try:
        client = Client(engine)
        for level in (1, DIES, 2, FAILS):
            client.send(image(level))
        assert [one.state for one in client.wait()] == [State.DONE, State.FAILED, State.DONE, State.FAILED]
    finally:
        engine.close()


def test_closing_the_engine_answers_waiting_frames() -> None:
    engine = Engine(TASK, ToolboxParams(waiting=100, deadline=30))
    client = Client(engine)
    for _ in range(30):
        client.send(image(SLOW))
    engine.close()
    assert {one.state for one in client.wait()} <= {State.DONE, State.DROPPED}


def test_closing_the_engine_does_not_wait_for_a_hanging_model() -> None:
    engine = Engine(TASK, ToolboxParams(hangs=3600))
    client = Client(engine)
    client.send(image(HANGS))
    time.sleep(0.5)
    began = time.monotonic()
    engine.close()
    assert client.wait()[0].state == State.FAILED and time.monotonic() - began < 20


def test_unknown_toolbox_is_rejected() -> None:
    with pytest.raises(SettingError, match="unknown value 'paint'"):
        Engine("paint", ToolboxParams())


def test_weights_that_may_contain_code_are_rejected(tmp_path: Path) -> None:
    from scan2sim.pipeline.core.errors import InputError
    from scan2sim.services.toolboxes.tasks import classify

    pickled = tmp_path / "model.pt"
    pickled.write_bytes(b"\x80\x04.")
    with pytest.raises(InputError, match="may contain code"):
        Engine("classify", classify.Params(weights=pickled))
