"""Alarm rules on monitoring data, with hysteresis: separate thresholds and hold times for raising and clearing.

[[rules]]
name = "images come late"
metric = "latency"      # seconds
topic = "/camera/*"
above = 0.2
hold = 5                # seconds above the threshold before the alarm is raised
clear = 0.1             # the alarm is cleared when the metric is not above this ...
clear_hold = 10         # ... for this many seconds
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
"""bandwidth_difference: fraction of a topic's published bandwidth that a subscriber doesn't receive; latency: seconds,
mean of a record; lost: messages lost in a record's period; rate: messages per second; silence: seconds without a record
of a node; queue_length: waiting events; queue_age: seconds since the oldest waiting event was sent."""
Bound = Annotated[float, Field(ge=-1e9, le=1e9)]
Hold = Annotated[float, Field(ge=0, le=86_400)]
DOCS = "docs/monitoring.md lists the settings of rules"
BANDWIDTH_WINDOW_S = 5.0
"""Window over which bandwidths of several nodes are compared: the periods of their records aren't aligned."""
NODE_EXPIRY_S = 3600.0
"""Time without a record after which the state of a node is deleted."""


class Rule(Params):
    """An alarm rule; exactly one of `above` and `below` is its threshold."""

    name: Annotated[str, Field(min_length=1, max_length=100)]
    metric: Metric
    above: Bound | None = None
    below: Bound | None = None
    clear: Bound | None = None
    hold: Hold = 0.0
    clear_hold: Hold = 0.0
    topic: str = "*"
    node: str = "*"

    def is_violated(self, value: float) -> bool:
        """Whether a value is beyond the threshold."""
        return value > self.above if self.above is not None else value < (self.below or 0.0)

    def is_clear(self, value: float) -> bool:
        """Whether the alarm may be cleared at a value."""
        if self.clear is None:
            return not self.is_violated(value)
        return value <= self.clear if self.above is not None else value >= self.clear


def read(path: Path) -> tuple[Rule, ...]:
    """Read the rules of a TOML file.

    Raises:
        InputError: names the invalid rule and its field.
    """
    content = toml.table(path)
    tables = content.get("rules")
    if set(content) != {"rules"} or not isinstance(tables, list) or not all(isinstance(one, dict) for one in tables):
        raise InputError(path, "not a list of rules", f"Begin each rule with [[rules]]; {DOCS}")
    rules = tuple(_rule(path, number, one) for number, one in enumerate(tables, 1))
    duplicates = {one.name for one in rules if sum(other.name == one.name for other in rules) > 1}
    if duplicates:
        raise InputError(path, f"two rules have the name {min(duplicates)!r}", "Give each rule its own name")
    return rules


def _rule(path: Path, number: int, table: Mapping[str, Any]) -> Rule:
    name = f"rule {table['name']!r:.60}" if "name" in table else f"rule {number}"
    try:
        rule = Rule.of(name, table, remedy=DOCS)
    except SettingError as error:
        raise InputError(path, f"{error.where}: {error.cause}", error.remedy) from None
    if (rule.above is None) == (rule.below is None):
        raise InputError(path, f"{name}: needs exactly one threshold", "Set either `above` or `below`")
    if rule.clear is not None and rule.is_violated(rule.clear):
        cause = f"{name}.clear: the value at which the alarm clears would raise it"
        raise InputError(path, cause, "Set `clear` on the other side of the threshold")
    return rule


@dataclass
class _AlarmState:
    """State of a rule for one subject: whether it is raised, and since when the opposite condition has held."""

    raised: bool = False
    since: float | None = None


@dataclass(frozen=True)
class _ByteCount:
    time: float
    seconds: float
    size: float


class RuleEvaluator:
    """Evaluates rules on records and queue states; its methods return the alarms to publish."""

    def __init__(self, rules: Sequence[Rule]) -> None:
        self._rules = rules
        self._states: dict[tuple[str, str], _AlarmState] = {}
        self._byte_counts: dict[tuple[str, str, str], deque[_ByteCount]] = {}
        self._last_record: dict[str, float] = {}

    def check_record(self, record: Mapping[str, Any]) -> list[Alarm]:
        """Alarms caused by a monitoring record, a mapping by the field names of D3.2."""
        node, now = f"{record['node namespace'].rstrip('/')}/{record['node name']}", float(record["time"])
        self._last_record[node] = now
        found = list(self._observe("silence", node, "", 0.0, now))
        for flow in record["flows"]:
            topic, incoming = flow["topic"], flow["direction"] == "incoming"
            subject = f"{topic} at {node}"
            size = flow["bandwidth"] * record["period"]
            self._add(topic, flow["direction"], node, _ByteCount(now, record["period"], size))
            found += self._observe("rate", node, topic, flow["messages"] / record["period"], now, subject)
            if incoming and flow.get("latency (nanoseconds)") is not None:
                found += self._observe("latency", node, topic, flow["latency (nanoseconds)"] / 1e9, now, subject)
            if incoming and flow.get("lost messages") is not None:
                found += self._observe("lost", node, topic, flow["lost messages"], now, subject)
        received = {flow["topic"] for flow in record["flows"] if flow["direction"] == "incoming"}
        for topic in _subscribed(record):
            if topic not in received:  # no message ever arrived, so the record has no flow for it
                self._add(topic, "incoming", node, _ByteCount(now, record["period"], 0.0))
            difference = self._bandwidth_difference(topic, node, now)
            if difference is not None:
                found += self._observe("bandwidth_difference", node, topic, difference, now, f"{topic} at {node}")
        return found

    def check_queue(self, state: QueueState, now: float) -> list[Alarm]:
        """Alarms caused by the state of a queue."""
        return [
            *self._observe("queue_length", state.queue, "", state.waiting, now),
            *self._observe("queue_age", state.queue, "", state.oldest, now),
        ]

    def check_silence(self, now: float) -> list[Alarm]:
        """Alarms for nodes that stopped publishing records; call it about once per second."""
        self._last_record = {node: last for node, last in self._last_record.items() if now - last < NODE_EXPIRY_S}
        self._byte_counts = {
            key: counts for key, counts in self._byte_counts.items() if now - counts[-1].time < NODE_EXPIRY_S
        }
        return [
            alarm
            for node, last in self._last_record.items()
            for alarm in self._observe("silence", node, "", now - last, now)
        ]

    def _observe(
        self, metric: Metric, node: str, topic: str, value: float, now: float, subject: str = ""
    ) -> Iterator[Alarm]:
        subject = subject or node
        for rule in self._rules:
            if rule.metric == metric and fnmatchcase(topic, rule.topic) and fnmatchcase(node, rule.node):
                state = self._states.setdefault((rule.name, subject), _AlarmState())
                since = _due_transition(rule, state, value, now)
                if since is not None:
                    new_state: Literal["raised", "cleared"] = "raised" if state.raised else "cleared"
                    yield Alarm(state=new_state, rule=rule.name, subject=subject, value=value, since=since)

    def _add(self, topic: str, direction: str, node: str, count: _ByteCount) -> None:
        counts = self._byte_counts.setdefault((topic, direction, node), deque())
        counts.append(count)
        while len(counts) > 1 and counts[0].time <= count.time - max(BANDWIDTH_WINDOW_S, count.seconds):
            counts.popleft()

    def _bandwidth_difference(self, topic: str, node: str, now: float) -> float | None:
        """Fraction of a topic's published bandwidth that a node doesn't receive; None: no monitored publisher."""
        published = sum(
            _mean_rate(counts)
            for (name, direction, _), counts in self._byte_counts.items()
            if name == topic
            and direction == "outgoing"
            and now - counts[-1].time < 2 * max(BANDWIDTH_WINDOW_S, counts[-1].seconds)
        )
        return 1 - _mean_rate(self._byte_counts[topic, "incoming", node]) / published if published else None


def _mean_rate(counts: Sequence[_ByteCount]) -> float:
    return sum(one.size for one in counts) / sum(one.seconds for one in counts)


def _subscribed(record: Mapping[str, Any]) -> list[str]:
    """Topics to which the node of a record subscribes."""
    return [
        one["topic name"]
        for one in record["topics endpoint info"]
        if any(sub["node name"] == record["node name"] for sub in one["subscriptions_info_by_topic"])
    ]


def _due_transition(rule: Rule, state: _AlarmState, value: float, now: float) -> float | None:
    """Raise or clear the alarm if its condition has held long enough.

    Returns:
        The time since when the condition has held; None without a transition.
    """
    differs = rule.is_clear(value) if state.raised else rule.is_violated(value)
    if not differs:
        state.since = None
        return None
    since = state.since = now if state.since is None else state.since
    if now - since < (rule.clear_hold if state.raised else rule.hold):
        return None
    state.raised, state.since = not state.raised, None
    return since
