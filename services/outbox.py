"""Outbox: a bounded store-and-forward queue of records on disk, sent in order when a broker is available.

Delivery is at least once. A record is sent twice if its sender died before the acknowledgement, or if the broker went
away soon after it (one that keeps records in memory has lost them). Readers drop duplicates by record id.
"""

from __future__ import annotations

import contextlib
import logging
import re
import sqlite3
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scan2sim.pipeline.core.errors import BusyError, InputError
from scan2sim.services.supervision import SupervisedThread

log = logging.getLogger(__name__)

MAX_OUTBOX_BYTES = 64 * 2**20
"""Largest total size of unsent records on disk: more than three hours at 5 kB/s."""
RESEND_WINDOW_S = 60.0
"""How long acknowledged records are kept, to send them again if the broker goes away."""
BATCH_RECORDS = 500
"""Records per call of `send`."""
MAX_RETRY_PAUSE_S = 5.0
"""Upper bound of the exponential backoff between two attempts."""


@dataclass(frozen=True)
class OutboxRecord:
    """A record in the outbox.

    Attributes:
        number: position in the sending order.
        id: globally unique.
        body: serialized content.
        category: group that is charged for its size when the outbox is full.
    """

    number: int
    id: str
    body: bytes
    category: str = ""


def new_ids() -> Callable[[], str]:
    """Create a generator of record ids: a random identity of this process's producer and a running number."""
    identity, number = uuid.uuid4().hex, 0

    def next_id() -> str:
        nonlocal number
        number += 1
        return f"{identity}:{number}"

    return next_id


def is_record_id(text: str) -> bool:
    """Whether a text is a record id: PRODUCER:NUMBER in ASCII."""
    return re.fullmatch(r"[ -~]{1,300}:[0-9]{1,18}", text) is not None


_TABLE = "CREATE TABLE IF NOT EXISTS records (number INTEGER PRIMARY KEY, id TEXT, share TEXT, body BLOB, sent REAL)"
_UNSENT = "FROM records WHERE sent IS NULL"


class Outbox:
    """First-in, first-out queue of records in an SQLite file; thread-safe, open in one process at a time.

    When the outbox is full, the category that occupies the most bytes loses its oldest record (longest queue drop:
    Suter et al., Design considerations for supporting TCP with per-flow queueing, 1998), so that a flood of one
    category doesn't displace the others.

    Attributes:
        dropped: number of records dropped unsent because the outbox or the disk was full, by category.
    """

    def __init__(self, path: Path, max_bytes: int = MAX_OUTBOX_BYTES) -> None:
        """Open or create the file; records that an earlier process left there are sent first.

        If that process left unsent records, the broker may have gone away and lost the last ones it acknowledged: these
        are sent again.

        Raises:
            BusyError: another process has the file open.
            InputError: the file isn't an outbox.
        """
        self._max_bytes, self._lock = max_bytes, threading.Lock()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._database = _open_locked(path)
        sizes = self._database.execute("SELECT share, sum(length(body)) FROM records GROUP BY share").fetchall()
        self._bytes = Counter(dict(sizes))
        self.dropped = Counter[str]()
        if len(self):
            self.requeue_sent()

    def append(self, record_id: str, body: bytes, category: str = "") -> None:
        """Store a record; drops the oldest record of the largest category while the outbox is over its size."""
        with self._lock:
            try:
                insert = "INSERT INTO records (id, share, body) VALUES (?, ?, ?)"
                self._database.execute(insert, (record_id, category, body))
            except sqlite3.OperationalError as error:  # the disk is full
                self.dropped[category] += 1
                log.warning("a record could not be stored and was dropped: %s", error)
                return
            self._bytes[category] += len(body)
            while self._bytes.total() > self._max_bytes:
                (largest, _), *_ = self._bytes.most_common(1)
                oldest = "SELECT number, sent IS NULL FROM records WHERE share = ? ORDER BY number LIMIT 1"
                number, unsent = self._database.execute(oldest, (largest,)).fetchone()
                self._delete("number = ?", number)
                if unsent and not self.dropped[largest]:
                    log.warning("the outbox is full: its oldest unsent %s are dropped", largest or "records")
                self.dropped[largest] += unsent

    def take_over(self, other: Outbox) -> None:
        """Move all unsent records of another outbox into this one."""
        while batch := other.pending():
            for record in batch:
                self.append(record.id, record.body, record.category)
            other.acknowledge(batch[-1])

    def pending(self, count: int = BATCH_RECORDS) -> list[OutboxRecord]:
        """The oldest unsent records, in order."""
        with self._lock:
            query = f"SELECT number, id, body, share {_UNSENT} ORDER BY number LIMIT ?"
            return [OutboxRecord(*row) for row in self._database.execute(query, (count,))]

    def acknowledge(self, last: OutboxRecord) -> None:
        """Mark a record and all before it as sent; they are deleted after `RESEND_WINDOW_S`."""
        now = time.time()
        with self._lock:
            self._database.execute("UPDATE records SET sent = ? WHERE number <= ? AND sent IS NULL", (now, last.number))
            self._delete("sent < ?", now - RESEND_WINDOW_S)

    def requeue_sent(self) -> None:
        """Mark the recently acknowledged records as unsent: the broker that took them is gone."""
        with self._lock:
            self._database.execute("UPDATE records SET sent = NULL")

    def __len__(self) -> int:
        """Number of unsent records."""
        with self._lock:
            return int(self._database.execute(f"SELECT count(*) {_UNSENT}").fetchone()[0])

    def _delete(self, condition: str, value: float) -> None:
        sizes = self._database.execute(
            f"SELECT share, sum(length(body)) FROM records WHERE {condition} GROUP BY share", (value,)
        )
        self._bytes.subtract(dict(sizes.fetchall()))
        self._database.execute(f"DELETE FROM records WHERE {condition}", (value,))

    def close(self) -> None:
        """Close the file and release its lock."""
        with self._lock:
            self._database.close()


def _open_locked(path: Path) -> sqlite3.Connection:
    """Open the file with an exclusive lock, which lasts until it is closed or the process ends for any reason."""
    database = None
    try:
        database = sqlite3.connect(path, timeout=0, check_same_thread=False, isolation_level=None)
        database.execute("PRAGMA locking_mode = EXCLUSIVE")
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = OFF")  # a kill loses nothing, a power cut the last moments
        database.execute(_TABLE)
        database.execute("UPDATE records SET share = share WHERE number IS NULL")  # changes nothing but takes the lock
    except sqlite3.DatabaseError as error:
        if database is not None:
            database.close()
        if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
            cause = "another process is using this outbox file"
            raise BusyError(path, cause, "Give each process its own --outbox FILE") from None
        raise InputError(path, f"not an outbox file ({error})", "Name another file, or move this one away") from None
    return database


class Sender:
    """Sends the records of an outbox in a background thread and retries with backoff; `append` never blocks."""

    def __init__(self, outbox: Outbox, send: Callable[[Sequence[OutboxRecord]], None]) -> None:
        """Start the thread.

        Args:
            outbox: whose records are sent.
            send: returns when all records are acknowledged, in order; raises ConnectionError if they weren't, or if the
                broker that took the previous ones is gone.
        """
        self._outbox, self._send = outbox, send
        self._wake, self._stop = threading.Event(), threading.Event()
        self._thread = SupervisedThread(self._run, "records")
        self._thread.start()

    def wake(self) -> None:
        """Notify the thread that a record was appended."""
        self._wake.set()

    def close(self, timeout: float = 5.0) -> None:
        """Send the pending records within `timeout` seconds and stop; the rest stays on disk."""
        end = time.monotonic() + timeout
        while len(self._outbox) and time.monotonic() < end and self._thread.is_alive():
            self._wake.set()
            time.sleep(0.02)
        self._stop.set()
        self._wake.set()
        self._thread.join(timeout)

    def _run(self) -> None:
        with contextlib.suppress(sqlite3.ProgrammingError):  # the outbox was closed after `close` timed out
            self._send_pending()

    def _send_pending(self) -> None:
        pause = 0.0
        while not self._stop.is_set():
            batch = self._outbox.pending()
            if not batch:
                self._wake.wait(1.0)
                self._wake.clear()
                continue
            try:
                self._send(batch)
            except ConnectionError as error:
                if not pause:
                    log.warning("records are buffered on disk: %s", error)
                    self._outbox.requeue_sent()
                pause = min(MAX_RETRY_PAUSE_S, 2 * pause or 0.1)
                self._stop.wait(pause)
                continue
            if pause:
                log.warning("the connection is back: buffered records are being sent")
            pause = 0.0
            self._outbox.acknowledge(batch[-1])


class Deduplicator:
    """Recognizes duplicate records by id, with bounded memory."""

    MAX_PRODUCERS = 10_000
    """Producers that are remembered: those of the latest records."""
    MAX_OUTSTANDING = 10_000
    """Numbers of one producer that may still arrive late, after higher ones."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._outstanding: dict[str, set[int]] = {}

    def saved(self) -> dict[str, int]:
        """JSON-serializable state that `restore` takes: the highest number seen by producer."""
        return dict(self._last)

    def restore(self, saved: Mapping[str, int]) -> None:
        """Continue from the state of an earlier process; late numbers below those in it count as seen."""
        self._last.update(saved)

    def is_new(self, record_id: str) -> bool:
        """Whether a record id was not seen before; from now on it counts as seen."""
        producer, _, suffix = record_id.rpartition(":")
        number, last = int(suffix), self._last.pop(producer, 0)
        outstanding = self._outstanding.setdefault(producer, set())
        self._last[producer] = max(last, number)
        if len(self._last) > self.MAX_PRODUCERS:
            oldest = next(iter(self._last))
            del self._last[oldest], self._outstanding[oldest]
        if number > last:
            outstanding.update(range(max(last + 1, number - self.MAX_OUTSTANDING), number))
            return True
        if number in outstanding:
            outstanding.remove(number)
            return True
        return False
