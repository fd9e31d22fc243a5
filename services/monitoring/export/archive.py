"""Archive of records for analysis: Parquet files by hour, and aggregating queries.

A row is one topic and direction of a node over a period. Every minute the received records are written as a part of
their hour, DAY/HOUR/*.parquet; when the hour is over, its parts are compacted into one file, DAY/HOUR.parquet. After a
restart, the records that may not have been written are read from Kafka again; duplicate rows count once.
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
from scan2sim.services.monitoring.messages import RejectedError, Rejections, parse_record
from scan2sim.services.monitoring.record import Record
from scan2sim.services.monitoring.settings.archive import ArchiveParams, QueryParams

WRITE_INTERVAL_S = 60.0
"""Pause between writing two parts."""
LATE_RECORDS_S = 300.0
"""Delay after the end of an hour before its parts are compacted: records may arrive late."""
SCHEMA = pa.schema(
    [
        ("time", pa.float64()), ("node", pa.string()), ("record_id", pa.string()), ("hostname", pa.string()),
        ("topic", pa.string()), ("direction", pa.string()), ("period", pa.float64()), ("bandwidth", pa.float64()),
        ("messages", pa.int64()), ("size", pa.float64()), ("published", pa.int64()), ("lost", pa.int64()),
        ("latency", pa.float64()), ("latency_p95", pa.float64()), ("cpu_percent", pa.float64()),
        ("memory_percent", pa.float64()), ("record", pa.string()),
    ]
)  # fmt: skip
"""Columns; times in seconds. `record` is the whole record as JSON, in the first row of the record."""
ROW_KEY = ("record_id", "topic", "direction")
"""Columns that identify a row: rows that agree in them are duplicates."""


class Archive:
    """Parquet files of records below a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows: list[dict[str, Any]] = []

    def files(self) -> list[Path]:
        """Files of whole hours, then parts."""
        return sorted(self._folder.glob("*/*.parquet")) + sorted(self._folder.glob("*/*/*.parquet"))

    def add(self, record: Record) -> None:
        """Buffer a record until the next `write`."""
        self._rows += rows(record)

    def write(self) -> None:
        """Write the buffered records as parts of their hours."""
        by_hour: dict[str, list[dict[str, Any]]] = {}
        for row in self._rows:
            by_hour.setdefault(datetime.fromtimestamp(row["time"], UTC).strftime("%Y-%m-%d/%H"), []).append(row)
        for hour, found in by_hour.items():
            _save(pa.Table.from_pylist(found, SCHEMA), self._folder / hour / f"{uuid.uuid4().hex}.parquet")
        self._rows = []

    def compact(self, now: float) -> None:
        """Merge the parts of each finished hour into one file; `now` in seconds since the epoch."""
        for hour in sorted(self._folder.glob("*/[0-2][0-9]")):
            began = datetime.strptime(f"{hour.parent.name} {hour.name}", "%Y-%m-%d %H").replace(tzinfo=UTC)
            if now < began.timestamp() + 3600 + LATE_RECORDS_S:
                continue
            whole = hour.with_suffix(".parquet")
            parts = [*sorted(hour.glob("*.parquet")), *([whole] if whole.exists() else [])]
            if parts:
                _save(_without_duplicates(_read(parts)).sort_by("time"), whole)
            shutil.rmtree(hour)


def rows(record: Record) -> list[dict[str, Any]]:
    """Rows of a record by the columns of `SCHEMA`; a record without flows gives one row without a topic."""
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


def archive_records(params: ArchiveParams, stop: threading.Event, warn: Callable[[str], None]) -> None:
    """Archive all records from Kafka until `stop` is set; `warn` is called with messages on what is skipped."""
    archive = Archive(params.archive)
    written = max((file.stat().st_mtime for file in archive.files()), default=None)
    since = None if written is None else written - WRITE_INTERVAL_S - LATE_RECORDS_S
    group = f"scan2sim-archive-{uuid.uuid4().hex}"
    due = time.monotonic() + WRITE_INTERVAL_S
    cluster = kafka.Cluster.read(params.kafka_bootstrap_servers, params.kafka_config)
    rejections = Rejections(f"the archive of {params.topic}", warn)
    bodies = kafka.read(
        cluster, params.topic, group=group, from_start=True, since=since, wait=0.5, rejected=rejections.add
    )
    for body in bodies:
        if body is not None:
            try:
                archive.add(parse_record(body))
            except RejectedError as error:
                rejections.add(error)
        if time.monotonic() >= due or stop.is_set():
            archive.write()
            archive.compact(time.time())
            due = time.monotonic() + WRITE_INTERVAL_S
        if stop.is_set():
            return


def query(params: QueryParams) -> pa.Table:
    """Aggregate messages, bandwidth, losses, latency and load by node, topic, direction and time interval.

    Raises:
        InputError: the archive is empty, or one of its files can't be read.
    """
    files = Archive(params.archive).files()
    if not files:
        raise InputError(params.archive, "holds no records", "Name the folder that `scan2sim monitor archive` writes")
    found = _without_duplicates(_read(files))
    for column, compare, value in (
        ("time", pc.greater_equal, params.begin),
        ("time", pc.less, params.end),
        ("node", pc.equal, params.node),
        ("topic", pc.equal, params.topic),
    ):
        if value is not None:
            found = found.filter(compare(found[column], value))
    begins = pc.multiply(pc.floor(pc.divide(found["time"], params.every)), params.every)
    intervals = found.append_column("begins", begins).group_by(["begins", "node", "topic", "direction"])
    aggregates = {
        "messages": "sum", "bandwidth": "mean", "size": "mean", "published": "sum", "lost": "sum", "latency": "mean",
        "latency_p95": "max", "cpu_percent": "mean",
    }  # fmt: skip
    columns = ["begins", "node", "topic", "direction", *aggregates]
    table = intervals.aggregate(list(aggregates.items())).rename_columns(columns)
    begins_at = pc.cast(pc.multiply(table["begins"], 1000), pa.int64()).cast(pa.timestamp("ms", "UTC"))
    order = [(name, "ascending") for name in ("begins", "node", "topic", "direction")]
    return (
        table.append_column("begins_at", begins_at)
        .sort_by(order)
        .drop_columns("begins")
        .select(["begins_at", "node", "topic", "direction", *aggregates])
    )


def _read(files: Iterable[Path]) -> pa.Table:
    tables = []
    for file in files:
        try:
            tables.append(pq.read_table(file, schema=SCHEMA))
        except (OSError, pa.ArrowException) as error:
            remedy = "Move the file away; the rest of the archive can be read without it"
            raise InputError(file, f"can't be read ({str(error).splitlines()[0]:.80})", remedy) from None
    return pa.concat_tables(tables)


def _without_duplicates(table: pa.Table) -> pa.Table:
    """Drop duplicate rows, which occur when the archiver was killed after writing."""
    seen: set[tuple[Any, ...]] = set()
    is_first = []
    for key in zip(*(table[name].to_pylist() for name in ROW_KEY), strict=True):
        is_first.append(key not in seen)
        seen.add(key)
    return table.filter(pa.array(is_first, pa.bool_()))


def _save(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".making")
    pq.write_table(table, temporary, compression="zstd")
    temporary.replace(path)
