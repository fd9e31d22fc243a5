"""Records with ids: kept on disk within bounds, sent in order once there is who takes them, doubles dropped by id.

A record may be sent twice: when its sender died before it was acknowledged, or when who took it went away soon after (a
broker that keeps all in memory forgets it). Who reads them drops doubles by id.
"""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from scan2sim.pipeline.core.errors import BusyError, InputError

log = logging.getLogger(__name__)

KEPT_BYTES = 64 * 2**20
"""Bytes of records that wait on disk, at most: at 5 kB a second for over three hours."""
SENT_AGAIN = 60.0
"""Seconds for which records are kept that were acknowledged, to be sent again if their taker goes away."""
BATCH = 500
"""Records sent at once."""
LONGEST_PAUSE = 5.0
"""Seconds between two tries, at most."""


@dataclass(frozen=True)
class Kept:
    """A record that waits.

    Attributes:
        number: its place in the order.
        id: unlike any other's.
        body: what it says.
        share: what it counts for, where room is short.
    """

    number: int
    id: str
    body: bytes
    share: str = ""


def new_ids() -> Callable[[], str]:
    """Makes ids of records: one identity for this life of their maker, and a number that grows."""
    identity, number = uuid.uuid4().hex, 0

    def next_id() -> str:
        nonlocal number
        number += 1
        return f"{identity}:{number}"

    return next_id


_TABLE = "CREATE TABLE IF NOT EXISTS records (number INTEGER PRIMARY KEY, id TEXT, share TEXT, body BLOB, sent REAL)"
_WAIT = "FROM records WHERE sent IS NULL"


class Spool:
    """Records on disk, first in, first out; may be used from any thread, and by one process at a time.

    Where room is short, the share that takes most of it gives up its oldest record (longest queue drop: Suter et al.,
    Design considerations for supporting TCP with per-flow queueing, 1998): none crowds out others.

    Attributes:
        dropped: by share, records that were given up unsent, as there was no room.
    """

    def __init__(self, path: Path, most_bytes: int = KEPT_BYTES) -> None:
        """Keep them in a file, which is made if it isn't there; what an earlier life left there is sent first.

        Where it left any unsent, who took its last ones may have gone away, and forgotten them: they are sent again.

        Raises:
            BusyError: another process has it.
            InputError: there is something else in its place.
        """
        self._most, self._lock = most_bytes, threading.Lock()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._base = _connected(path)
        shares = self._base.execute("SELECT share, sum(length(body)) FROM records GROUP BY share").fetchall()
        self._bytes = Counter(dict(shares))
        self.dropped = Counter[str]()
        if len(self):
            self.again()

    def append(self, record_id: str, body: bytes, share: str = "") -> None:
        """Keep a record."""
        with self._lock:
            try:
                self._base.execute("INSERT INTO records (id, share, body) VALUES (?, ?, ?)", (record_id, share, body))
            except sqlite3.OperationalError as error:  # the disk is full
                self.dropped[share] += 1
                log.warning("a record could not be kept: %s", error)
                return
            self._bytes[share] += len(body)
            while self._bytes.total() > self._most:
                (largest, _), *_ = self._bytes.most_common(1)
                oldest = "SELECT number, sent IS NULL FROM records WHERE share = ? ORDER BY number LIMIT 1"
                number, unsent = self._base.execute(oldest, (largest,)).fetchone()
                self._forget("number = ?", number)
                if unsent and not self.dropped[largest]:
                    log.warning("there is no room on disk for all that waits: the oldest %s go", largest or "records")
                self.dropped[largest] += unsent

    def take_over(self, other: Spool) -> None:
        """Keep what waits in another, which is empty then."""
        while waiting := other.first():
            for record in waiting:
                self.append(record.id, record.body, record.share)
            other.done(waiting[-1])

    def first(self, count: int = BATCH) -> list[Kept]:
        """The records that wait longest, in order."""
        with self._lock:
            rows = self._base.execute(f"SELECT number, id, body, share {_WAIT} ORDER BY number LIMIT ?", (count,))
            return [Kept(*row) for row in rows]

    def done(self, last: Kept) -> None:
        """A record and all before it are acknowledged; they are forgotten after `SENT_AGAIN`."""
        now = time.time()
        with self._lock:
            self._base.execute("UPDATE records SET sent = ? WHERE number <= ? AND sent IS NULL", (now, last.number))
            self._forget("sent < ?", now - SENT_AGAIN)

    def again(self) -> None:
        """Who took the last records is gone: they wait again."""
        with self._lock:
            self._base.execute("UPDATE records SET sent = NULL")

    def __len__(self) -> int:
        """Records that wait."""
        with self._lock:
            return int(self._base.execute(f"SELECT count(*) {_WAIT}").fetchone()[0])

    def _forget(self, which: str, value: float) -> None:
        sizes = self._base.execute(
            f"SELECT share, sum(length(body)) FROM records WHERE {which} GROUP BY share", (value,)
        )
        self._bytes.subtract(dict(sizes.fetchall()))
        self._base.execute(f"DELETE FROM records WHERE {which}", (value,))

    def close(self) -> None:
        """Release the file."""
        with self._lock:
            self._base.close()


def _connected(path: Path) -> sqlite3.Connection:
    """The file, which is locked until it is closed or the process ends, however that comes."""
    base = None
    try:
        base = sqlite3.connect(path, timeout=0, check_same_thread=False, isolation_level=None)
        base.execute("PRAGMA locking_mode = EXCLUSIVE")
        base.execute("PRAGMA journal_mode = WAL")
        base.execute("PRAGMA synchronous = OFF")  # a kill loses nothing, a power cut the last moments
        base.execute(_TABLE)
        base.execute("UPDATE records SET share = share WHERE number IS NULL")  # writes nothing, but takes the lock
    except sqlite3.DatabaseError as error:
        if base is not None:
            base.close()
        if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
            raise BusyError(path, "another process keeps records there", "Give each a --spool of its own") from None
        raise InputError(path, f"can't hold records ({error})", "Name another file, or move that one away") from None
    return base


class Sender:
    """Sends what a spool holds, in a thread of its own, for as long as it takes; whoever appends never waits."""

    def __init__(self, spool: Spool, send: Callable[[Sequence[Kept]], None]) -> None:
        """Begin.

        Args:
            spool: that it empties.
            send: returns when all are acknowledged, in order; raises ConnectionError if not, or if who took the last
                ones is gone.
        """
        self._spool, self._send = spool, send
        self._wake, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="records", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """There is something to send."""
        self._wake.set()

    def close(self, timeout: float = 5.0) -> None:
        """Send what waits if that can be done in so many seconds; the rest stays on disk."""
        end = time.monotonic() + timeout
        while len(self._spool) and time.monotonic() < end and self._thread.is_alive():
            self._wake.set()
            time.sleep(0.02)
        self._stop.set()
        self._wake.set()
        self._thread.join(timeout)

    def _run(self) -> None:
        with contextlib.suppress(sqlite3.ProgrammingError):  # the spool was closed, as `close` waits no longer
            self._empty()

    def _empty(self) -> None:
        pause = 0.0
        while not self._stop.is_set():
            waiting = self._spool.first()
            if not waiting:
                self._wake.wait(1.0)
                self._wake.clear()
                continue
            try:
                self._send(waiting)
            except ConnectionError as error:
                if not pause:
                    log.warning("records wait on disk: %s", error)
                    self._spool.again()
                pause = min(LONGEST_PAUSE, 2 * pause or 0.1)
                self._stop.wait(pause)
                continue
            if pause:
                log.warning("records are sent again")
            pause = 0.0
            self._spool.done(waiting[-1])


class Once:
    """Drops doubles; a reader's memory of what it took, within bounds."""

    MAKERS = 10_000
    """Makers that are remembered, at most: those of the last records."""
    AWAITED = 10_000
    """Numbers of one maker that may still come, after later ones."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._awaited: dict[str, set[int]] = {}

    def new(self, record_id: str) -> bool:
        """Whether a record, by its id, wasn't taken yet; it counts as taken from now on."""
        maker, _, numbered = record_id.rpartition(":")
        number, last = int(numbered), self._last.pop(maker, 0)
        awaited = self._awaited.setdefault(maker, set())
        self._last[maker] = max(last, number)
        if len(self._last) > self.MAKERS:
            oldest = next(iter(self._last))
            del self._last[oldest], self._awaited[oldest]
        if number > last:
            awaited.update(range(max(last + 1, number - self.AWAITED), number))
            return True
        if number in awaited:
            awaited.remove(number)
            return True
        return False
