"""Worker that processes the latest item: others are replaced, failures don't end it."""

from __future__ import annotations

import threading

import pytest

from scan2sim.services.world_camera.latest_worker import LatestWorker
from tests.waiting import until


def test_items_that_wait_are_replaced_by_newer_ones() -> None:
    begun, released, done = threading.Event(), threading.Event(), list[int]()

    def job(item: int) -> None:
        begun.set()
        assert released.wait(60)
        done.append(item)

    worker = LatestWorker(job, "test")
    worker.put(1)
    assert begun.wait(60)
    for item in (2, 3, 4):
        worker.put(item)
    released.set()
    until(lambda: done == [1, 4])
    assert worker.replaced == 2
    worker.close()


def test_a_failure_does_not_end_it(caplog: pytest.LogCaptureFixture) -> None:
    done: list[int] = []

    def job(item: int) -> None:
        if item == 1:
            raise RuntimeError("broken")
        done.append(item)

    worker = LatestWorker(job, "renderer")
    worker.put(1)
    until(lambda: "broken" in caplog.text)
    worker.put(2)
    until(lambda: done == [2])
    worker.close()
