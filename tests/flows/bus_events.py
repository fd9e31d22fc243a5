"""Events that programs have published on a Kafka broker."""

from __future__ import annotations

from collections.abc import Callable

from scan2sim.services import kafka
from scan2sim.services.monitoring.events import event_publishers
from scan2sim.services.monitoring.events.schema import Event
from tests.fakes.broker import Broker
from tests.waiting import until


def read_events(broker: Broker, enough: Callable[[list[Event]], object], seconds: float = 120) -> list[Event]:
    """All events until there are enough of them.

    Also sends what programs that have ended left on disk: a busy machine gives them no time to send everything.

    Args:
        broker: that the events were published to.
        enough: whether these are all that are expected.
        seconds: time limit.

    Raises:
        TimeoutError: there weren't enough of them in time.
    """
    events: list[Event] = []
    outlets = event_publishers.open_outlets(broker.servers)
    bodies = kafka.read(broker.cluster, event_publishers.TOPIC, group="test", from_start=True, wait=0.2)

    def read_one() -> object:
        body = next(bodies)
        if body is not None:
            events.append(Event.model_validate_json(body))
        return enough(events)

    try:
        until(read_one, seconds, what="the expected events", state=lambda: [(e.kind, e.body) for e in events])
    finally:
        bodies.close()  # type: ignore[attr-defined]  # a generator
        for outlet in outlets:
            outlet.close()
    return events
