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

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.io import toml
from scan2sim.services.monitoring.events.notify import NotifyParams

Metric = Literal[
    "bandwidth_difference", "latency", "lost", "rate", "silence", "outage", "unassigned", "queue_length", "queue_age"
]  # fmt: skip
"""bandwidth_difference: fraction of a topic's published bandwidth that a subscriber doesn't receive; latency: seconds,
mean of a record; lost: messages lost in a record's period; rate: messages per second; silence: seconds without a record
of a node while Kafka was there; outage: seconds since the last sign of Kafka, from 5 s on; unassigned: seconds for
which Kafka has been answering without assigning a topic to the alarm node; queue_length: waiting events; queue_age:
seconds since the oldest waiting event was sent."""
Bound = Annotated[float, Field(ge=-1e9, le=1e9)]
Hold = Annotated[float, Field(ge=0, le=86_400)]
DOCS = "docs/monitoring.md lists the settings of rules"


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


DEFAULT_RULES = (
    Rule(name="Kafka is unreachable", metric="outage", above=0.0),
    Rule(name="Kafka doesn't assign the topic", metric="unassigned", above=60.0),
)
"""Used if no other rule has their metric: if the alarm node can't receive, that is one alarm, not one of each node."""


def read(path: Path) -> tuple[tuple[Rule, ...], NotifyParams]:
    """Read the rules of a TOML file, and where notifications go.

    Raises:
        InputError: names the invalid rule and its field.
    """
    content = toml.table(path)
    tables, notify = content.get("rules"), content.get("notify", {})
    if (
        not set(content) <= {"rules", "notify"}
        or not isinstance(notify, dict)
        or not isinstance(tables, list)
        or not all(isinstance(one, dict) for one in tables)
    ):
        raise InputError(path, "not a list of rules", f"Begin each rule with [[rules]]; {DOCS}")
    rules = tuple(_rule(path, number, one) for number, one in enumerate(tables, 1))
    duplicates = {one.name for one in rules if sum(other.name == one.name for other in rules) > 1}
    if duplicates:
        raise InputError(path, f"two rules have the name {min(duplicates)!r}", "Give each rule its own name")
    return rules, _notify(path, notify)


def _notify(path: Path, table: Mapping[str, Any]) -> NotifyParams:
    try:
        return NotifyParams.of("notify", table, remedy=DOCS)
    except SettingError as error:
        raise InputError(path, f"{error.where}: {error.cause}", error.remedy) from None


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
