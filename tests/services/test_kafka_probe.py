"""Readers ask an idle broker less and less often whether it is there, and notice at once that it is gone."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import pytest

pytest.importorskip("confluent_kafka", reason="the extra bus isn't installed")

from scan2sim.services import kafka
from tests.fakes.broker import Broker


@pytest.mark.parametrize(("max_pause", "most"), [(5.0, 5), (1.0, 9)])
def test_an_idle_broker_is_probed_rarely_and_its_end_is_noticed(
    max_pause: float, most: int, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    probes, states, signs = list[float](), list[bool](), list[float]()
    answers: Callable[..., bool] = kafka._answers

    def counted(*arguments: object) -> bool:
        probes.append(time.monotonic())
        return answers(*arguments)

    monkeypatch.setattr(kafka, "_answers", counted)
    bodies = kafka.read(
        broker.cluster, "quiet", group="test", wait=0.1, max_probe_pause=max_pause,
        connected=states.append, reached=lambda: signs.append(time.monotonic()),
    )  # fmt: skip
    end = time.monotonic() + 60
    while not (states and states[-1]) and time.monotonic() < end:
        next(bodies)
    began, before = time.monotonic(), len(probes)
    while time.monotonic() < began + 7:
        next(bodies)
    assert 1 <= len(probes) - before <= most and states[-1], "twice a second would be 14"
    if max_pause == 1.0:
        gaps = [b - a for a, b in itertools.pairwise(signs)]
        assert max(gaps) < 3.0, "alarms count on a sign more often than `OUTAGE_S`"
    broker.kill()
    killed = time.monotonic()
    while states[-1] and time.monotonic() < killed + 60:
        next(bodies)
    assert time.monotonic() - killed < max_pause + 5
    broker.start()
    back = time.monotonic()
    while not states[-1] and time.monotonic() < back + 60:
        next(bodies)
    assert states[-1], "and that it is back"
