"""Traffic meter: messages, bytes, losses and latencies per period."""

from __future__ import annotations

from scan2sim.services.monitoring.meter import Flow, Meter
from scan2sim.services.transport import Arrival


def arrival(
    number: int | None = None, *, publisher: bytes | None = b"p", sent: int | None = 0, size: int = 10
) -> Arrival:
    return Arrival(topic="/t", size=size, received=1000, sent=sent, publisher=publisher, number=number)


def test_counters_restart_every_period() -> None:
    meter = Meter(window=10)
    meter.published("/out", 100)
    meter.published("/out", 300)
    meter.received(arrival(1, size=50))
    first, second = meter.read(), meter.read()
    assert first.outgoing == {"/out": Flow(2, 400)}
    assert first.outgoing["/out"].mean() == 200
    assert first.incoming["/t"].flow == Flow(1, 50)
    assert second.outgoing == {"/out": Flow(0, 0)}
    assert second.incoming["/t"].flow == Flow(0, 0)
    assert second.incoming["/t"].latencies == ()


def test_losses_are_counted_per_publisher_in_any_order_of_arrival() -> None:
    meter = Meter(window=10)
    for publisher, numbers in ((b"a", [5, 6, 9, 8]), (b"b", [1, 4])):
        for number in numbers:
            meter.received(arrival(number, publisher=publisher))
    found = meter.read().incoming["/t"]
    assert (found.flow.messages, found.sent, found.lost) == (6, 9, 3)  # 7 of a, 2 and 3 of b
    meter.received(arrival(10, publisher=b"a"))
    meter.received(arrival(8, publisher=b"b"))
    found = meter.read().incoming["/t"]
    assert (found.sent, found.lost) == (5, 3)  # over the border between two periods: 5, 6 and 7 of b


def test_restarted_publisher_counts_no_losses() -> None:
    meter = Meter(window=10)
    for publisher, number in ((b"before", 5), (b"before", 6), (b"before", 9), (b"after", 1), (b"after", 2)):
        meter.received(arrival(number, publisher=publisher))
    found = meter.read().incoming["/t"]
    assert (found.flow.messages, found.sent, found.lost) == (5, 7, 2)


def test_losses_are_unknown_without_sequence_numbers() -> None:
    meter = Meter(window=10)
    meter.received(arrival(1))
    meter.received(arrival(None, publisher=None))
    found = meter.read().incoming["/t"]
    assert (found.flow.messages, found.sent, found.lost) == (2, None, None)


def test_latencies_are_those_of_the_latest_messages() -> None:
    meter = Meter(window=3)
    for sent in (0, 100, 200, 300, 400):
        meter.received(arrival(1, sent=sent))
    assert meter.read().incoming["/t"].latencies == (800, 700, 600)


def test_source_timestamps_far_in_the_future_are_discarded() -> None:
    meter = Meter(window=3)
    meter.received(arrival(1, sent=10**12))  # a clock that jumped
    meter.received(arrival(2, sent=None))
    meter.received(arrival(3, sent=1500))  # clocks differ a little
    assert meter.read().incoming["/t"].latencies == (-500,)
