"""History of the nodes' records in memory, aggregated into time buckets for plots.

Bounds: `MAX_RECORDS_PER_NODE` (6 hours at one per second; the oldest are dropped) and `MAX_NODES` (the node that has
been gone for the longest is dropped; a new one is rejected if all are alive): 140 MB in total. For plots by topic, of
each topic at a node `MAX_RECORDS_PER_FLOW`, of `MAX_FLOWS` in total: 46 MB.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.clock_skew import ClockSkew
from scan2sim.services.monitoring.dashboard.topics import topics
from scan2sim.services.monitoring.messages import RejectedError, Rejections, parse_record
from scan2sim.services.monitoring.record import Record, TopicFlow

MAX_RECORDS_PER_NODE = 21_600
"""Records of a node that are kept; up to a quarter more before the oldest are dropped."""
MAX_NODES = 128
MAX_RETIRED = 1024
"""Retired nodes that are remembered; the earliest are forgotten."""
MAX_RECORDS_PER_FLOW = 3600
"""The same of a topic at a node in one direction: one hour at one per second."""
MAX_FLOWS = 256
"""Topics at nodes by direction that are plotted; those that have ended make room for new ones."""
GONE_AFTER_PERIODS = 3.0
"""Periods without a record after which a node counts as gone."""
HOLD_PERIODS = 1.5
"""Periods before its time that a record covers, so that a late record leaves no gap."""
MAX_WARNINGS, MAX_WARNING_CHARS = 32, 400
"""Warnings of a node that are kept, and the characters of each."""
MAX_NAME_CHARS = 256
MAX_BUCKETS = 360
"""Buckets of a time window."""
BUCKET_LENGTHS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1800, 3600)
"""Lengths of a bucket; a window uses the shortest that needs no more than `MAX_BUCKETS`."""

METRICS = ("bandwidth", "latency", "lost", "messages", "size")
"""Plotted by node: bytes per second, seconds, messages per period, messages per period, bytes."""
SUMS = ("in_bandwidth", "out_bandwidth")
"""Plotted as sums over the nodes: bytes per second."""
COLUMNS = ("period", *METRICS, *SUMS)
By = Literal["node", "topic"]
"""What a line of a plot stands for."""

Floats = NDArray[np.float64]


@dataclass
class _Series:
    """Values over time: rows of `COLUMNS`, sorted by time.

    Attributes:
        number: of its line in plots, which determines its colour.
        limit: rows that are kept; up to a quarter more before the oldest are dropped.
    """

    number: int
    limit: int
    times: Floats = field(default_factory=lambda: np.empty(256))
    values: NDArray[np.float32] = field(default_factory=lambda: np.empty((256, len(COLUMNS)), np.float32))
    count: int = 0

    def add(self, at: float, row: Sequence[float]) -> None:
        """Insert a row by its time."""
        if self.count == len(self.times):
            self._grow()
        index = int(np.searchsorted(self.times[: self.count], at, side="right"))
        for array, new in ((self.times, at), (self.values, row)):
            array[index + 1 : self.count + 1] = array[index : self.count]
            array[index] = new
        self.count += 1

    def _grow(self) -> None:
        """Double the arrays, up to a quarter over the limit; then drop the oldest rows."""
        limit = self.limit
        more = min(len(self.times), limit + limit // 4 - len(self.times))
        if more:
            self.times = np.concatenate([self.times, np.empty(more)])
            self.values = np.concatenate([self.values, np.empty((more, len(COLUMNS)), np.float32)])
        else:
            self.count = limit
            self.times[:limit], self.values[:limit] = self.times[-limit:], self.values[-limit:]

    def shift(self, seconds: float) -> None:
        """Add seconds to all times."""
        self.times[: self.count] += seconds

    def within(self, begin: float, end: float) -> tuple[Floats, NDArray[np.float32]]:
        """Copies of the times and values from `begin` to `end`, and of the row after that."""
        first, past = np.searchsorted(self.times[: self.count], (begin, end))
        part = slice(int(first), min(int(past) + 1, self.count))
        return self.times[part].copy(), self.values[part].copy()

    def ends(self) -> float:
        """When its values count as outdated."""
        last = self.count - 1
        return float(self.times[last] + GONE_AFTER_PERIODS * self.values[last, 0])


@dataclass
class _Node:
    """A node and its records."""

    series: _Series
    last: Record
    last_seen: float
    skew: ClockSkew = field(default_factory=ClockSkew)
    starts: dict[str, tuple[float, float]] = field(default_factory=dict)
    """When each start of the node (`Record.node_id`) was seen first and last, by `time.monotonic`."""

    def is_gone(self, now: float) -> bool:
        """Whether it has been silent for too long; `now` by `time.monotonic`."""
        return self.is_long_ago(self.last_seen, now)

    def is_long_ago(self, seen: float, now: float) -> bool:
        """Whether a record that was seen at a time doesn't mean that its sender is alive."""
        return now - seen > GONE_AFTER_PERIODS * self.last.period


class History:
    """Stores received records and returns time windows of them; thread-safe."""

    def __init__(self, began: float) -> None:
        """`began`: start of the dashboard, seconds since the epoch; older records don't mean that a node is alive."""
        self._began, self._lock = began, threading.Lock()
        self._nodes: dict[str, _Node] = {}
        self._flows: dict[tuple[str, str, str], _Series] = {}
        self._retired: dict[str, float] = {}
        self._numbered, self._topics_numbered = 0, 0
        self.shown, self.rejections = 0, Rejections("records")

    def add(self, body: bytes) -> None:
        """Store a record; invalid ones are counted by reason and otherwise ignored."""
        try:
            record = parse_record(body)
            row, flows = _row(record), [(flow.topic, flow.direction, _flow_row(flow, record)) for flow in record.flows]
            with self._lock:
                node = self._node(record)
                change = node.skew.add(time.time(), record.time, record.period)
                at, name = record.time + node.skew.behind, full_name(record)
                if change:
                    for one in (node.series, *(flow for key, flow in self._flows.items() if key[0] == name)):
                        one.shift(change)
                node.series.add(at, row)
                self._add_flows(name, at, flows)
        except RejectedError as error:
            self.rejections.add(error)
        else:
            self.shown += 1

    def retire(self, node: str, at: float) -> None:
        """No longer list a node that is gone, until it reports again; its records stay in windows of the past.

        Args:
            node: full name.
            at: when it was retired, seconds since the epoch.
        """
        with self._lock:
            self._retired[printable(node)[:MAX_NAME_CHARS]] = at
            while len(self._retired) > MAX_RETIRED:
                del self._retired[min(self._retired, key=lambda name: self._retired[name])]

    def _is_listed(self, name: str, node: _Node, now: float) -> bool:
        return not node.is_gone(now) or node.last.time + node.skew.behind > self._retired.get(name, 0.0)

    def _node(self, record: Record) -> _Node:
        name, now = full_name(record), time.monotonic()
        node = self._nodes.get(name)
        last_seen = now - max(0.0, self._began - record.time - (node.skew.behind if node else 0.0))
        if node is None:
            if len(self._nodes) >= MAX_NODES:
                self._drop_gone_node(now)
            node = self._nodes[name] = _Node(_Series(self._numbered, MAX_RECORDS_PER_NODE), record, last_seen)
            self._numbered += 1
        if record.time >= node.last.time:
            node.last = record
        node.last_seen = max(node.last_seen, last_seen)
        node.starts = {start: seen for start, seen in node.starts.items() if not node.is_long_ago(seen[1], now)}
        first_seen, _ = node.starts.get(record.node_id, (last_seen, last_seen))
        node.starts[record.node_id] = first_seen, last_seen
        return node

    def _drop_gone_node(self, now: float) -> None:
        gone = [name for name, node in self._nodes.items() if node.is_gone(now)]
        if not gone:
            raise RejectedError(f"over the limit of {MAX_NODES} nodes: no room")
        dropped = min(gone, key=lambda name: self._nodes[name].last_seen)
        del self._nodes[dropped]
        self._flows = {key: flow for key, flow in self._flows.items() if key[0] != dropped}

    def _add_flows(self, node: str, at: float, flows: Sequence[tuple[str, str, Sequence[float]]]) -> None:
        """Store a node's values by topic and direction, as far as there is room."""
        new = [(topic, direction) for topic, direction, _ in flows if (node, topic, direction) not in self._flows]
        if len(self._flows) + len(new) > MAX_FLOWS:
            self._flows = {key: flow for key, flow in self._flows.items() if flow.ends() > at}
        for topic, direction in new[: max(0, MAX_FLOWS - len(self._flows))]:
            number = next((one.number for key, one in self._flows.items() if key[1] == topic), self._topics_numbered)
            self._topics_numbered = max(self._topics_numbered, number + 1)
            self._flows[node, topic, direction] = _Series(number, MAX_RECORDS_PER_FLOW)
        for topic, direction, row in flows:
            if (series := self._flows.get((node, topic, direction))) is not None:
                series.add(at, row)

    def window(self, edges: Floats, names: Collection[str] = (), by: By = "node") -> dict[str, Any]:
        """Statistics of the nodes, or of the topics, in time buckets.

        Args:
            edges: (B + 1,) edges of the buckets, seconds since the epoch, as `bucket_edges` returns them.
            names: full names of the nodes, or topics, to include; empty: all.
            by: what the statistics are of.

        Returns:
            JSON-serializable: `step`, length of a bucket in seconds; `times`, (B,) their centres; `nodes` or `topics`,
            a list of `name`, `number` and for each of `METRICS` lists of B values `mean` (and, by node, `min`, `max`,
            if a bucket has several records); `sums` over these, `in`, `out` and `difference`. Null where there is no
            data. By topic, `bandwidth`, `messages` and `size` are those of its publishers, or, without an instrumented
            one, of its subscribers; `latency` (a mean) and `lost` of all its subscribers; `messages` and `lost` are per
            second.
        """
        with self._lock:
            if by == "node":
                chosen = [(name, "", node.series) for name, node in self._nodes.items() if not names or name in names]
            else:
                chosen = [(key[1], key[2], one) for key, one in self._flows.items() if not names or key[1] in names]
            found = [(name, way, one.number, *one.within(edges[0], edges[-1])) for name, way, one in chosen]
        parts = [_Part(name, way, number, buckets(times, values, edges)) for name, way, number, times, values in found]
        flows = np.zeros((len(edges) - 1, len(SUMS)))
        has_data = np.zeros(len(edges) - 1, bool)
        for part in parts:
            flows += np.nan_to_num(part.buckets.sums)
            has_data |= ~np.isnan(part.buckets.sums[:, 0])
        flows[~has_data] = np.nan
        incoming, outgoing = flows.T
        return {
            "step": edges[1] - edges[0],
            "times": ((edges[:-1] + edges[1:]) / 2).tolist(),
            f"{by}s": [one.line() for one in parts] if by == "node" else _topic_lines(parts),
            "sums": {
                "in": _to_list(incoming, 1),
                "out": _to_list(outgoing, 1),
                "difference": _to_list(incoming - outgoing, 1),
            },
        }

    def state(self) -> dict[str, Any]:
        """JSON-serializable current state of the nodes and topics, their warnings, and counts of rejected records.

        Nodes are those that aren't retired (`retire`).
        Topics have the `number` of their line in plots; null: beyond `MAX_FLOWS`, it isn't plotted.
        """
        now = time.monotonic()
        with self._lock:
            listed = [(name, node) for name, node in self._nodes.items() if self._is_listed(name, node, now)]
            nodes = [_state(name, node, now) for name, node in listed]
            alive = [node.last for node in self._nodes.values() if not node.is_gone(now)]
            numbers = {printable(key[1])[:MAX_NAME_CHARS]: flow.number for key, flow in self._flows.items()}
        counts = {"counts": {"shown": self.shown, **self.rejections.counts}, "last_rejected": self.rejections.last}
        return {
            "nodes": nodes,
            "topics": [one | {"number": numbers.get(one["topic"])} for one in topics(alive)],
            **counts,
        }


@dataclass(frozen=True)
class Buckets:
    """Values of a node by bucket; NaN where there is no data.

    Attributes:
        mean: (B, `METRICS`), likewise `min` and `max`.
        sums: (B, `SUMS`); the last value is held until the node's next record, or until it counts as gone.
        several: whether any bucket has more than one record.
    """

    mean: Floats
    min: Floats
    max: Floats
    sums: Floats
    several: bool


@dataclass(frozen=True)
class _Part:
    """Buckets of a node, or of a topic at a node in one direction."""

    name: str
    direction: str
    number: int
    buckets: Buckets

    def line(self) -> dict[str, Any]:
        """The line of a node in plots."""
        return {"name": self.name, "number": self.number, **_by_metric(self.buckets)}


def bucket_edges(begin: float, end: float) -> Floats:
    """Edges of at most `MAX_BUCKETS` + 1 buckets, at multiples of their length, so that later calls use the same."""
    lengths = BUCKET_LENGTHS_S
    step = float(next((length for length in lengths if (end - begin) / length <= MAX_BUCKETS), lengths[-1]))
    last = max(np.ceil(end / step), np.floor(begin / step) + 1)
    return np.arange(max(np.floor(begin / step), last - MAX_BUCKETS - 1), last + 1) * step


def buckets(times: Floats, rows: NDArray[np.float32], edges: Floats) -> Buckets:
    """Mean, minimum and maximum of the records in each bucket; an empty bucket uses the next record that covers it.

    Args:
        times: (N,) ends of the records' periods, ascending.
        rows: (N, C) `COLUMNS`.
        edges: (B + 1,).
    """
    mean, minimum, maximum = (np.full((len(edges) - 1, len(COLUMNS) - 1), np.nan) for _ in range(3))
    lengths = np.zeros(0)
    if len(times):
        at = np.searchsorted(times, edges)
        lengths = np.diff(at)
        values, full = rows[:, 1:].astype(np.float64), lengths > 0
        if full.any():
            inside, starts = values[: at[-1]], at[:-1][full]
            known = np.add.reduceat(~np.isnan(inside), starts, dtype=float)
            known[known == 0] = np.nan
            mean[full] = np.add.reduceat(np.nan_to_num(inside), starts) / known
            minimum[full], maximum[full] = np.fmin.reduceat(inside, starts), np.fmax.reduceat(inside, starts)
        following = np.minimum(at[1:], len(times) - 1)
        holds = ~full & (at[1:] < len(times)) & (times[following] - HOLD_PERIODS * rows[following, 0] < edges[1:])
        for statistic in (mean, minimum, maximum):
            statistic[holds] = values[following[holds]]
        after_last = (edges[:-1] >= times[-1]) & (edges[:-1] < times[-1] + GONE_AFTER_PERIODS * rows[-1, 0])
        mean[after_last, len(METRICS) :] = values[-1, len(METRICS) :]
    by_node = slice(len(METRICS))
    return Buckets(
        mean[:, by_node], minimum[:, by_node], maximum[:, by_node], mean[:, len(METRICS) :], bool((lengths > 1).any())
    )


def full_name(record: Record) -> str:
    """Name of a node with its namespace, cut to `MAX_NAME_CHARS`."""
    return printable(f"{record.node_namespace.rstrip('/')}/{record.node_name}")[:MAX_NAME_CHARS]


def _row(record: Record) -> list[float]:
    """Values of a record for `COLUMNS`; NaN for unknown ones."""
    known = _checked([getattr(record, name) for name in COLUMNS])
    known[1 + METRICS.index("latency")] *= 1e-9
    return known


def _flow_row(flow: TopicFlow, record: Record) -> list[float]:
    """The same for a topic at a node; messages are per second."""
    latency = None if flow.latency is None else flow.latency * 1e-9
    lost = None if flow.lost is None else flow.lost / record.period
    ways = (flow.bandwidth, 0.0) if flow.direction == "incoming" else (0.0, flow.bandwidth)
    rate = flow.messages / record.period
    return _checked([record.period, flow.bandwidth, latency, lost, rate, flow.size, *ways])


def _checked(values: Sequence[float | None]) -> list[float]:
    """Values that can be plotted; NaN for None."""
    known = [np.nan if value is None else value for value in values]
    if not all(abs(value) < 1e18 for value in known if value is not np.nan):
        raise RejectedError("malformed: a value of 1e18 or more")
    return known


def _topic_lines(parts: Sequence[_Part]) -> list[dict[str, Any]]:
    """Lines of topics in plots, from their values at nodes."""
    by_topic: dict[str, list[_Part]] = {}
    for part in parts:
        by_topic.setdefault(part.name, []).append(part)
    lines = []
    for topic, its in by_topic.items():
        shown = printable(topic)[:MAX_NAME_CHARS]
        metrics = _topic_metrics(its)
        means = {metric: {"mean": _to_list(metrics[metric], DIGITS[metric])} for metric in METRICS}
        lines.append({"name": shown, "number": its[0].number, **means})
    return lines


def _topic_metrics(parts: Sequence[_Part]) -> dict[str, Floats]:
    """Values (B,) of a topic for `METRICS`, from those at its publishers and subscribers."""

    def total(direction: str, values: Callable[[Floats], Floats]) -> Floats:
        """Sum over the topic's nodes; NaN where none has a value."""
        chosen = [values(part.buckets.mean.T) for part in parts if part.direction == direction]
        if not chosen:
            return np.full(len(parts[0].buckets.mean), np.nan)
        known = np.stack(chosen)
        return np.where(np.isnan(known).all(axis=0), np.nan, np.nansum(known, axis=0))

    bandwidth, latency, lost, messages, _ = (METRICS.index(name) for name in METRICS)

    def sent(column: int) -> Floats:
        published = total("outgoing", lambda values: values[column])
        return np.where(np.isnan(published), total("incoming", lambda values: values[column]), published)

    timed = total("incoming", lambda v: np.where(np.isnan(v[latency]), np.nan, v[messages]))
    delay = total("incoming", lambda v: v[latency] * v[messages])
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            "bandwidth": sent(bandwidth),
            "latency": delay / timed,
            "lost": total("incoming", lambda values: values[lost]),
            "messages": sent(messages),
            "size": sent(bandwidth) / sent(messages),
        }


def _state(name: str, node: _Node, now: float) -> dict[str, Any]:
    last = node.last
    return {
        "name": name,
        "number": node.series.number,
        "gone": node.is_gone(now),
        "silent": round(now - node.last_seen, 1),
        "period": last.period,
        "host": printable(last.hostname)[:MAX_NAME_CHARS],
        "ip": printable(last.local_ip)[:MAX_NAME_CHARS],
        "cpu": _rounded(last.cpu_percent, 1),
        "topics": len(last.topics),
        "dropped": last.dropped,
        "latest": dict(zip(COLUMNS[1:], (_rounded(value, 6) for value in _row(last)[1:]), strict=True)),
        "warnings": [
            *_clock_warning(node.skew.behind),
            *_name_warning(node),
            *(printable(text[:MAX_WARNING_CHARS]) for text in last.warnings[:MAX_WARNINGS]),
        ],
    }


def _clock_warning(behind: float) -> list[str]:
    if not behind:
        return []
    relation = "behind" if behind > 0 else "ahead of"
    return [f"its clock is {abs(behind):.0f} s {relation} this machine's: its records are shown at their arrival"]


def _name_warning(node: _Node) -> list[str]:
    newest = max((first for first, _ in node.starts.values()), default=0.0)
    same = sum(last > newest for _, last in node.starts.values())  # a node that was restarted sends nothing more
    return [f"{same} nodes have this name, and their records are mixed: rename all but one"] if same > 1 else []


DIGITS = {"bandwidth": 1, "latency": 6, "lost": 2, "messages": 2, "size": 1}
"""Decimal places in the response."""


def _by_metric(part: Buckets) -> dict[str, dict[str, list[float | None]]]:
    kinds = {"mean": part.mean, **({"min": part.min, "max": part.max} if part.several else {})}
    return {
        metric: {kind: _to_list(values[:, column], DIGITS[metric]) for kind, values in kinds.items()}
        for column, metric in enumerate(METRICS)
    }


def _to_list(values: Floats, digits: int) -> list[float | None]:
    known = np.isfinite(values)
    return [value if ok else None for value, ok in zip(np.round(values, digits).tolist(), known, strict=True)]


def _rounded(value: float, digits: int) -> float | None:
    return round(value, digits) if np.isfinite(value) else None
