"""What nodes told, for as long as fits into memory, and cut into buckets for plots.

Bounds: `ROWS` records of a node (6 hours at one a second; the oldest go), `NODES` nodes (the one longest gone goes, and
a new one is refused where all are there): 140 MB when all is full.
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
from scan2sim.services.monitoring.dashboard.clock_skew import Skew
from scan2sim.services.monitoring.node.record import SCHEMA, Record

ROWS = 21_600
"""Records of a node that are kept, at least."""
NODES = 128
"""Nodes that are kept, at most."""
GONE = 3.0
"""Periods without a record after which a node counts as gone (issue: three)."""
HELD = 1.5
"""Periods before its moment for which a record holds, so that a late one leaves no gap."""
LATEST = 1e11
"""A record's time, seconds since the epoch, at most."""
LARGEST = 4 * 2**20
"""Bytes of a record."""
REMARKS, REMARK = 32, 400
"""Remarks that are kept of a node, and the characters of each."""
NAME = 256
"""Characters of a name."""
POINTS = 360
"""Buckets of a window, at most."""
STEPS = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1800, 3600)
"""Seconds of a bucket, the shortest that makes no more than `POINTS`."""

METRICS = ("bandwidth", "latency", "lost", "messages", "size")
"""By node: bytes a second, seconds, messages of a period, messages of a period, bytes."""
SUMS = ("in_bandwidth", "out_bandwidth")
"""Of the nodes together: bytes a second."""
COLUMNS = ("period", *METRICS, *SUMS)

Floats = NDArray[np.float64]


class Refused(ValueError):
    """A record that can't be shown; says why."""


@dataclass
class _Node:
    """A node's records, in the order of their times."""

    number: int
    last: Record
    came: float
    skew: Skew = field(default_factory=Skew)
    times: Floats = field(default_factory=lambda: np.empty(256))
    values: NDArray[np.float32] = field(default_factory=lambda: np.empty((256, len(COLUMNS)), np.float32))
    count: int = 0

    def add(self, came: float, record: Record, row: Sequence[float]) -> None:
        """Keep a record's figures, which came then; all are moved when its clock turns out to be off."""
        self.times[: self.count] += self.skew.add(came, record.time, record.period)
        at = record.time + self.skew.behind
        if self.count == len(self.times):
            self._make_room()
        place = int(np.searchsorted(self.times[: self.count], at, side="right"))
        for kept, new in ((self.times, at), (self.values, row)):
            kept[place + 1 : self.count + 1] = kept[place : self.count]
            kept[place] = new
        self.count += 1

    def _make_room(self) -> None:
        """Twice the room, up to a quarter over `ROWS`; then the oldest go."""
        more = min(len(self.times), ROWS + ROWS // 4 - len(self.times))
        if more:
            self.times = np.concatenate([self.times, np.empty(more)])
            self.values = np.concatenate([self.values, np.empty((more, len(COLUMNS)), np.float32)])
        else:
            self.count = ROWS
            self.times[:ROWS], self.values[:ROWS] = self.times[-ROWS:], self.values[-ROWS:]

    def within(self, begin: float, end: float) -> tuple[Floats, NDArray[np.float32]]:
        """Copies of times and figures from `begin` to `end`, and of the next record."""
        first, past = np.searchsorted(self.times[: self.count], (begin, end))
        part = slice(int(first), min(int(past) + 1, self.count))
        return self.times[part].copy(), self.values[part].copy()

    def is_gone(self, now: float) -> bool:
        """Whether it has been silent for too long; `now` as `time.monotonic`."""
        return now - self.came > GONE * self.last.period


class History:
    """Takes records as they come, and tells windows of them; may be used from any thread."""

    def __init__(self, began: float) -> None:
        """Records from before `began`, seconds since the epoch, are from back then: their nodes were silent since."""
        self._began, self._lock = began, threading.Lock()
        self._nodes: dict[str, _Node] = {}
        self._numbered = 0
        self.counts: Counter[str] = Counter()
        self.last_refused = ""

    def take(self, body: bytes) -> None:
        """Keep a record; what can't be is counted by why, and nothing else happens."""
        try:
            record = parsed(body)
            row = _row(record)
            with self._lock:
                self._node(record).add(time.time(), record, row)
        except Refused as refused:
            why, _, detail = str(refused).partition(": ")
            self.counts[why] += 1
            self.last_refused = printable(f"{why}: {detail}"[:REMARK])
        else:
            self.counts["shown"] += 1

    def _node(self, record: Record) -> _Node:
        name, now = full_name(record), time.monotonic()
        node = self._nodes.get(name)
        came = now - max(0.0, self._began - record.time - (node.skew.behind if node else 0.0))
        if node is None:
            if len(self._nodes) >= NODES:
                self._forget_one(now)
            node = self._nodes[name] = _Node(self._numbered, record, came)
            self._numbered += 1
        if record.time >= node.last.time:
            node.last = record
        node.came = max(node.came, came)
        return node

    def _forget_one(self, now: float) -> None:
        gone = [name for name, node in self._nodes.items() if node.is_gone(now)]
        if not gone:
            raise Refused(f"of more than {NODES} nodes: no room")
        del self._nodes[min(gone, key=lambda name: self._nodes[name].came)]

    def window(self, edges: Floats, nodes: Collection[str] = ()) -> dict[str, Any]:
        """What nodes did, in buckets.

        Args:
            edges: (B + 1,) of the buckets, seconds since the epoch, as `grid` makes them.
            nodes: full names; none: all.

        Returns:
            JSON-able: `step`, seconds of a bucket; `times`, (B,) their middles; `nodes`, a list of `name`, `number` and
            for each of `METRICS` lists of B `mean` (and `min`, `max`, where a bucket holds several records); `sums` of
            these nodes, `in`, `out` and `difference`. Null where nobody told anything.
        """
        with self._lock:
            chosen = [(name, node) for name, node in self._nodes.items() if not nodes or name in nodes]
            found = [(name, node.number, *node.within(edges[0], edges[-1])) for name, node in chosen]
        parts = [(name, number, buckets(times, values, edges)) for name, number, times, values in found]
        flows = np.zeros((len(edges) - 1, len(SUMS)))
        told = np.zeros(len(edges) - 1, bool)
        for _, _, part in parts:
            flows += np.nan_to_num(part.sums)
            told |= ~np.isnan(part.sums[:, 0])
        flows[~told] = np.nan
        came, went = flows.T
        return {
            "step": edges[1] - edges[0],
            "times": ((edges[:-1] + edges[1:]) / 2).tolist(),
            "nodes": [{"name": name, "number": number, **_by_metric(part)} for name, number, part in parts],
            "sums": {"in": _listed(came, 1), "out": _listed(went, 1), "difference": _listed(came - went, 1)},
        }

    def state(self) -> dict[str, Any]:
        """How nodes are now, what they remark, and what was refused: JSON-able."""
        now = time.monotonic()
        with self._lock:
            nodes = [_state(name, node, now) for name, node in self._nodes.items()]
        return {"nodes": nodes, "counts": dict(self.counts), "last_refused": self.last_refused}


@dataclass(frozen=True)
class Buckets:
    """A node's figures; NaN where nothing is known.

    Attributes:
        mean: (B, `METRICS`), likewise `min` and `max`.
        sums: (B, `SUMS`); until a node tells anew, or is gone, what it told last goes on.
        several: whether a bucket has more than one record.
    """

    mean: Floats
    min: Floats
    max: Floats
    sums: Floats
    several: bool


def grid(begin: float, end: float) -> Floats:
    """Edges of no more than `POINTS` buckets and two, at multiples of their length: the same whenever it is asked."""
    step = float(next((step for step in STEPS if (end - begin) / step <= POINTS), STEPS[-1]))
    last = max(np.ceil(end / step), np.floor(begin / step) + 1)
    return np.arange(max(np.floor(begin / step), last - POINTS - 1), last + 1) * step


def buckets(times: Floats, rows: NDArray[np.float32], edges: Floats) -> Buckets:
    """Mean, least and most of the records in each bucket; where there is none, what the next one says of its period.

    Args:
        times: (N,) ascending, ends of records' periods.
        rows: (N, C) `COLUMNS`.
        edges: (B + 1,).
    """
    mean, least, most = (np.full((len(edges) - 1, len(COLUMNS) - 1), np.nan) for _ in range(3))
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
            least[full], most[full] = np.fmin.reduceat(inside, starts), np.fmax.reduceat(inside, starts)
        following = np.minimum(at[1:], len(times) - 1)
        holds = ~full & (at[1:] < len(times)) & (times[following] - HELD * rows[following, 0] < edges[1:])
        for figures in (mean, least, most):
            figures[holds] = values[following[holds]]
        goes_on = (edges[:-1] >= times[-1]) & (edges[:-1] < times[-1] + GONE * rows[-1, 0])
        mean[goes_on, len(METRICS) :] = values[-1, len(METRICS) :]
    by_node = slice(len(METRICS))
    return Buckets(
        mean[:, by_node], least[:, by_node], most[:, by_node], mean[:, len(METRICS) :], bool((lengths > 1).any())
    )


def parsed(body: bytes) -> Record:
    """A record as it came.

    Raises:
        Refused: it is none, or says what can't be.
    """
    if len(body) > LARGEST:
        raise Refused(f"too large: {len(body)} bytes")
    try:
        told = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise Refused(f"no JSON: {error}") from None
    schema = told.get("schema") if isinstance(told, dict) else None
    if schema != SCHEMA:
        raise Refused(f"of another kind: {str(schema)[:NAME]}")
    try:
        record = Record.model_validate(told)
    except ValidationError as error:
        first = error.errors()[0]
        raise Refused(f"malformed: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    if not 0 < record.period <= 86_400:
        raise Refused(f"malformed: a period of {record.period} s")
    if not 0 <= record.time < LATEST:
        raise Refused(f"malformed: a time of {record.time} s")
    return record


def full_name(record: Record) -> str:
    """A node's name with its namespace, of no more than `NAME` characters."""
    return printable(f"{record.node_namespace.rstrip('/')}/{record.node_name}")[:NAME]


def _row(record: Record) -> list[float]:
    """A record's `COLUMNS`; NaN for what it doesn't know."""
    known = [np.nan if (value := getattr(record, name)) is None else value for name in COLUMNS]
    if not all(abs(value) < 1e18 for value in known if value is not np.nan):
        raise Refused("malformed: a figure beyond all measure")
    known[1 + METRICS.index("latency")] *= 1e-9
    return known


def _state(name: str, node: _Node, now: float) -> dict[str, Any]:
    last = node.last
    return {
        "name": name,
        "number": node.number,
        "gone": node.is_gone(now),
        "silent": round(now - node.came, 1),
        "period": last.period,
        "host": printable(last.hostname)[:NAME],
        "ip": printable(last.local_ip)[:NAME],
        "cpu": _told(last.cpu_percent, 1),
        "topics": len(last.topics),
        "dropped": last.dropped,
        "latest": dict(zip(COLUMNS[1:], (_told(value, 6) for value in _row(last)[1:]), strict=True)),
        "remarks": [*_clock(node.skew.behind), *(printable(text[:REMARK]) for text in last.remarks[:REMARKS])],
    }


def _clock(behind: float) -> list[str]:
    if not behind:
        return []
    way = "behind" if behind > 0 else "ahead of"
    return [f"its clock is {abs(behind):.0f} s {way} this machine's: its records are shown where they came"]


DIGITS = {"bandwidth": 1, "latency": 6, "lost": 2, "messages": 2, "size": 1}
"""Places behind the point that are told."""


def _by_metric(part: Buckets) -> dict[str, dict[str, list[float | None]]]:
    kinds = {"mean": part.mean, **({"min": part.min, "max": part.max} if part.several else {})}
    return {
        metric: {kind: _listed(figures[:, column], DIGITS[metric]) for kind, figures in kinds.items()}
        for column, metric in enumerate(METRICS)
    }


def _listed(figures: Floats, digits: int) -> list[float | None]:
    known = np.isfinite(figures)
    return [value if there else None for value, there in zip(np.round(figures, digits).tolist(), known, strict=True)]


def _told(value: float, digits: int) -> float | None:
    return round(value, digits) if np.isfinite(value) else None
