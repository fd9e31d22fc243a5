"""What other programs leave on the bus' topics is skipped and counted by reason; page, alarms and archive continue."""

from __future__ import annotations

import json
import random
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("confluent_kafka", reason="the extra bus isn't installed")
pytest.importorskip("pyarrow", reason="the extra archive isn't installed")

from confluent_kafka import Producer

from scan2sim.services import kafka
from scan2sim.services.monitoring.dashboard.app import Sources, application
from scan2sim.services.monitoring.dashboard.history import History
from scan2sim.services.monitoring.dashboard.state import BusState
from scan2sim.services.monitoring.events.schema import RECORD, Events
from scan2sim.services.monitoring.export.archive import Archive, archive_records
from scan2sim.services.monitoring.messages import RejectedError, parse_record
from scan2sim.services.monitoring.settings.archive import ArchiveParams
from scan2sim.services.monitoring.settings.dashboard import PageParams
from tests.fakes.broker import Broker
from tests.fakes.sample_records import body

BODIES: dict[str, bytes | None] = {
    "tombstone": None, "empty": b"", "text": b"hello", "avro": b"\0\0\0\0\x2a\x06abc", "string": b'"text"',
    "list": b"[1, 2]", "null": b"null", "nan": b'{"bandwidth": NaN}', "deep": b"[" * 100_000,
    "huge integer": b'{"time": 1' + b"0" * 400 + b"}", "huge number": b'{"time": 1e999}',
    "utf-16": '{"node": "a"}'.encode("utf-16"), "byte order mark": b"\xef\xbb\xbf{}",
}  # fmt: skip
HEADERS: list[list[tuple[str, str | bytes | None]]] = [
    [], [("record id", b"\xff\xfe")], [("record id", b"abc")], [("record id", None)], [("record id", b"a:-5")],
    [("record id", b"a:" + b"9" * 5000)], [("record id", b"")], [("content-type", b"application/json")],
]  # fmt: skip
NOW = 1_700_000_000.0


def produce_foreign(servers: str, topic: str) -> int:
    """Produce each body with each header, in one partition, which keeps the order; returns their number."""
    producer = Producer({"bootstrap.servers": servers})
    for header in HEADERS:
        for content in BODIES.values():
            producer.produce(topic, content, headers=header, partition=0)
    assert producer.flush(30) == 0
    return len(HEADERS) * len(BODIES)


def wait_for(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds, at most a minute."""
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.05)


def test_the_page_shows_records_after_foreign_ones_and_counts_those(broker: Broker) -> None:
    number = produce_foreign(broker.servers, "records")
    params = PageParams(kafka_bootstrap_servers=broker.servers, topic="records", events_topic="events", back=3600.0)
    sources = Sources.of(params)
    sources.start()
    try:
        kafka.TopicProducer(broker.cluster, "records").send([])
        good = Producer({"bootstrap.servers": broker.servers})
        good.produce("records", body("camera", time.time()), partition=0)
        assert good.flush(30) == 0
        wait_for(lambda: sources.history.shown == 1)
        assert sources.records.is_alive() and sources.history.rejections.counts.total() == number
        reasons = sources.history.rejections.counts
        assert reasons["a message without a body"] == 2 * len(HEADERS)
        foreign_ids = sum(header[0][0] == "record id" and header[0][1] is not None for header in HEADERS if header)
        assert reasons["a header 'record id' of another program"] == foreign_ids * (len(BODIES) - 2)
        assert set(reasons) >= {"invalid JSON", "unknown schema"}
        client = pytest.importorskip("fastapi.testclient").TestClient(
            application(params, sources), base_url="http://localhost"
        )
        assert client.get("/health/ready").status_code == 200
        assert f'scan2sim_page_records{{shown="no"}} {number}.0' in client.get("/metrics").text
    finally:
        sources.close()


def test_the_archive_keeps_records_after_foreign_ones(broker: Broker, tmp_path: Path) -> None:
    number = produce_foreign(broker.servers, "records")
    good = Producer({"bootstrap.servers": broker.servers})
    good.produce("records", body("camera", NOW), partition=0)
    assert good.flush(30) == 0
    while number < 1000:  # a warning of the 1000th comes after the record
        number += produce_foreign(broker.servers, "records")
    stop, warnings = threading.Event(), list[str]()
    params = ArchiveParams(archive=tmp_path / "kept", kafka_bootstrap_servers=broker.servers, topic="records")
    archiver = threading.Thread(target=archive_records, args=(params, stop, warnings.append))
    archiver.start()
    wait_for(lambda: len(warnings) == 4)
    stop.set()
    archiver.join(60)
    assert len(Archive(tmp_path / "kept").files()) == 1 and "message number 1000:" in warnings[-1]
    assert "a header 'record id' of another program (" in warnings[-1]


def test_a_record_that_a_callback_fails_on_does_not_stop_the_reader(caplog: pytest.LogCaptureFixture) -> None:
    reasons = Counter[str]()

    def fail(_: bytes) -> None:
        raise ZeroDivisionError

    kafka.process(b"body", fail, lambda why: reasons.update([why.partition(": ")[0]]))
    assert reasons == {"could not be processed": 1} and "ZeroDivisionError" in caplog.text


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("text", "invalid JSON: Expecting value"), ("avro", "invalid JSON: not Unicode text"),
        ("deep", "invalid JSON: nested too deeply"), ("list", "unknown schema: none"),
        ("nan", "malformed: NaN is no number of JSON"), ("huge integer", "malformed: an integer of 401 digits"),
    ],
)  # fmt: skip
def test_rejections_name_the_cause(name: str, why: str) -> None:
    with pytest.raises(RejectedError, match=f"^{why}"):
        parse_record(BODIES[name] or b"")


def mutations(seed: int, number: int) -> list[bytes]:
    """Records with one value replaced by one of another type or range."""
    chosen = random.Random(seed)
    values: list[Any] = [None, True, -1, 0, 10**17, 10**40, -(10**30), 1e300, float("nan"), float("inf"), "",
                         "x" * 5000, "\ud800",
              [], {}, [[]], "2024-01-01", {"a": 1}]  # fmt: skip
    made = []
    for _ in range(number):
        fields: dict[str, Any] = json.loads(body("camera", NOW))
        fields["flows"] = [{"topic": "/a", "direction": "incoming", "type": "t", "bandwidth": 1.0, "messages": 1,
                            "message size mean": 1.0}]  # fmt: skip
        inside = fields if chosen.random() < 0.7 else fields["flows"][0]
        inside[chosen.choice(list(inside))] = chosen.choice(values)
        made.append(json.dumps(fields).encode())
    return made


def test_no_mutated_record_raises_anywhere(tmp_path: Path) -> None:
    """Whatever a record holds, it is used or rejected, and what the page shows remains valid JSON."""
    history, bus_state, archive, events = History(0.0), BusState(0.0), Archive(tmp_path), Events("alarms")
    received: list[Any] = []
    events.on(RECORD, received.append)
    for one in mutations(1, 3000):
        history.add(one)
        bus_state.add(one)
        events.receive(one)
        try:
            archive.add(parse_record(one))
        except RejectedError:
            pass
    archive.write()
    assert history.shown and history.rejections.counts["malformed"] and received
    for state in (history.state(), bus_state.state(NOW), *received):
        json.dumps(state, allow_nan=False)
    assert bus_state.rejections.counts.total() == 3000, "records are no events"


def test_mutated_events_never_raise() -> None:
    alarm = {"rule": "r", "subject": "s", "state": "raised", "value": 1.0, "limit": 1.0}
    chosen = random.Random(2)
    values: list[Any] = [None, -1, 10**40, 1e300, float("inf"), float("nan"), "", "\ud800", [], {}]
    bus_state, events = BusState(0.0), Events("alarms")
    for number in range(2000):
        kind = chosen.choice(["alarm", "queue", "run", "step", "x"])
        fields: dict[str, Any] = {"schema": "scan2sim-event-1", "record id": f"p:{number}", "time": NOW, "sender": "s",
                                  "kind": kind, "body": dict(alarm)}  # fmt: skip
        inside = fields if chosen.random() < 0.5 else fields["body"]
        inside[chosen.choice(list(inside))] = chosen.choice(values)
        text = json.dumps(fields).encode()
        bus_state.add(text)
        events.receive(text)
    json.dumps(bus_state.state(NOW), allow_nan=False)
    assert events.rejections.counts["malformed"] and events.rejections.counts["invalid JSON"]
