"""A toolbox under more than it can do (part `load` of `bench.toolboxes`): memory, drops, latency, recovery."""

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
TIMES = 5.0
"""More images come than can be worked on."""
SECONDS = 600.0
ALONE = 30
"""Images that the capacity is measured with, one by one."""
DEADLINE = 2.0
"""Seconds that a result may take (D3.2, table 7)."""
SETTLED = 60.0
"""Seconds after which memory should have grown to what it needs."""


class _Account:
    """What became of frames."""

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


def load(seconds: float = SECONDS) -> dict[str, float]:
    """Overload a toolbox, and kill its model.

    Returns:
        overload_memory_growth: share by which memory (of all its processes) grew after the first minute.
        overload_latency_s: of what was answered, at most; overload_dropped: share that was dropped.
        recovery_s: from the flood's end until an image is answered as fast as before it.
        ready_false_s, restart_s: from the model's death until it is told, and until it is back.
    """
    pictures = _pictures()
    engine = Engine(BOX, tasks.find(BOX).Params(deadline=DEADLINE))
    try:
        usual = _alone(engine, pictures)
        rate = TIMES / usual
        account, memory = _flooded(engine, pictures, rate, seconds)
        recovered = _recovery(engine, pictures, usual)
        noticed, restarted = _killed(engine, pictures)
    finally:
        engine.close()
    settled = [used for at, used in memory if at > min(SETTLED, seconds / 4)]
    first, last = np.mean(settled[: len(settled) // 5 + 1]), np.mean(settled[-(len(settled) // 5 + 1) :])
    states = account.states
    found = {
        "overload_memory_growth": round(float(last / first - 1), 4),
        "overload_memory_mb": round(max(settled) / 2**20),
        "overload_latency_s": round(max(account.latencies), 3),
        "overload_dropped": round(1 - states[State.DONE] / states.total(), 3),
        "recovery_s": round(recovered, 3),
        "ready_false_s": round(noticed, 3),
        "restart_s": round(restarted, 3),
    }
    print(
        f"{BOX}: {1 / usual:.1f} images a second alone; {rate:.0f} for {seconds:.0f} s: {dict(states)}; {found}",
        flush=True,
    )
    return found


def _pictures() -> list[bytes]:
    """JPEGs of a synthetic street, 1280 pixels wide."""
    import cv2

    from bench.paths import ROOT

    found = []
    for path in sorted((ROOT / "data_samples" / "tile").rglob("*.jpg"))[:8]:
        image = cv2.imread(str(path))
        found.append(cv2.imencode(".jpg", cv2.resize(image, (1280, 720)))[1].tobytes())
    return found


def _alone(engine: Engine, pictures: list[bytes]) -> float:
    """Seconds an image, one by one."""
    began = time.monotonic()
    for i in range(ALONE):
        _asked(engine, pictures[i % len(pictures)])
    return (time.monotonic() - began) / ALONE


def _asked(engine: Engine, picture: bytes) -> tuple[float, Result]:
    """Seconds that one image takes, and its result."""
    came: queue.Queue[Result] = queue.Queue()
    began = time.monotonic()
    engine.submit(Frame("one", "probe", None, picture, came.put))
    result = came.get()
    return time.monotonic() - began, result


def _flooded(
    engine: Engine, pictures: list[bytes], rate: float, seconds: float
) -> tuple[_Account, list[tuple[float, float]]]:
    account, memory = _Account(), list[tuple[float, float]]()
    began = time.monotonic()
    sampled = began
    for number in count():
        due = began + number / rate
        time.sleep(max(0.0, due - time.monotonic()))
        now = time.monotonic()
        if now - began > seconds:
            break
        engine.submit(Frame(str(number), f"camera {number % 4}", None, pictures[number % len(pictures)], account.take))
        if now - sampled > 1:
            sampled = now
            memory.append((now - began, _memory()))
    return account, memory


def _memory() -> float:
    """Bytes of this process and the model's."""
    own = psutil.Process()
    return float(sum(one.memory_info().rss for one in (own, *own.children(recursive=True))))


def _recovery(engine: Engine, pictures: list[bytes], usual: float) -> float:
    began = time.monotonic()
    while True:
        took, result = _asked(engine, pictures[0])
        if result.state == State.DONE and took < 2 * usual:
            return time.monotonic() - began


def _killed(engine: Engine, pictures: list[bytes]) -> tuple[float, float]:
    pid = engine.pid()
    assert pid
    began = time.monotonic()
    os.kill(pid, signal.SIGKILL)
    while engine.is_ready():
        time.sleep(0.001)
    noticed = time.monotonic() - began
    while _asked(engine, pictures[0])[1].state != State.DONE:
        time.sleep(0.01)
    return noticed, time.monotonic() - began


if __name__ == "__main__":
    load(60.0)
