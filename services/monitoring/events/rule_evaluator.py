"""Evaluation of alarm rules on monitoring records and queue states."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Literal

from scan2sim.services.monitoring.events.broker_contact import BrokerContact
from scan2sim.services.monitoring.events.rules import DEFAULT_RULES, Metric, Rule
from scan2sim.services.monitoring.events.schema import Alarm, AlarmCommand, QueueState

BANDWIDTH_WINDOW_S = 5.0
"""Window over which bandwidths of several nodes are compared: the periods of their records aren't aligned."""
NODE_EXPIRY_S = 3600.0
"""Time without a record after which the state of a node is deleted."""


@dataclass
class _AlarmState:
    """State of a rule for one subject.

    Attributes:
        node: full name of its node, or the name of its queue.
        raised: whether it is raised.
        since: since when the opposite condition has held.
        alarm: what was published last.
    """

    node: str
    raised: bool = False
    since: float | None = None
    alarm: Alarm | None = None


@dataclass(frozen=True)
class _ByteCount:
    time: float
    seconds: float
    size: float


class RuleEvaluator:
    """Evaluates rules on records and queue states; its methods return the alarms to publish."""

    def __init__(self, rules: Sequence[Rule], contact: BrokerContact) -> None:
        """`contact`: with the brokers that deliver the records."""
        self._contact = contact
        used = {rule.metric for rule in rules}
        self._rules = (*rules, *(rule for rule in DEFAULT_RULES if rule.metric not in used))
        self._states: dict[tuple[str, str], _AlarmState] = {}
        self._byte_counts: dict[tuple[str, str, str], deque[_ByteCount]] = {}
        self._last_arrival: dict[str, float] = {}
        self._muted: dict[tuple[str, str], float] = {}

    def check_record(self, record: Mapping[str, Any], arrived: float) -> list[Alarm]:
        """Alarms caused by a monitoring record.

        Args:
            record: mapping by the field names of D3.2.
            arrived: when it arrived, seconds since the epoch: a node's own clock may be wrong.
        """
        node, now = f"{record['node namespace'].rstrip('/')}/{record['node name']}", float(record["time"])
        self._last_arrival[node] = arrived
        found = list(self._observe("silence", node, "", 0.0, arrived))
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
        """Alarms for nodes that stopped publishing records, and for Kafka; call it about once per second."""
        self._last_arrival = {node: last for node, last in self._last_arrival.items() if now - last < NODE_EXPIRY_S}
        self._byte_counts = {
            key: counts for key, counts in self._byte_counts.items() if now - counts[-1].time < NODE_EXPIRY_S
        }
        found = list(self._observe("outage", "Kafka", "", self._contact.outage(now), now))
        for topic, seconds in self._contact.unassigned().items():
            found += self._observe("unassigned", topic, "", seconds, now)
        for node, arrived in self._last_arrival.items():
            silence = self._contact.silence(arrived, now)
            found += self._observe("silence", node, "", silence, now, may_clear=False)  # only a record clears it
        return found

    def command(self, command: AlarmCommand, now: float) -> list[Alarm]:
        """Alarms to publish again after a command: acknowledged, muted, or cleared as their node is retired."""
        if command.action == "mute":
            self._muted[command.rule, command.subject] = command.until
            self._muted = {key: until for key, until in self._muted.items() if until > now}
        found = []
        for (rule, subject), state in list(self._states.items()):
            if command.action == "retire":
                if state.node == command.subject:
                    del self._states[rule, subject]
                    if state.raised and state.alarm:
                        found.append(state.alarm.model_copy(update={"state": "cleared"}))
            elif state.raised and state.alarm and _matches(command.rule, command.subject, rule, subject):
                by = {"acknowledged_by": command.by or "unknown"} if command.action == "acknowledge" else {}
                state.alarm = state.alarm.model_copy(
                    update={"muted_until": self._muted_until(rule, subject, now), **by}
                )
                found.append(state.alarm)
        if command.action == "retire":
            self._last_arrival.pop(command.subject, None)
        return found

    def saved(self) -> dict[str, Any]:
        """JSON-serializable state that `restore` takes: raised alarms, nodes and mutings."""
        raised = [(one.node, one.alarm) for one in self._states.values() if one.raised and one.alarm]
        return {
            "alarms": [{"node": node, **alarm.model_dump()} for node, alarm in raised],
            "nodes": self._last_arrival,
            "muted": [[*key, until] for key, until in self._muted.items()],
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Continue from the state of an earlier process: what it raised isn't raised again.

        Raises:
            ValueError, KeyError, TypeError: it isn't such a state.
        """
        known = {rule.name for rule in self._rules}
        for fields in saved["alarms"]:
            node, alarm = fields["node"], Alarm.model_validate({k: v for k, v in fields.items() if k != "node"})
            if alarm.rule in known:
                self._states[alarm.rule, alarm.subject] = _AlarmState(str(node), True, None, alarm)
        self._last_arrival.update({str(node): float(arrived) for node, arrived in saved["nodes"].items()})
        self._muted.update({(str(rule), str(subject)): float(until) for rule, subject, until in saved["muted"]})

    def _muted_until(self, rule: str, subject: str, now: float) -> float:
        """End of the muting of an alarm, seconds since the epoch; 0 if it isn't muted."""
        ends = [until for (r, s), until in self._muted.items() if until > now and _matches(r, s, rule, subject)]
        return max(ends, default=0.0)

    def _observe(
        self, metric: Metric, node: str, topic: str, value: float, now: float, subject: str = "",
        *, may_clear: bool = True,
    ) -> Iterator[Alarm]:  # fmt: skip
        subject = subject or node
        for rule in self._rules:
            if rule.metric == metric and fnmatchcase(topic, rule.topic) and fnmatchcase(node, rule.node):
                state = self._states.setdefault((rule.name, subject), _AlarmState(node))
                if state.raised and not may_clear and rule.is_clear(value):
                    continue
                since = _due_transition(rule, state, value, now)
                if since is not None:
                    muted = self._muted_until(rule.name, subject, now)
                    new_state: Literal["raised", "cleared"] = "raised" if state.raised else "cleared"
                    state.alarm = Alarm(
                        state=new_state, rule=rule.name, subject=subject, value=value, since=since, muted_until=muted
                    )
                    yield state.alarm

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


def _matches(rule_pattern: str, subject_pattern: str, rule: str, subject: str) -> bool:
    def is_meant(name: str, pattern: str) -> bool:
        return name == pattern or fnmatchcase(name, pattern)

    return is_meant(rule, rule_pattern) and is_meant(subject, subject_pattern)


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
