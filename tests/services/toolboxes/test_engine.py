"""Every frame gets one answer, whatever comes: floods, late ones, damaged ones, a model that fails, dies or hangs."""

from __future__ import annotations

import io
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import LARGEST, Frame, Raw
from scan2sim.services.toolboxes.results import Result, State
from scan2sim.services.toolboxes.settings import ToolboxParams
from tests.services.toolboxes import shaky
from tests.services.toolboxes.shaky import DIES, FAILS, HANGS, RAISES, SLOW, SLOWER, image, level_of

BOX = shaky.__name__


class Sent:
    """Sends frames, and waits for what became of them."""

    def __init__(self, engine: Engine) -> None:
        self.engine, self.results = engine, list[Result]()
        self._came = threading.Condition()
        self._sent = 0

    def send(self, picture: U8 | bytes | Raw, source: str = "camera", **more: float) -> None:
        self._sent += 1
        self.engine.submit(Frame(str(self._sent), source, self._sent, picture, self._take, **more))

    def _take(self, result: Result) -> None:
        with self._came:
            self.results.append(result)
            self._came.notify_all()

    def wait(self) -> list[Result]:
        with self._came:
            assert self._came.wait_for(lambda: len(self.results) >= self._sent, 30)
        return sorted(self.results, key=lambda one: int(one.id))

    def one(self, picture: U8 | bytes | Raw) -> Result:
        self.send(picture)
        return self.wait()[-1]


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    made = Engine(BOX, ToolboxParams(waiting=4, deadline=10, hangs=1))
    yield made
    made.close()


@pytest.fixture
def sent(engine: Engine) -> Sent:
    return Sent(engine)


def encoded(kind: str, picture: U8) -> bytes:
    out = io.BytesIO()
    Image.fromarray(picture).save(out, kind)
    return out.getvalue()


def test_a_result_has_the_frames_id_stamp_source_and_size(sent: Sent) -> None:
    result = sent.one(image(7, (4, 6)))
    assert (result.id, result.stamp, result.source, result.size) == ("1", 1, "camera", (6, 4))
    assert result.state == State.DONE and level_of(result.body) == 7 and result.times and result.times.worked > 0


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_encoded_images_are_decoded(sent: Sent, kind: str) -> None:
    assert abs(level_of(sent.one(encoded(kind, image(90, (16, 16)))).body) - 90) <= 1


@pytest.mark.parametrize(
    ("encoding", "pixel", "expected"),
    [
        ("rgb8", (10, 20, 30), 20), ("bgr8", (10, 20, 30), 20), ("rgba8", (10, 20, 30, 99), 20),
        ("mono8", (50,), 50), ("mono16", (0, 50), 50), ("bayer_rggb8", (60,), 60),
    ],
)  # fmt: skip
def test_images_of_ros_are_converted(sent: Sent, encoding: str, pixel: tuple[int, ...], expected: int) -> None:
    row = bytes(pixel) * 8 + b"padding"
    assert level_of(sent.one(Raw(row * 8, 8, 8, encoding, len(row))).body) == expected


def test_damaged_images_are_refused_and_the_next_is_worked_on(sent: Sent) -> None:
    whole = encoded("JPEG", np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    huge = encoded("PNG", np.zeros((20_000, 2_000, 3), np.uint8))
    assert LARGEST < 20_000 * 2_000
    bad: list[bytes | Raw] = [
        whole[: len(whole) // 2], b"", b"GIF89a", huge, Raw(b"", 0, 0, "rgb8", 0), Raw(b"12", 8, 8, "rgb8", 24),
        Raw(bytes(192), 8, 8, "32FC1", 32), Raw(b"", 20_000, 20_000, "rgb8", 60_000),
    ]  # fmt: skip
    for picture in bad:
        result = sent.one(picture)
        assert result.state == State.REFUSED and result.error
    assert sent.one(image(5)).state == State.DONE


def test_a_flood_drops_each_sources_oldest_alone(sent: Sent) -> None:
    for _ in range(20):
        sent.send(image(SLOW), "flooding")
    sent.send(image(3), "quiet")
    results = sent.wait()
    assert results[-1].state == State.DONE
    states = [one.state for one in results[:-1]]
    assert State.DROPPED in states and states[-4:] == [State.DONE] * 4


def test_a_frame_whose_deadline_has_passed_is_told_so(sent: Sent) -> None:
    sent.send(image(3), received=time.monotonic() - 60)
    assert sent.wait()[0].state == State.LATE


def test_a_model_that_was_slow_once_is_tried_again() -> None:
    engine = Engine(BOX, ToolboxParams(deadline=0.5))
    try:
        sent = Sent(engine)
        assert sent.one(image(SLOWER)).state == State.DONE
        assert State.DONE in [sent.one(image(1)).state for _ in range(20)]
    finally:
        engine.close()


@pytest.mark.parametrize("level", [FAILS, RAISES])
def test_a_model_that_fails_says_why_and_goes_on(sent: Sent, level: int) -> None:
    result = sent.one(image(level))
    assert result.state == State.FAILED and result.error
    assert sent.one(image(1)).state == State.DONE


@pytest.mark.parametrize("level", [DIES, HANGS])
def test_a_model_that_dies_or_hangs_over_an_image_is_started_anew(sent: Sent, level: int) -> None:
    restarts = sent.engine.counts["restarts"]
    assert sent.one(image(level)).state == State.FAILED
    assert sent.one(image(1)).state == State.DONE
    assert sent.engine.counts["restarts"] > restarts


def test_a_killed_model_isnt_ready_until_it_is_back_and_nothing_is_lost(sent: Sent) -> None:
    assert sent.one(image(1)).state == State.DONE
    pid = sent.engine.pid()
    assert pid
    for _ in range(3):
        sent.send(image(SLOW))
    os.kill(pid, signal.SIGKILL)
    deadline = time.monotonic() + 1
    while sent.engine.is_ready() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not sent.engine.is_ready()
    assert [one.state for one in sent.wait()] == [State.DONE] * 4 and sent.engine.is_ready()


def test_one_image_that_kills_spoils_no_other_of_its_batch() -> None:
    engine = Engine(BOX, ToolboxParams(batch=4, linger=1, waiting=8, deadline=30))
    try:
        sent = Sent(engine)
        for level in (1, DIES, 2, FAILS):
            sent.send(image(level))
        assert [one.state for one in sent.wait()] == [State.DONE, State.FAILED, State.DONE, State.FAILED]
    finally:
        engine.close()


def test_a_toolbox_that_ends_answers_what_waits() -> None:
    engine = Engine(BOX, ToolboxParams(waiting=100, deadline=30))
    sent = Sent(engine)
    for _ in range(30):
        sent.send(image(SLOW))
    engine.close()
    assert {one.state for one in sent.wait()} <= {State.DONE, State.DROPPED}


def test_a_model_that_hangs_holds_nobody_up_who_ends_the_toolbox() -> None:
    engine = Engine(BOX, ToolboxParams(hangs=3600))
    sent = Sent(engine)
    sent.send(image(HANGS))
    time.sleep(0.5)
    began = time.monotonic()
    engine.close()
    assert sent.wait()[0].state == State.FAILED and time.monotonic() - began < 20


def test_there_is_no_such_toolbox() -> None:
    with pytest.raises(SettingError, match="there is no 'paint'"):
        Engine("paint", ToolboxParams())


def test_weights_that_may_hold_code_are_refused(tmp_path: Path) -> None:
    from scan2sim.pipeline.core.errors import InputError
    from scan2sim.services.toolboxes.tasks import classify

    pickled = tmp_path / "model.pt"
    pickled.write_bytes(b"\x80\x04.")
    with pytest.raises(InputError, match="may hold code"):
        Engine("classify", classify.Params(weights=pickled))
