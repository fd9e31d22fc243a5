"""An overloaded toolbox (part `load` of `bench.toolboxes`): memory, dropped images, latency, recovery."""

from __future__ import annotations

import os
import queue
import signal
import threading
import time
from collections import Counter
from itertools import count

import numpy as np
import psutil

from scan2sim.services.toolboxes import tasks
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Result, State

BOX = "detect"
OVERLOAD = 5.0
"""Rate of images as a multiple of the toolbox's capacity."""
OVERLOAD_S = 600.0
CAPACITY_IMAGES = 30
"""Number of images, one by one, with which the capacity is measured."""
DEADLINE = 2.0
"""Maximum time to a result in seconds (D3.2, table 7)."""
SETTLE_S = 60.0
"""Seconds after which memory should have stopped growing."""


class _Results:
    """States and latencies of the frames' results."""

    def __init__(self) -> None:
        self.states: Counter[str] = Counter()
        self.latencies: list[float] = []
        self._came = threading.Condition()

    def take(self, result: Result) -> None:
        with self._came:
            self.states[result.state] += 1
            if result.times:
                self.latencies.append(result.times.waited + result.times.worked)
            self._came.notify_all()

    def wait(self, frames: int) -> None:
        with self._came:
            self._came.wait_for(lambda: self.states.total() >= frames)


def load(seconds: float = OVERLOAD_S) -> dict[str, float]:
    """Overload a toolbox, then kill its model.

    Returns:
        overload_memory_growth: relative growth of memory (of all its processes) after the first minute.
        overload_latency_s: largest latency of a result; overload_dropped: share of dropped images.
        recovery_s: from the end of the overload until an image is processed as fast as before.
        ready_false_s, restart_s: from the model's death until it is reported, and until the model is back.
    """
    images = sample_jpegs()
    engine = Engine(BOX, tasks.find(BOX).Params(deadline=DEADLINE))
    try:
        usual = _seconds_per_image(engine, images)
        rate = OVERLOAD / usual
        results, memory = _overload(engine, images, rate, seconds)
        recovered = _recovery(engine, images, usual)
        noticed, restarted = _kill_model(engine, images)
    finally:
        engine.close()
    settled = [used for at, used in memory if at > min(SETTLE_S, seconds / 4)]
    first, last = np.mean(settled[: len(settled) // 5 + 1]), np.mean(settled[-(len(settled) // 5 + 1) :])
    states = results.states
    found = {
        "overload_memory_growth": round(float(last / first - 1), 4),
        "overload_memory_mb": round(max(settled) / 2**20),
        "overload_latency_s": round(max(results.latencies), 3),
        "overload_dropped": round(1 - states[State.DONE] / states.total(), 3),
        "recovery_s": round(recovered, 3),
        "ready_false_s": round(noticed, 3),
        "restart_s": round(restarted, 3),
    }
    print(
        f"{BOX}: {1 / usual:.1f} images per second alone; {rate:.0f} for {seconds:.0f} s: {dict(states)}; {found}",
        flush=True,
    )
    return found


def sample_jpegs() -> list[bytes]:
    """JPEGs of a synthetic street, 1280 pixels wide."""
    import cv2

    from bench.paths import ROOT

    found = []
    for path in sorted((ROOT / "data_samples" / "tile").rglob("*.jpg"))[:8]:
        image = cv2.imread(str(path))
        found.append(cv2.imencode(".jpg", cv2.resize(image, (1280, 720)))[1].tobytes())
    return found


def _seconds_per_image(engine: Engine, images: list[bytes]) -> float:
    """Seconds per image, one by one."""
    began = time.monotonic()
    for i in range(CAPACITY_IMAGES):
        _infer(engine, images[i % len(images)])
    return (time.monotonic() - began) / CAPACITY_IMAGES


def _infer(engine: Engine, picture: bytes) -> tuple[float, Result]:
    """Seconds until the result of one image, and the result."""
    came: queue.Queue[Result] = queue.Queue()
    began = time.monotonic()
    engine.submit(Frame("one", "probe", None, picture, came.put))
    result = came.get()
    return time.monotonic() - began, result


def _overload(
    engine: Engine, images: list[bytes], rate: float, seconds: float
) -> tuple[_Results, list[tuple[float, float]]]:
    results, memory = _Results(), list[tuple[float, float]]()
    began = time.monotonic()
    sampled = began
    for number in count():
        due = began + number / rate
        time.sleep(max(0.0, due - time.monotonic()))
        now = time.monotonic()
        if now - began > seconds:
            break
        engine.submit(Frame(str(number), f"camera {number % 4}", None, images[number % len(images)], results.take))
        if now - sampled > 1:
            sampled = now
            memory.append((now - began, _memory()))
    return results, memory


def _memory() -> float:
    """Memory of this process and the model's, bytes."""
    own = psutil.Process()
    return float(sum(one.memory_info().rss for one in (own, *own.children(recursive=True))))


def _recovery(engine: Engine, images: list[bytes], usual: float) -> float:
    began = time.monotonic()
    while True:
        took, result = _infer(engine, images[0])
        if result.state == State.DONE and took < 2 * usual:
            return time.monotonic() - began


def _kill_model(engine: Engine, images: list[bytes]) -> tuple[float, float]:
    pid = engine.pid()
    assert pid
    began = time.monotonic()
    os.kill(pid, signal.SIGKILL)
    while engine.is_ready():
        time.sleep(0.001)
    noticed = time.monotonic() - began
    while _infer(engine, images[0])[1].state != State.DONE:
        time.sleep(0.01)
    return noticed, time.monotonic() - began


if __name__ == "__main__":
    load(60.0)
