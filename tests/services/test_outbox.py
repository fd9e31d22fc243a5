"""Outbox: order, size bound, retries, recovery after crashes; deduplication by record id."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import BusyError, InputError, SpaceError
from scan2sim.services import default_outbox
from scan2sim.services.outbox import Deduplicator, Outbox, OutboxRecord, Sender, new_ids
from tests.waiting import until

APPEND_FOREVER = """
import sys, itertools
from pathlib import Path
from scan2sim.services.outbox import Outbox
outbox = Outbox(Path(sys.argv[1]))
for number in itertools.count(1):
    outbox.append(f"maker:{number}", b"x" * 200)
    print(number, flush=True)
"""


class FakeBroker:
    """Accepts records while it is up."""

    def __init__(self, up: bool = True) -> None:
        self.up, self.received, self.attempts = up, list[str](), 0
        self._lock = threading.Lock()

    def __call__(self, records: Sequence[OutboxRecord]) -> None:
        with self._lock:
            self.attempts += 1
            if not self.up:
                raise ConnectionError("the broker is down")
            self.received += [record.id for record in records]


def test_unsent_records_are_kept_and_sent_in_order(tmp_path: Path) -> None:
    outbox, broker = Outbox(tmp_path / "records"), FakeBroker(up=False)
    sender = Sender(outbox, broker)
    for number in range(1200):
        outbox.append(f"a:{number}", b"body")
    sender.wake()
    until(lambda: broker.attempts)
    assert len(outbox) == 1200
    broker.up = True
    until(lambda: not len(outbox))
    sender.close()
    assert broker.received == [f"a:{number}" for number in range(1200)]


def test_records_survive_a_kill_of_their_producer(tmp_path: Path) -> None:
    program = [sys.executable, "-c", APPEND_FOREVER, str(tmp_path / "records")]
    producer = subprocess.Popen(program, stdout=subprocess.PIPE, text=True)
    assert producer.stdout
    for line in producer.stdout:
        if int(line) == 300:
            producer.send_signal(signal.SIGKILL)
            break
    producer.wait()
    pending = Outbox(tmp_path / "records").pending(1000)
    assert [record.id for record in pending][:300] == [f"maker:{number}" for number in range(1, 301)]


def test_full_outbox_drops_the_oldest_records_and_counts_them(tmp_path: Path) -> None:
    outbox = Outbox(tmp_path / "records", max_bytes=1000)
    for number in range(50):
        outbox.append(f"a:{number}", b"x" * 100)
    assert [record.id for record in outbox.pending()] == [f"a:{number}" for number in range(40, 50)]
    assert outbox.dropped == {"": 40}
    outbox.close()
    reopened = Outbox(tmp_path / "records", max_bytes=1000)  # the bound includes what an earlier process left
    reopened.append("b:1", b"x" * 100)
    assert len(reopened) == 10


def test_file_that_is_no_outbox_is_rejected_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "records").write_text(
        "these are no records, but a text that is longer than a header" * 99, encoding="utf-8"
    )
    with pytest.raises(InputError, match="records"):
        Outbox(tmp_path / "records")


def test_recently_acknowledged_records_are_resent_after_a_broker_restart(tmp_path: Path) -> None:
    outbox, broker = Outbox(tmp_path / "records"), FakeBroker()
    sender = Sender(outbox, broker)
    for number in range(1, 4):
        outbox.append(f"a:{number}", b"body")
    sender.wake()
    until(lambda: len(broker.received) == 3)
    until(lambda: not len(outbox))
    broker.up, broker.received = False, []  # it dies and loses what it received
    outbox.append("a:4", b"body")
    sender.wake()
    until(lambda: broker.attempts > 2)
    broker.up = True
    until(lambda: not len(outbox))
    sender.close()
    assert broker.received == ["a:1", "a:2", "a:3", "a:4"]


@pytest.mark.filterwarnings("error")
def test_reopening_an_outbox_with_unsent_records_resends_recently_acknowledged_ones(tmp_path: Path) -> None:
    earlier = Outbox(tmp_path / "outbox")
    earlier.append("a:1", b"acknowledged by a broker")
    earlier.acknowledge(earlier.pending()[-1])
    earlier.append("a:2", b"not sent, the broker was gone")
    earlier.close()
    later = Outbox(tmp_path / "outbox")
    assert [record.id for record in later.pending()] == ["a:1", "a:2"]
    later.acknowledge(later.pending()[-1])
    later.close()
    assert len(Outbox(tmp_path / "outbox")) == 0


def test_closing_the_outbox_stops_a_sender_that_waits_for_an_acknowledgement(tmp_path: Path) -> None:
    sending, answered, outbox = threading.Event(), threading.Event(), Outbox(tmp_path / "records")

    def send(_: Sequence[OutboxRecord]) -> None:
        sending.set()
        answered.wait(20)
        raise ConnectionError("the broker is down")

    sender = Sender(outbox, send)
    outbox.append("maker:1", b"x")
    sender.wake()
    assert sending.wait(20)
    sender.close(0.05)
    outbox.close()
    answered.set()
    until(lambda: not any(thread.name == "records" for thread in threading.enumerate()))


def test_late_records_are_not_duplicates() -> None:
    deduplicator = Deduplicator()
    assert [deduplicator.is_new(f"a:{number}") for number in (1, 2, 5, 3, 3, 4, 5, 6)] == [
        True, True, True, True, False, True, False, True,
    ]  # fmt: skip


def test_duplicates_are_detected_per_producer_identity() -> None:
    deduplicator, ids, others = Deduplicator(), new_ids(), new_ids()
    first, second, other = ids(), ids(), others()
    assert [deduplicator.is_new(one) for one in (first, second, first, second, other, other, ids())] == [
        True, True, False, False, True, False, True,
    ]  # fmt: skip


def test_records_that_are_delivered_again_after_a_restart_are_duplicates() -> None:
    before, after = Deduplicator(), Deduplicator()
    assert before.is_new("a:1") and before.is_new("a:3") and before.is_new("b:1")
    after.restore(json.loads(json.dumps(before.saved())))
    assert [after.is_new(one) for one in ("a:1", "a:3", "b:1", "a:4", "c:1")] == [False, False, False, True, True]


def test_flood_of_one_category_drops_only_its_own_records(tmp_path: Path) -> None:
    outbox = Outbox(tmp_path / "records", max_bytes=10_000)
    for number in range(5):
        outbox.append(f"alarm:{number}", b"x" * 100, "alarm")
    for number in range(1000):
        outbox.append(f"count:{number}", b"x" * 100, "count")
    pending = [record.id for record in outbox.pending(1000)]
    assert pending[:5] == [f"alarm:{number}" for number in range(5)] and pending[5:] == [
        f"count:{number}" for number in range(905, 1000)
    ]
    assert outbox.dropped == {"count": 905}
    outbox.close()


def test_outbox_file_is_locked_while_open(tmp_path: Path) -> None:
    first = Outbox(tmp_path / "records")
    with pytest.raises(BusyError, match="--outbox"):
        Outbox(tmp_path / "records")
    first.close()
    Outbox(tmp_path / "records").close()


OPEN_DEFAULT_OUTBOX = """
import sys, time
from scan2sim.services import default_outbox
outbox = default_outbox.open_outbox("/talker", "monitor_data")
outbox.append(f"{sys.argv[1]}:1", b"body")
print(len(outbox), flush=True)
time.sleep(60)
"""


def test_processes_of_one_name_get_separate_outboxes_and_leftovers_are_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    running = []
    for name in ("a", "b"):  # one after the other: probing a file locks it for a moment
        program = [sys.executable, "-c", OPEN_DEFAULT_OUTBOX, name]
        process = subprocess.Popen(program, stdout=subprocess.PIPE, text=True)
        assert process.stdout and process.stdout.readline() == "1\n"
        running.append(process)
    folder = tmp_path / "scan2sim" / "outboxes"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert sorted(path.name for path in folder.glob("*.outbox")) == [
        "talker.monitor_data.1.outbox", "talker.monitor_data.2.outbox",
    ]  # fmt: skip
    for process in running:
        process.kill()
        process.wait()
    successor = default_outbox.open_outbox("/talker", "monitor_data")
    assert sorted(record.id for record in successor.pending()) == ["a:1", "b:1"]
    successor.close()
    reopened = default_outbox.open_outbox("/talker", "monitor_data")
    assert len(reopened) == 2  # each is there once
    reopened.close()


def test_unusable_state_folder_is_reported_with_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with pytest.raises(SpaceError, match="XDG_STATE_HOME"):
        default_outbox.open_outbox("/talker", "monitor_data")
