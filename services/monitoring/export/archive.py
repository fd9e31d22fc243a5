"""Records kept for analysis: Parquet by hour, and queries over them.

A row is a node's topic and direction over a period. What comes is written every minute as a part of its hour,
DAY/HOUR/*.parquet; when the hour is over its parts become one file, DAY/HOUR.parquet. Who is started anew reads again
from Kafka what the last one may not have written; rows that are there twice count once.
"""

from __future__ import annotations

import shutil
import threading
import time
import uuid
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services import kafka
from scan2sim.services.monitoring.node.record import Record
from scan2sim.services.monitoring.settings.archive import ArchiveParams, QueryParams

WRITTEN = 60.0
"""Seconds between two parts."""
LATE = 300.0
"""Seconds after its end for which an hour is left in parts: records come late."""
SCHEMA = pa.schema(
    [
        ("time", pa.float64()), ("node", pa.string()), ("record_id", pa.string()), ("hostname", pa.string()),
        ("topic", pa.string()), ("direction", pa.string()), ("period", pa.float64()), ("bandwidth", pa.float64()),
        ("messages", pa.int64()), ("size", pa.float64()), ("published", pa.int64()), ("lost", pa.int64()),
        ("latency", pa.float64()), ("latency_p95", pa.float64()), ("cpu_percent", pa.float64()),
        ("memory_percent", pa.float64()), ("record", pa.string()),
    ]
)  # fmt: skip
"""Times in seconds; `record` is the whole record as JSON, in the first of its rows."""
ONE = ("record_id", "topic", "direction")
"""What tells rows apart: two that have all three are the same."""


class Archive:
    """Writes records below a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows: list[dict[str, Any]] = []

    def files(self) -> list[Path]:
        """Whole hours, then parts."""
        return sorted(self._folder.glob("*/*.parquet")) + sorted(self._folder.glob("*/*/*.parquet"))

    def add(self, record: Record) -> None:
        """Keep a record until it is written."""
        self._rows += rows(record)

    def write(self) -> None:
        """Write what was added as a part of its hours."""
        by_hour: dict[str, list[dict[str, Any]]] = {}
        for row in self._rows:
            by_hour.setdefault(datetime.fromtimestamp(row["time"], UTC).strftime("%Y-%m-%d/%H"), []).append(row)
        for hour, found in by_hour.items():
            _save(pa.Table.from_pylist(found, SCHEMA), self._folder / hour / f"{uuid.uuid4().hex}.parquet")
        self._rows = []

    def join(self, now: float) -> None:
        """Make one file each of the hours that are over, `now` in seconds since the epoch."""
        for hour in sorted(self._folder.glob("*/[0-2][0-9]")):
            began = datetime.strptime(f"{hour.parent.name} {hour.name}", "%Y-%m-%d %H").replace(tzinfo=UTC)
            if now < began.timestamp() + 3600 + LATE:
                continue
            whole = hour.with_suffix(".parquet")
            parts = [*sorted(hour.glob("*.parquet")), *([whole] if whole.exists() else [])]
            if parts:
                _save(_once(_read(parts)).sort_by("time"), whole)
            shutil.rmtree(hour)


def rows(record: Record) -> list[dict[str, Any]]:
    """A record's rows, by the columns of `SCHEMA`; one without a topic, where it tells of none."""
    node = {
        "time": record.time,
        "node": record.node_namespace.rstrip("/") + "/" + record.node_name,
        "record_id": record.id,
        "hostname": record.hostname,
        "period": record.period,
        "cpu_percent": record.cpu_percent,
        "memory_percent": record.virtual_memory.get("percent"),
    }
    found = [
        node
        | {
            "topic": flow.topic,
            "direction": flow.direction,
            "bandwidth": flow.bandwidth,
            "messages": flow.messages,
            "size": flow.size,
            "published": flow.sent,
            "lost": flow.lost,
            "latency": None if flow.latency is None else flow.latency / 1e9,
            "latency_p95": None if flow.latency_p95 is None else flow.latency_p95 / 1e9,
        }
        for flow in record.flows
    ] or [node]
    found[0]["record"] = record.json_line()
    return found


def keep(params: ArchiveParams, ended: threading.Event, unread: Callable[[str], None]) -> None:
    """Keep all records that come by Kafka, until told to end; `unread` is told what is none."""
    archive = Archive(params.archive)
    written = max((file.stat().st_mtime for file in archive.files()), default=None)
    since = None if written is None else written - WRITTEN - LATE
    group = f"scan2sim-archive-{uuid.uuid4().hex}"
    due = time.monotonic() + WRITTEN
    for body in kafka.read(
        params.kafka_bootstrap_servers, params.topic, group=group, from_start=True, since=since, wait=0.5
    ):
        if body is not None:
            try:
                archive.add(Record.model_validate_json(body))
            except ValueError as error:
                unread(f"a message that is no record ({str(error).splitlines()[0]})")
        if time.monotonic() >= due or ended.is_set():
            archive.write()
            archive.join(time.time())
            due = time.monotonic() + WRITTEN
        if ended.is_set():
            return


def query(params: QueryParams) -> pa.Table:
    """By node, topic, direction and span of time: messages, bandwidth, losses, latency, load.

    Raises:
        InputError: there is no archive, or a file of it can't be read.
    """
    files = Archive(params.archive).files()
    if not files:
        raise InputError(params.archive, "holds no records", "Name the folder that `scan2sim monitor archive` keeps")
    found = _once(_read(files))
    for column, compare, value in (
        ("time", pc.greater_equal, params.begin),
        ("time", pc.less, params.end),
        ("node", pc.equal, params.node),
        ("topic", pc.equal, params.topic),
    ):
        if value is not None:
            found = found.filter(compare(found[column], value))
    begins = pc.multiply(pc.floor(pc.divide(found["time"], params.every)), params.every)
    spans = found.append_column("begins", begins).group_by(["begins", "node", "topic", "direction"])
    asked = {
        "messages": "sum", "bandwidth": "mean", "size": "mean", "published": "sum", "lost": "sum", "latency": "mean",
        "latency_p95": "max", "cpu_percent": "mean",
    }  # fmt: skip
    told = spans.aggregate(list(asked.items())).rename_columns(["begins", "node", "topic", "direction", *asked])
    when = pc.cast(pc.multiply(told["begins"], 1000), pa.int64()).cast(pa.timestamp("ms", "UTC"))
    order = [(name, "ascending") for name in ("begins", "node", "topic", "direction")]
    return (
        told.append_column("begins_at", when)
        .sort_by(order)
        .drop_columns("begins")
        .select(["begins_at", "node", "topic", "direction", *asked])
    )


def _read(files: Iterable[Path]) -> pa.Table:
    tables = []
    for file in files:
        try:
            tables.append(pq.read_table(file, schema=SCHEMA))
        except (OSError, pa.ArrowException) as error:
            remedy = "Move it away; the rest can be read without it"
            raise InputError(file, f"can't be read ({str(error).splitlines()[0]:.80})", remedy) from None
    return pa.concat_tables(tables)


def _once(table: pa.Table) -> pa.Table:
    """Without rows that are there twice, as when a reader was killed after it had written."""
    taken: set[tuple[Any, ...]] = set()
    keep = []
    for key in zip(*(table[name].to_pylist() for name in ONE), strict=True):
        keep.append(key not in taken)
        taken.add(key)
    return table.filter(pa.array(keep, pa.bool_()))


def _save(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    made = path.with_suffix(".making")
    pq.write_table(table, made, compression="zstd")
    made.replace(path)
