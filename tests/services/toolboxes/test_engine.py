"""Every frame gets one answer: overload, missed deadlines, damaged images, a model that fails, dies or hangs."""

from __future__ import annotations

import io
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes import engine as engine_module
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import MAX_PIXELS, Frame, Raw
from scan2sim.services.toolboxes.results import Result, State
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.worker import ModelProcess, ModelProcessDied
from tests.fakes.virtual_clock import VirtualClock
from tests.services.toolboxes import shaky
from tests.services.toolboxes.model_wait import ModelWait
from tests.services.toolboxes.shaky import DIES, FAILS, HANGS, RAISES, SLOW, image, level_of
from tests.waiting import until

TASK = shaky.__name__


NO_DEADLINE_S = 600.0


class Client:
    """Submits frames and waits for their results."""

    def __init__(self, engine: Engine, clock: Callable[[], float] = time.monotonic) -> None:
        self.engine, self.results, self.clock = engine, list[Result](), clock
        self._changed = threading.Condition()
        self._sent = 0

    def send(self, picture: U8 | bytes | Raw, source: str = "camera", **more: Any) -> None:
        self._sent += 1
        more = {"received": self.clock(), **more}
        self.engine.submit(Frame(str(self._sent), source, self._sent, picture, self._take, **more))

    def _take(self, result: Result) -> None:
        with self._changed:
            self.results.append(result)
            self._changed.notify_all()

    def wait(self) -> list[Result]:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.results) >= self._sent, 120)
        return sorted(self.results, key=lambda one: int(one.id))

    def one(self, picture: U8 | bytes | Raw) -> Result:
        self.send(picture)
        return self.wait()[-1]


@pytest.fixture(scope="module")
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture(scope="module")
def wait(clock: VirtualClock, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModelWait]:
    hangs = tmp_path_factory.mktemp("engine") / "hangs"
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(shaky.HANGS_FILE, str(hangs))
        yield ModelWait(clock, hangs)


@pytest.fixture(scope="module")
def engine(clock: VirtualClock, wait: ModelWait) -> Iterator[Engine]:
    made = Engine(TASK, ToolboxParams(waiting=4, deadline=10, hangs=60), clock=clock, wait=wait)
    yield made
    made.close()


@pytest.fixture
def client(engine: Engine, clock: VirtualClock) -> Client:
    return Client(engine, clock)


def encoded(kind: str, picture: U8) -> bytes:
    out = io.BytesIO()
    Image.fromarray(picture).save(out, kind)
    return out.getvalue()


def test_result_has_id_stamp_source_and_size_of_the_frame(client: Client, wait: ModelWait) -> None:
    wait.took = [0.01]
    result = client.one(image(7, (4, 6)))
    assert (result.id, result.stamp, result.source, result.size) == ("1", 1, "camera", (6, 4))
    assert result.state == State.DONE and level_of(result.body) == 7 and result.times
    assert result.times.worked == pytest.approx(0.01)


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
        assert result.state == State.REJECTED and result.error
    assert client.one(image(5)).state == State.DONE


def test_overload_drops_the_oldest_frames_of_that_source_only(client: Client, wait: ModelWait) -> None:
    wait.hold()
    client.send(image(2), "flooding")
    until(lambda: client.engine.waiting()[0] == 0)  # the model processes it
    for _ in range(20):
        client.send(image(2), "flooding")
    client.send(image(3), "quiet")
    wait.release()
    states = [one.state for one in client.wait()]
    assert states == [State.DONE, *[State.DROPPED] * 16, *[State.DONE] * 4, State.DONE]


def test_frame_past_its_deadline_is_late(client: Client, clock: VirtualClock) -> None:
    client.send(image(3), received=clock() - 10.1)
    client.send(image(4), received=clock() - 9.9)
    assert [one.state for one in client.wait()] == [State.LATE, State.DONE]


def test_model_is_tried_again_after_a_slow_batch(clock: VirtualClock, wait: ModelWait) -> None:
    engine = Engine(TASK, ToolboxParams(deadline=0.5), clock=clock, wait=wait)
    try:
        client = Client(engine, clock)
        wait.took = [2.0]
        assert client.one(image(1)).state == State.DONE
        # 2 s are predicted, and 0.8 times that after each late frame
        assert [client.one(image(1)).state for _ in range(8)] == [State.LATE] * 7 + [State.DONE]
    finally:
        engine.close()


@pytest.mark.parametrize("level", [FAILS, RAISES])
def test_failure_of_the_model_is_reported_and_the_next_frame_processed(client: Client, level: int) -> None:
    result = client.one(image(level))
    assert result.state == State.FAILED and result.error
    assert client.one(image(1)).state == State.DONE


@pytest.mark.parametrize(("level", "limits"), [(DIES, []), (HANGS, [60.0, 60.0])])
def test_model_that_dies_or_hangs_is_restarted(
    client: Client, wait: ModelWait, level: int, limits: list[float]
) -> None:
    restarts, wait.limits = client.engine.counts["restarts"], []
    assert client.one(image(level)).state == State.FAILED
    assert client.one(image(1)).state == State.DONE
    assert client.engine.counts["restarts"] > restarts and wait.limits == limits


def test_killed_model_is_not_ready_until_restarted_and_no_frame_is_lost(client: Client, wait: ModelWait) -> None:
    assert client.one(image(1)).state == State.DONE
    pid = client.engine.pid()
    assert pid
    wait.hold()
    for _ in range(3):
        client.send(image(1))
    os.kill(pid, signal.SIGKILL)
    until(lambda: not client.engine.is_ready())
    wait.release()
    assert [one.state for one in client.wait()] == [State.DONE] * 4 and client.engine.is_ready()


def test_model_that_exceeds_its_limit_in_real_time_is_killed() -> None:
    process = ModelProcess(TASK, ToolboxParams(hangs=5))
    try:
        with pytest.raises(ModelProcessDied, match="didn't respond within 5 s"):
            process.infer([image(HANGS)])
        until(lambda: not process.is_alive())
    finally:
        process.close()


def test_fatal_image_does_not_affect_the_others_of_its_batch() -> None:
    engine = Engine(TASK, ToolboxParams(batch=4, linger=1, waiting=8, deadline=NO_DEADLINE_S))
    try:
        client = Client(engine)
        for level in (1, DIES, 2, FAILS):
            client.send(image(level))
        assert [one.state for one in client.wait()] == [State.DONE, State.FAILED, State.DONE, State.FAILED]
    finally:
        engine.close()


def test_closing_the_engine_answers_waiting_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module, "STOP_TIMEOUT_S", 120.0)
    engine = Engine(TASK, ToolboxParams(waiting=100, deadline=NO_DEADLINE_S))
    client = Client(engine)
    for _ in range(30):
        client.send(image(SLOW))
    engine.close()
    assert {one.state for one in client.wait()} <= {State.DONE, State.DROPPED}


def test_closing_the_engine_does_not_wait_for_a_hanging_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(shaky.HANGS_FILE, str(tmp_path / "hangs"))
    engine = Engine(TASK, ToolboxParams(hangs=3600))
    client = Client(engine)
    client.send(image(HANGS), deadline=NO_DEADLINE_S)
    until((tmp_path / "hangs").exists)
    engine.close()
    assert client.wait()[0].state == State.FAILED


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
