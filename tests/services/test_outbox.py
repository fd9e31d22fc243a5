"""Records: kept in order and within bounds, sent once there is who takes them, doubles dropped."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import BusyError, InputError, SpaceError
from scan2sim.services import default_outbox
from scan2sim.services.outbox import Kept, Once, Sender, Spool, new_ids

APPENDS = """
import sys, itertools
from pathlib import Path
from scan2sim.services.outbox import Spool
spool = Spool(Path(sys.argv[1]))
for number in itertools.count(1):
    spool.append(f"maker:{number}", b"x" * 200)
    print(number, flush=True)
"""


class Taker:
    """Takes records when it is there."""

    def __init__(self, there: bool = True) -> None:
        self.there, self.taken, self.tries = there, list[str](), 0
        self._lock = threading.Lock()

    def __call__(self, records: Sequence[Kept]) -> None:
        with self._lock:
            self.tries += 1
            if not self.there:
                raise ConnectionError("nobody is there")
            self.taken += [record.id for record in records]


def wait(condition: object) -> None:
    end = time.monotonic() + 20
    while not condition() and time.monotonic() < end:  # type: ignore[operator]
        time.sleep(0.01)


def test_records_that_nobody_takes_wait_and_go_in_order(tmp_path: Path) -> None:
    spool, taker = Spool(tmp_path / "records"), Taker(there=False)
    sender = Sender(spool, taker)
    for number in range(1200):
        spool.append(f"a:{number}", b"body")
    sender.wake()
    wait(lambda: taker.tries)
    assert len(spool) == 1200
    taker.there = True
    wait(lambda: not len(spool))
    sender.close()
    assert taker.taken == [f"a:{number}" for number in range(1200)]


def test_records_outlive_a_kill_of_their_maker(tmp_path: Path) -> None:
    maker = subprocess.Popen([sys.executable, "-c", APPENDS, tmp_path / "records"], stdout=subprocess.PIPE, text=True)
    assert maker.stdout
    for line in maker.stdout:
        if int(line) == 300:
            maker.send_signal(signal.SIGKILL)
            break
    maker.wait()
    kept = Spool(tmp_path / "records").first(1000)
    assert [record.id for record in kept][:300] == [f"maker:{number}" for number in range(1, 301)]


def test_a_full_disk_share_drops_the_oldest_and_says_how_many(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "records", most_bytes=1000)
    for number in range(50):
        spool.append(f"a:{number}", b"x" * 100)
    assert [record.id for record in spool.first()] == [f"a:{number}" for number in range(40, 50)]
    assert spool.dropped == {"": 40}
    spool.close()
    again = Spool(tmp_path / "records", most_bytes=1000)  # bounds hold over lives
    again.append("b:1", b"x" * 100)
    assert len(again) == 10


def test_what_holds_no_records_is_told_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "records").write_text(
        "these are no records, but a text that is longer than a header" * 99, encoding="utf-8"
    )
    with pytest.raises(InputError, match="records"):
        Spool(tmp_path / "records")


def test_what_was_taken_by_one_who_went_away_is_sent_again(tmp_path: Path) -> None:
    spool, taker = Spool(tmp_path / "records"), Taker()
    sender = Sender(spool, taker)
    for number in range(1, 4):
        spool.append(f"a:{number}", b"body")
    sender.wake()
    wait(lambda: len(taker.taken) == 3)
    wait(lambda: not len(spool))
    taker.there, taker.taken = False, []  # it dies, and what it took with it
    spool.append("a:4", b"body")
    sender.wake()
    wait(lambda: taker.tries > 2)
    taker.there = True
    wait(lambda: not len(spool))
    sender.close()
    assert taker.taken == ["a:1", "a:2", "a:3", "a:4"]


@pytest.mark.filterwarnings("error")
def test_what_an_earlier_life_left_unsent_brings_what_it_had_sent_just_before_along(tmp_path: Path) -> None:
    earlier = Spool(tmp_path / "spool")
    earlier.append("a:1", b"taken by a broker")
    earlier.done(earlier.first()[-1])
    earlier.append("a:2", b"which was gone then")
    earlier.close()
    later = Spool(tmp_path / "spool")
    assert [one.id for one in later.first()] == ["a:1", "a:2"]
    later.done(later.first()[-1])
    later.close()
    assert len(Spool(tmp_path / "spool")) == 0


def test_a_spool_that_is_closed_while_its_sender_waits_for_an_answer_ends_it(tmp_path: Path) -> None:
    sending, answered, spool = threading.Event(), threading.Event(), Spool(tmp_path / "records")

    def send(_: Sequence[Kept]) -> None:
        sending.set()
        answered.wait(20)
        raise ConnectionError("nobody is there")

    sender = Sender(spool, send)
    spool.append("maker:1", b"x")
    sender.wake()
    assert sending.wait(20)
    sender.close(0.05)
    spool.close()
    answered.set()
    wait(lambda: not any(thread.name == "records" for thread in threading.enumerate()))


def test_records_that_come_after_later_ones_are_no_doubles() -> None:
    once = Once()
    assert [once.new(f"a:{number}") for number in (1, 2, 5, 3, 3, 4, 5, 6)] == [
        True, True, True, True, False, True, False, True,
    ]  # fmt: skip


def test_doubles_are_dropped_and_lives_of_a_node_are_told_apart() -> None:
    once, ids, others = Once(), new_ids(), new_ids()
    first, second, other = ids(), ids(), others()
    assert [once.new(one) for one in (first, second, first, second, other, other, ids())] == [
        True, True, False, False, True, False, True,
    ]  # fmt: skip


def test_a_flood_drops_its_own_and_crowds_nothing_out(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "records", most_bytes=10_000)
    for number in range(5):
        spool.append(f"alarm:{number}", b"x" * 100, "alarm")
    for number in range(1000):
        spool.append(f"count:{number}", b"x" * 100, "count")
    kept = [record.id for record in spool.first(1000)]
    assert kept[:5] == [f"alarm:{number}" for number in range(5)] and kept[5:] == [
        f"count:{number}" for number in range(905, 1000)
    ]
    assert spool.dropped == {"count": 905}
    spool.close()


def test_a_file_is_one_process_at_a_time(tmp_path: Path) -> None:
    first = Spool(tmp_path / "records")
    with pytest.raises(BusyError, match="--spool"):
        Spool(tmp_path / "records")
    first.close()
    Spool(tmp_path / "records").close()


NAMED = """
import sys, time
from scan2sim.services import spools
spool = spools.opened("/talker", "monitor_data")
spool.append(f"{sys.argv[1]}:1", b"body")
print(len(spool), flush=True)
time.sleep(60)
"""


def test_two_of_one_name_keep_apart_and_what_dead_ones_left_is_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    running = []
    for name in ("a", "b"):  # one after the other: who looks into a file has it for that moment
        process = subprocess.Popen([sys.executable, "-c", NAMED, name], stdout=subprocess.PIPE, text=True)
        assert process.stdout and process.stdout.readline() == "1\n"
        running.append(process)
    folder = tmp_path / "scan2sim" / "spools"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert sorted(path.name for path in folder.glob("*.spool")) == [
        "talker.monitor_data.1.spool", "talker.monitor_data.2.spool",
    ]  # fmt: skip
    for process in running:
        process.kill()
        process.wait()
    heir = default_outbox.opened("/talker", "monitor_data")
    assert sorted(record.id for record in heir.first()) == ["a:1", "b:1"]
    heir.close()
    again = default_outbox.opened("/talker", "monitor_data")
    assert len(again) == 2  # and are there once
    again.close()


def test_a_state_folder_that_cannot_be_is_told_with_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with pytest.raises(SpaceError, match="XDG_STATE_HOME"):
        default_outbox.opened("/talker", "monitor_data")
