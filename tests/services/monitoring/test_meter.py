"""What is counted of messages that pass."""

from __future__ import annotations

from scan2sim.services.monitoring.node.meter import Flow, Meter
from scan2sim.services.transport import Arrival


def arrival(
    number: int | None = None, *, publisher: bytes | None = b"p", sent: int | None = 0, size: int = 10
) -> Arrival:
    return Arrival(topic="/t", size=size, received=1000, sent=sent, publisher=publisher, number=number)


def test_flows_are_of_the_period_alone() -> None:
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


def test_losses_are_counted_by_publisher_whatever_the_order() -> None:
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


def test_a_publisher_that_starts_anew_loses_nothing_by_it() -> None:
    meter = Meter(window=10)
    for publisher, number in ((b"before", 5), (b"before", 6), (b"before", 9), (b"after", 1), (b"after", 2)):
        meter.received(arrival(number, publisher=publisher))
    found = meter.read().incoming["/t"]
    assert (found.flow.messages, found.sent, found.lost) == (5, 7, 2)


def test_losses_are_unknown_where_a_publisher_numbers_nothing() -> None:
    meter = Meter(window=10)
    meter.received(arrival(1))
    meter.received(arrival(None, publisher=None))
    found = meter.read().incoming["/t"]
    assert (found.flow.messages, found.sent, found.lost) == (2, None, None)


def test_latencies_are_the_windows_last() -> None:
    meter = Meter(window=3)
    for sent in (0, 100, 200, 300, 400):
        meter.received(arrival(1, sent=sent))
    assert meter.read().incoming["/t"].latencies == (800, 700, 600)


def test_a_time_of_sending_from_the_future_is_no_latency() -> None:
    meter = Meter(window=3)
    meter.received(arrival(1, sent=10**12))  # a clock that jumped
    meter.received(arrival(2, sent=None))
    meter.received(arrival(3, sent=1500))  # clocks differ a little
    assert meter.read().incoming["/t"].latencies == (-500,)
