"""History of the nodes' records in memory, aggregated into time buckets for plots.

Bounds: `MAX_RECORDS_PER_NODE` (6 hours at one per second; the oldest are dropped) and `MAX_NODES` (the node that has
been gone for the longest is dropped; a new one is rejected if all are alive): 140 MB in total.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.dashboard.clock_skew import ClockSkew
from scan2sim.services.monitoring.record import SCHEMA, Record

MAX_RECORDS_PER_NODE = 21_600
"""Records of a node that are kept; up to a quarter more before the oldest are dropped."""
MAX_NODES = 128
GONE_AFTER_PERIODS = 3.0
"""Periods without a record after which a node counts as gone."""
HOLD_PERIODS = 1.5
"""Periods before its time that a record covers, so that a late record leaves no gap."""
MAX_TIME_S = 1e11
"""Upper bound of a record's time, seconds since the epoch."""
MAX_RECORD_BYTES = 4 * 2**20
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

Floats = NDArray[np.float64]


class RejectedError(ValueError):
    """A record or event that can't be displayed. The message is "REASON: DETAIL"; rejections are counted by reason."""


@dataclass
class _Node:
    """Records of a node, sorted by time."""

    number: int
    last: Record
    last_seen: float
    skew: ClockSkew = field(default_factory=ClockSkew)
    times: Floats = field(default_factory=lambda: np.empty(256))
    values: NDArray[np.float32] = field(default_factory=lambda: np.empty((256, len(COLUMNS)), np.float32))
    count: int = 0

    def add(self, arrived: float, record: Record, row: Sequence[float]) -> None:
        """Insert the values of a record by its time; a new estimate of the clock skew shifts all times."""
        self.times[: self.count] += self.skew.add(arrived, record.time, record.period)
        at = record.time + self.skew.behind
        if self.count == len(self.times):
            self._grow()
        index = int(np.searchsorted(self.times[: self.count], at, side="right"))
        for array, new in ((self.times, at), (self.values, row)):
            array[index + 1 : self.count + 1] = array[index : self.count]
            array[index] = new
        self.count += 1

    def _grow(self) -> None:
        """Double the arrays, up to a quarter over `MAX_RECORDS_PER_NODE`; then drop the oldest records."""
        limit = MAX_RECORDS_PER_NODE
        more = min(len(self.times), limit + limit // 4 - len(self.times))
        if more:
            self.times = np.concatenate([self.times, np.empty(more)])
            self.values = np.concatenate([self.values, np.empty((more, len(COLUMNS)), np.float32)])
        else:
            self.count = limit
            self.times[:limit], self.values[:limit] = self.times[-limit:], self.values[-limit:]

    def within(self, begin: float, end: float) -> tuple[Floats, NDArray[np.float32]]:
        """Copies of the times and values from `begin` to `end`, and of the record after that."""
        first, past = np.searchsorted(self.times[: self.count], (begin, end))
        part = slice(int(first), min(int(past) + 1, self.count))
        return self.times[part].copy(), self.values[part].copy()

    def is_gone(self, now: float) -> bool:
        """Whether it has been silent for too long; `now` by `time.monotonic`."""
        return now - self.last_seen > GONE_AFTER_PERIODS * self.last.period


class History:
    """Stores received records and returns time windows of them; thread-safe."""

    def __init__(self, began: float) -> None:
        """`began`: start of the dashboard, seconds since the epoch; older records don't mean that a node is alive."""
        self._began, self._lock = began, threading.Lock()
        self._nodes: dict[str, _Node] = {}
        self._numbered = 0
        self.counts: Counter[str] = Counter()
        self.last_refused = ""

    def add(self, body: bytes) -> None:
        """Store a record; invalid ones are counted by reason and otherwise ignored."""
        try:
            record = parse_record(body)
            row = _row(record)
            with self._lock:
                self._node(record).add(time.time(), record, row)
        except RejectedError as error:
            reason, _, detail = str(error).partition(": ")
            self.counts[reason] += 1
            self.last_refused = printable(f"{reason}: {detail}"[:MAX_WARNING_CHARS])
        else:
            self.counts["shown"] += 1

    def _node(self, record: Record) -> _Node:
        name, now = full_name(record), time.monotonic()
        node = self._nodes.get(name)
        last_seen = now - max(0.0, self._began - record.time - (node.skew.behind if node else 0.0))
        if node is None:
            if len(self._nodes) >= MAX_NODES:
                self._drop_gone_node(now)
            node = self._nodes[name] = _Node(self._numbered, record, last_seen)
            self._numbered += 1
        if record.time >= node.last.time:
            node.last = record
        node.last_seen = max(node.last_seen, last_seen)
        return node

    def _drop_gone_node(self, now: float) -> None:
        gone = [name for name, node in self._nodes.items() if node.is_gone(now)]
        if not gone:
            raise RejectedError(f"over the limit of {MAX_NODES} nodes: no room")
        del self._nodes[min(gone, key=lambda name: self._nodes[name].last_seen)]

    def window(self, edges: Floats, nodes: Collection[str] = ()) -> dict[str, Any]:
        """Statistics of the nodes in time buckets.

        Args:
            edges: (B + 1,) edges of the buckets, seconds since the epoch, as `bucket_edges` returns them.
            nodes: full names of the nodes to include; empty: all.

        Returns:
            JSON-serializable: `step`, length of a bucket in seconds; `times`, (B,) their centres; `nodes`, a list of
            `name`, `number` and for each of `METRICS` lists of B values `mean` (and `min`, `max`, if a bucket has
            several records); `sums` over these nodes, `in`, `out` and `difference`. Null where there is no data.
        """
        with self._lock:
            chosen = [(name, node) for name, node in self._nodes.items() if not nodes or name in nodes]
            found = [(name, node.number, *node.within(edges[0], edges[-1])) for name, node in chosen]
        parts = [(name, number, buckets(times, values, edges)) for name, number, times, values in found]
        flows = np.zeros((len(edges) - 1, len(SUMS)))
        has_data = np.zeros(len(edges) - 1, bool)
        for _, _, part in parts:
            flows += np.nan_to_num(part.sums)
            has_data |= ~np.isnan(part.sums[:, 0])
        flows[~has_data] = np.nan
        incoming, outgoing = flows.T
        return {
            "step": edges[1] - edges[0],
            "times": ((edges[:-1] + edges[1:]) / 2).tolist(),
            "nodes": [{"name": name, "number": number, **_by_metric(part)} for name, number, part in parts],
            "sums": {
                "in": _to_list(incoming, 1),
                "out": _to_list(outgoing, 1),
                "difference": _to_list(incoming - outgoing, 1),
            },
        }

    def state(self) -> dict[str, Any]:
        """JSON-serializable current state of the nodes, their warnings, and counts of rejected records."""
        now = time.monotonic()
        with self._lock:
            nodes = [_state(name, node, now) for name, node in self._nodes.items()]
        return {"nodes": nodes, "counts": dict(self.counts), "last_refused": self.last_refused}


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


def parse_record(body: bytes) -> Record:
    """Parse and validate a record.

    Raises:
        RejectedError: it isn't a record, or a value is out of range.
    """
    if len(body) > MAX_RECORD_BYTES:
        raise RejectedError(f"too large: {len(body)} bytes")
    try:
        fields = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise RejectedError(f"invalid JSON: {error}") from None
    schema = fields.get("schema") if isinstance(fields, dict) else None
    if schema != SCHEMA:
        raise RejectedError(f"unknown schema: {str(schema)[:MAX_NAME_CHARS]}")
    try:
        record = Record.model_validate(fields)
    except ValidationError as error:
        first = error.errors()[0]
        raise RejectedError(f"malformed: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    if not 0 < record.period <= 86_400:
        raise RejectedError(f"malformed: a period of {record.period} s")
    if not 0 <= record.time < MAX_TIME_S:
        raise RejectedError(f"malformed: a time of {record.time} s")
    return record


def full_name(record: Record) -> str:
    """Name of a node with its namespace, cut to `MAX_NAME_CHARS`."""
    return printable(f"{record.node_namespace.rstrip('/')}/{record.node_name}")[:MAX_NAME_CHARS]


def _row(record: Record) -> list[float]:
    """Values of a record for `COLUMNS`; NaN for unknown ones."""
    known = [np.nan if (value := getattr(record, name)) is None else value for name in COLUMNS]
    if not all(abs(value) < 1e18 for value in known if value is not np.nan):
        raise RejectedError("malformed: a value of 1e18 or more")
    known[1 + METRICS.index("latency")] *= 1e-9
    return known


def _state(name: str, node: _Node, now: float) -> dict[str, Any]:
    last = node.last
    return {
        "name": name,
        "number": node.number,
        "gone": node.is_gone(now),
        "silent": round(now - node.last_seen, 1),
        "period": last.period,
        "host": printable(last.hostname)[:MAX_NAME_CHARS],
        "ip": printable(last.local_ip)[:MAX_NAME_CHARS],
        "cpu": _rounded(last.cpu_percent, 1),
        "topics": len(last.topics),
        "dropped": last.dropped,
        "latest": dict(zip(COLUMNS[1:], (_rounded(value, 6) for value in _row(last)[1:]), strict=True)),
        "remarks": [
            *_clock_warning(node.skew.behind),
            *(printable(text[:MAX_WARNING_CHARS]) for text in last.remarks[:MAX_WARNINGS]),
        ],
    }


def _clock_warning(behind: float) -> list[str]:
    if not behind:
        return []
    relation = "behind" if behind > 0 else "ahead of"
    return [f"its clock is {abs(behind):.0f} s {relation} this machine's: its records are shown at their arrival"]


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
