"""Rules on what monitors tell, and alarms when they are broken: raised when it lasts, cleared when it is over for good.

[[rules]]
name = "images come late"
metric = "latency"      # seconds
topic = "/camera/*"
above = 0.2
hold = 5                # seconds for which it must be so
clear = 0.1             # cleared when it isn't above this ...
clear_hold = 10         # ... for so many seconds
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.io import toml
from scan2sim.services.monitoring.events.schema import Alarm, QueueState

Metric = Literal["bandwidth_difference", "latency", "lost", "rate", "silence", "queue_length", "queue_age"]
"""bandwidth_difference: share of what is published on a topic that a subscriber doesn't get; latency: seconds, mean of
a record; lost: messages in a record; rate: messages a second; silence: seconds without a record of a node;
queue_length: events that wait; queue_age: seconds since the longest waiting one was sent."""
Bound = Annotated[float, Field(ge=-1e9, le=1e9)]
Hold = Annotated[float, Field(ge=0, le=86_400)]
DOCS = "docs/event-bus.md lists what rules may say"
WINDOW = 5.0
"""Seconds over which bandwidths of several nodes are compared: their periods don't begin together."""
FORGOTTEN = 3600.0
"""Seconds without a record after which a node is forgotten."""


class Rule(Params):
    """A rule; exactly one of `above` and `below` is its bound."""

    name: Annotated[str, Field(min_length=1, max_length=100)]
    metric: Metric
    above: Bound | None = None
    below: Bound | None = None
    clear: Bound | None = None
    hold: Hold = 0.0
    clear_hold: Hold = 0.0
    topic: str = "*"
    node: str = "*"

    def broken(self, value: float) -> bool:
        """Whether a value is beyond the bound."""
        return value > self.above if self.above is not None else value < (self.below or 0.0)

    def kept(self, value: float) -> bool:
        """Whether a value is where the alarm may be cleared."""
        if self.clear is None:
            return not self.broken(value)
        return value <= self.clear if self.above is not None else value >= self.clear


def read(path: Path) -> tuple[Rule, ...]:
    """Rules of a TOML file.

    Raises:
        InputError: naming the rule and its field that is wrong.
    """
    said = toml.table(path)
    tables = said.get("rules")
    if set(said) != {"rules"} or not isinstance(tables, list) or not all(isinstance(one, dict) for one in tables):
        raise InputError(path, "is no list of rules", f"Begin each with [[rules]]; {DOCS}")
    rules = tuple(_rule(path, number, one) for number, one in enumerate(tables, 1))
    doubles = {one.name for one in rules if sum(other.name == one.name for other in rules) > 1}
    if doubles:
        raise InputError(path, f"two rules are called {min(doubles)!r}", "Give each a name of its own")
    return rules


def _rule(path: Path, number: int, said: Mapping[str, Any]) -> Rule:
    name = f"rule {said['name']!r:.60}" if "name" in said else f"rule {number}"
    try:
        rule = Rule.of(name, said, remedy=DOCS)
    except SettingError as error:
        raise InputError(path, f"{error.where}: {error.cause}", error.remedy) from None
    if (rule.above is None) == (rule.below is None):
        raise InputError(path, f"{name}: needs one bound", "Set either `above` or `below`")
    if rule.clear is not None and rule.broken(rule.clear):
        raise InputError(path, f"{name}.clear: would clear what raises it", "Set it on the other side of the bound")
    return rule


@dataclass
class _State:
    """Of a rule and a subject: whether it is raised, and since when it should be otherwise."""

    raised: bool = False
    since: float | None = None


@dataclass(frozen=True)
class _Share:
    time: float
    seconds: float
    size: float


class Alarms:
    """Holds rules against what is told; alarms come of it."""

    def __init__(self, rules: Sequence[Rule]) -> None:
        self._rules = rules
        self._states: dict[tuple[str, str], _State] = {}
        self._sizes: dict[tuple[str, str, str], deque[_Share]] = {}
        self._last: dict[str, float] = {}

    def record(self, record: Mapping[str, Any]) -> list[Alarm]:
        """Of a monitor's record, by the names of D3.2."""
        node, now = f"{record['node namespace'].rstrip('/')}/{record['node name']}", float(record["time"])
        self._last[node] = now
        found = list(self._observe("silence", node, "", 0.0, now))
        for flow in record["flows"]:
            topic, incoming = flow["topic"], flow["direction"] == "incoming"
            where = f"{topic} at {node}"
            size = flow["bandwidth"] * record["period"]
            self._add(topic, flow["direction"], node, _Share(now, record["period"], size))
            found += self._observe("rate", node, topic, flow["messages"] / record["period"], now, where)
            if incoming and flow.get("latency (nanoseconds)") is not None:
                found += self._observe("latency", node, topic, flow["latency (nanoseconds)"] / 1e9, now, where)
            if incoming and flow.get("lost messages") is not None:
                found += self._observe("lost", node, topic, flow["lost messages"], now, where)
        heard = {flow["topic"] for flow in record["flows"] if flow["direction"] == "incoming"}
        for topic in _subscribed(record):
            if topic not in heard:  # nothing ever came
                self._add(topic, "incoming", node, _Share(now, record["period"], 0.0))
            difference = self._difference(topic, node, now)
            if difference is not None:
                found += self._observe("bandwidth_difference", node, topic, difference, now, f"{topic} at {node}")
        return found

    def queue(self, state: QueueState, now: float) -> list[Alarm]:
        """Of a queue."""
        return [
            *self._observe("queue_length", state.queue, "", state.waiting, now),
            *self._observe("queue_age", state.queue, "", state.oldest, now),
        ]

    def tick(self, now: float) -> list[Alarm]:
        """Of nodes that say nothing; to be called about once a second."""
        self._last = {node: last for node, last in self._last.items() if now - last < FORGOTTEN}
        self._sizes = {where: all_ for where, all_ in self._sizes.items() if now - all_[-1].time < FORGOTTEN}
        return [one for node, last in self._last.items() for one in self._observe("silence", node, "", now - last, now)]

    def _observe(
        self, metric: Metric, node: str, topic: str, value: float, now: float, subject: str = ""
    ) -> Iterator[Alarm]:
        subject = subject or node
        for rule in self._rules:
            if rule.metric == metric and fnmatchcase(topic, rule.topic) and fnmatchcase(node, rule.node):
                state = self._states.setdefault((rule.name, subject), _State())
                since = _change(rule, state, value, now)
                if since is not None:
                    told: Literal["raised", "cleared"] = "raised" if state.raised else "cleared"
                    yield Alarm(state=told, rule=rule.name, subject=subject, value=value, since=since)

    def _add(self, topic: str, direction: str, node: str, share: _Share) -> None:
        shares = self._sizes.setdefault((topic, direction, node), deque())
        shares.append(share)
        while len(shares) > 1 and shares[0].time <= share.time - max(WINDOW, share.seconds):
            shares.popleft()

    def _difference(self, topic: str, node: str, now: float) -> float | None:
        """Share of a topic's published bandwidth that a node doesn't get; None: nobody watched publishes."""
        published = sum(
            _mean(shares)
            for (of, direction, _), shares in self._sizes.items()
            if of == topic and direction == "outgoing" and now - shares[-1].time < 2 * max(WINDOW, shares[-1].seconds)
        )
        return 1 - _mean(self._sizes[topic, "incoming", node]) / published if published else None


def _mean(shares: Sequence[_Share]) -> float:
    return sum(one.size for one in shares) / sum(one.seconds for one in shares)


def _subscribed(record: Mapping[str, Any]) -> list[str]:
    """Topics that a record's own node subscribes to."""
    return [
        one["topic name"]
        for one in record["topics endpoint info"]
        if any(sub["node name"] == record["node name"] for sub in one["subscriptions_info_by_topic"])
    ]


def _change(rule: Rule, state: _State, value: float, now: float) -> float | None:
    """Since when a change has lasted that is due now; None: there is none."""
    differs = rule.kept(value) if state.raised else rule.broken(value)
    if not differs:
        state.since = None
        return None
    since = state.since = now if state.since is None else state.since
    if now - since < (rule.clear_hold if state.raised else rule.hold):
        return None
    state.raised, state.since = not state.raised, None
    return since
