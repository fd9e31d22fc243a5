"""Archive: hourly Parquet files without duplicates, and queries."""

from __future__ import annotations

import contextlib
import csv
import json
import threading
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError
from scan2sim.services import kafka
from scan2sim.services.monitoring.export import archive
from scan2sim.services.monitoring.export.archive import Archive, archive_records, query
from scan2sim.services.monitoring.record import Record, TopicFlow
from scan2sim.services.monitoring.settings.archive import ArchiveParams, QueryParams
from scan2sim.services.outbox import OutboxRecord
from tests.fakes.broker import Broker
from tests.waiting import until

NOON = 1_700_000_000 // 3600 * 3600


def record(number: int, when: float, *, node: str = "camera", lost: int = 0, latency: float = 0.1) -> Record:
    flow = TopicFlow(
        topic="/image", direction="incoming", type="sensor_msgs/msg/Image", bandwidth=1000.0, messages=10, size=100.0,
        sent=10 + lost, lost=lost, latency=round(latency * 1e9), latency_p95=round(2e9 * latency),
    )  # fmt: skip
    return Record(
        id=f"{node}:{number}", time=when, period=1.0, node_name=node, node_namespace="/site", node_id=node,
        bandwidth=1000.0, messages=10, size=100.0, out_bandwidth=0.0, out_messages=0, out_size=0.0,
        in_bandwidth=1000.0, in_messages=10, in_size=100.0, latency=None, latency_p95=None, lost=lost, publishers=1,
        subscribers=1, topics=["/image"], flows=[flow], hostname="here", local_ip="", local_ips=[], endpoints=[],
        cpu_times={}, cpu_percent=50.0, virtual_memory={"percent": 30.0}, disk_usage=[],
    )  # fmt: skip


def run_query(folder: Path, **settings: Any) -> list[dict[str, Any]]:
    return query(QueryParams.of("", {"archive": folder, **settings})).to_pylist()


def test_query_aggregates_by_interval_node_and_topic(tmp_path: Path) -> None:
    made = Archive(tmp_path)
    for number in range(120):
        made.add(record(number, NOON + number, lost=number % 2, latency=0.1 if number < 60 else 0.3))
        made.add(record(number, NOON + number, node="lidar"))
    made.write()
    first, second = run_query(tmp_path, node="/site/camera")
    assert (first["messages"], first["lost"], first["published"], first["bandwidth"]) == (600, 30, 630, 1000.0)
    assert (first["latency"], second["latency"], second["latency_p95"]) == pytest.approx((0.1, 0.3, 0.6))
    assert first["begins_at"].timestamp() == NOON // 60 * 60 and first["topic"] == "/image"
    assert len(run_query(tmp_path)) == 4
    assert len(run_query(tmp_path, begin=NOON + 60, end=NOON + 90)) == 2
    assert run_query(tmp_path, topic="/other") == []
    assert len(run_query(tmp_path, every=3600)) == 2


def test_finished_hours_are_compacted_into_one_file_without_duplicates(tmp_path: Path) -> None:
    for _ in range(2):  # an archiver that was killed after writing receives the same records again
        made = Archive(tmp_path)
        for number in range(3600):
            if number % 60 == 0:
                made.add(record(number, NOON + number))
        made.write()
    made.compact(NOON + 3600)  # too early: records may be late
    assert not list(tmp_path.glob("*/*.parquet"))
    made.compact(NOON + 2 * 3600)
    (whole,) = tmp_path.rglob("*.parquet")
    assert whole.parent.parent == tmp_path
    table = pq.read_table(whole)
    assert table.num_rows == 60
    assert json.loads(table["record"][0].as_py())["node name"] == "camera"
    made.add(record(9999, NOON + 10))  # after the compaction
    made.write()
    made.compact(NOON + 2 * 3600)
    assert sum(one["messages"] for one in run_query(tmp_path)) == 610


def test_empty_and_damaged_archives_are_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no records"):
        run_query(tmp_path)
    (tmp_path / "2026-11-22").mkdir()
    (tmp_path / "2026-11-22" / "15.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match=r"15\.parquet"):
        run_query(tmp_path)


def test_records_from_kafka_are_archived_and_queried(
    tmp_path: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive, "WRITE_INTERVAL_S", 0.1)
    records = [record(number, NOON + number) for number in range(1, 7)]
    *bodies, last = (OutboxRecord(number, one.id, one.json_line().encode()) for number, one in enumerate(records))
    invalid = OutboxRecord(9, "other:1", b"no record")
    kafka.TopicProducer(broker.cluster, "records").send([*bodies, invalid, *bodies, last])  # last: of one partition
    stop, warnings = threading.Event(), list[str]()
    params = ArchiveParams(archive=tmp_path / "kept", kafka_bootstrap_servers=broker.servers, topic="records")
    archiver = threading.Thread(target=archive_records, args=(params, stop, warnings.append))
    archiver.start()

    def is_complete() -> bool:
        with contextlib.suppress(InputError):  # a file was compacted
            return bool(warnings) and sum(one["messages"] for one in run_query(params.archive)) >= 60
        return False

    try:
        until(is_complete)
    finally:
        stop.set()
        archiver.join()
    assert len(warnings) == 1
    out = tmp_path / "result.csv"
    arguments = ["monitor", "query", str(tmp_path / "kept"), "--from", "2023-11-14T22:00", "--out", str(out)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    (line,) = csv.DictReader(out.open())
    assert (line["node"], line["messages"]) == ("/site/camera", "60")
