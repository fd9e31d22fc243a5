"""Readers ask an idle broker less and less often whether it is there, and notice that it has gone."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

pytest.importorskip("confluent_kafka", reason="the extra bus isn't installed")

from scan2sim.services import kafka
from scan2sim.services.monitoring.events.broker_contact import OUTAGE_S
from tests.fakes.broker import Broker

POLL_S = 0.1


def probe_times(max_pause: float, seconds: float) -> Iterator[float]:
    """Times at which an idle broker that answers is probed, with a poll every `POLL_S`."""
    now = 0.0
    probe = kafka._Probe(max_pause, clock=lambda: now)
    while now < seconds:
        if probe.is_due():
            probe.succeeded()
            yield now
        now += POLL_S


def test_idle_broker_is_probed_rarely() -> None:
    times = list(probe_times(kafka.MAX_PROBE_PAUSE_S, 60.0))
    pauses = [b - a for a, b in itertools.pairwise(times)]
    assert pauses[0] <= kafka.FIRST_PROBE_PAUSE_S + 2 * POLL_S
    assert pauses == sorted(pauses) or max(abs(a - b) for a, b in itertools.pairwise(pauses[4:])) < 2 * POLL_S
    assert len(times) < 20, "twice a second would be 120"


def test_probes_with_a_short_maximum_pause_are_frequent_enough_for_alarms() -> None:
    times = list(probe_times(1.0, 60.0))
    assert max(b - a for a, b in itertools.pairwise(times)) <= 1.0 + 2 * POLL_S < OUTAGE_S


def test_unreachable_broker_is_probed_at_every_poll() -> None:
    now = 0.0
    probe = kafka._Probe(5.0, clock=lambda: now)
    for _ in range(10):
        probe.succeeded()
    assert not probe.is_due()
    probe.failed()
    assert probe.is_due()


def test_end_and_restart_of_a_broker_are_noticed(broker: Broker) -> None:
    states, signs = list[bool](), list[None]()
    bodies = kafka.read(
        broker.cluster, "quiet", group="test", wait=0.1, max_probe_pause=1.0,
        connected=states.append, reached=lambda: signs.append(None),
    )  # fmt: skip

    def read_until(connected: bool) -> None:
        while not states or states[-1] is not connected:
            next(bodies)

    read_until(True)
    seen = len(signs)
    while len(signs) == seen:  # a probe of the idle broker
        next(bodies)
    assert states[-1]
    broker.kill()
    read_until(False)
    broker.start()
    read_until(True)


def test_consumer_that_does_not_close_does_not_stop_the_program(caplog: pytest.LogCaptureFixture) -> None:
    never = threading.Event()
    kafka._close(SimpleNamespace(close=never.wait), timeout=0.1)
    never.set()
    assert "did not close" in caplog.text
