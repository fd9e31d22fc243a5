"""Memory reservation: requests beyond the total wait, killed processes release their memory."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from scan2sim.flows.commands.run_with_progress import default_jobs
from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.memory import free_memory, parse_memory, reserve_memory
from scan2sim.flows.engine.planning import plan
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import ScanError, SettingError
from tests.conftest import ROOT
from tests.flows.toy import chain


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def test_amounts_of_memory_are_parsed() -> None:
    assert (
        parse_memory("20GB") == 20
        and parse_memory("800 MB") == 0.8
        and parse_memory("1.5") == 1.5
        and parse_memory(None) is None
    )
    for wrong in ("lots", "0GB", "-3", "nan", "inf", "1e300GB", "9" * 400, "99999999999GB"):
        with pytest.raises(SettingError, match="not an amount"):
            parse_memory(wrong)


def test_free_memory_is_that_of_the_machine_and_of_the_container(tmp_path: Path) -> None:
    proc, limit = tmp_path / "meminfo", tmp_path / "memory.max"
    proc.write_text("MemTotal: 64000000 kB\nMemAvailable: 20000000 kB\n")
    limit.write_text("max\n")
    (tmp_path / "memory.current").write_text("6000000000\n")
    (tmp_path / "memory.stat").write_text("anon 2000000000\ninactive_file 4000000000\n")
    assert free_memory(proc, tmp_path) == pytest.approx(0.8 * 20.48)
    limit.write_text("10000000000\n")
    assert free_memory(proc, tmp_path) == pytest.approx(0.8 * 8)
    membership, job = tmp_path / "membership", tmp_path / "memory" / "job_7"
    membership.write_text("4:memory:/job_7\n0::/\n")
    job.mkdir(parents=True)
    for name, value in (("limit_in_bytes", 7e9), ("usage_in_bytes", 3e9)):
        (job / f"memory.{name}").write_text(f"{value:.0f}\n")
    (job / "memory.stat").write_text("cache 2000000000\ninactive_file 1000000000\n")
    assert free_memory(proc, tmp_path, membership) == pytest.approx(0.8 * 5), "a job of a cluster"
    limit.write_text("1000000000\n")
    assert free_memory(proc, tmp_path) == 0.25, "a step runs, alone"
    assert free_memory(tmp_path / "none", tmp_path / "none") is None, "unknown: no limit"


def test_more_cores_run_more_steps_of_a_survey(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scan2sim.pipeline.core.cores.cpu_limit", lambda: None)
    for cores, of_one_tile, of_ten in ((1, 2, 2), (4, 2, 2), (6, 3, 3), (16, 3, 8), (64, 3, 30)):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, cores=cores: set(range(cores)))
        assert (default_jobs(), default_jobs(tiles=10)) == (of_one_tile, of_ten)


def test_reservation_beyond_the_total_waits_until_enough_is_released() -> None:
    held, attempts = ExitStack(), 0

    def release_after_three_attempts(_: float) -> None:
        nonlocal attempts
        attempts += 1
        if attempts == 3:
            held.close()

    with reserve_memory(4.0, 1.5):
        held.enter_context(reserve_memory(4.0, 1.5))
        with reserve_memory(4.0, 1.5, sleep=release_after_three_attempts):
            assert attempts == 3
        with reserve_memory(4.0, 1.5, sleep=release_after_three_attempts):
            assert attempts == 3, "there is enough for two"


def test_threads_share_the_total() -> None:
    """Of four threads that reserve more than a third, always two are inside together, and never more."""
    inside, most, pair = set[int](), [], threading.Barrier(2, timeout=60)

    def work(number: int) -> None:
        with reserve_memory(4.0, 1.5):
            inside.add(number)
            most.append(len(inside))
            pair.wait()
            inside.remove(number)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    assert max(most) == 2 and len(most) == 4


def test_reservation_larger_than_the_total_runs_alone() -> None:
    held, attempts = ExitStack(), 0

    def release(_: float) -> None:
        nonlocal attempts
        attempts += 1
        held.close()

    held.enter_context(reserve_memory(1.0, 50.0))
    with reserve_memory(1.0, 0.25, sleep=release):
        assert attempts == 1
    held.enter_context(reserve_memory(1.0, 0.25))
    with reserve_memory(1.0, 50.0, sleep=release):
        assert attempts == 2


def test_waiting_reservation_is_not_overtaken_by_a_smaller_one(tmp_path: Path) -> None:
    held = ExitStack()

    def try_the_queue(_: float) -> None:
        (folder,) = tmp_path.glob("scan2sim-memory-*")
        with open(folder / "queue", "rb") as queue, pytest.raises(BlockingIOError):
            fcntl.flock(queue, fcntl.LOCK_EX | fcntl.LOCK_NB)
        held.close()

    held.enter_context(reserve_memory(1.0, 0.5))
    with reserve_memory(1.0, 1.0, sleep=try_the_queue):
        pass


def test_killed_process_releases_its_memory(tmp_path: Path) -> None:
    script = (
        f"import sys, tempfile; tempfile.tempdir = {str(tmp_path)!r}\n"
        "from scan2sim.flows.engine.memory import reserve_memory\n"
        "with reserve_memory(1.0, 1.0): print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", script]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout and child.stdout.readline() == b"held\n"
        child.kill()

    def fail(_: float) -> None:
        raise AssertionError("it waits")

    with reserve_memory(1.0, 1.0, sleep=fail):
        pass


@pytest.mark.parametrize("planted", ["folder", "queue", "00000", "file", "another user's"])
def test_files_planted_by_others_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, planted: str) -> None:
    victim, folder = tmp_path / "victim", tmp_path / f"scan2sim-memory-{os.getuid()}"
    (victim / "below").mkdir(parents=True)
    (victim / "kept.txt").write_text("precious", encoding="utf-8")
    if planted == "folder":
        folder.symlink_to(victim / "below")
    elif planted == "file":
        folder.write_text("precious", encoding="utf-8")
    else:
        folder.mkdir()
        if planted == "another user's":
            uid = os.getuid()
            monkeypatch.setattr(os, "getuid", lambda: uid + 1)
            folder.rename(tmp_path / f"scan2sim-memory-{uid + 1}")
        else:
            (folder / planted).symlink_to(victim / "kept.txt")
    with pytest.raises(ScanError, match="scan2sim-memory|queue|00000"), reserve_memory(1.0, 0.25):
        pass
    assert (victim / "kept.txt").read_text(encoding="utf-8") == "precious" and not list((victim / "below").iterdir())


def test_queue_folder_is_private_to_the_user(tmp_path: Path) -> None:
    with reserve_memory(1.0, 0.25):
        (folder,) = tmp_path.glob("scan2sim-memory-*")
        assert folder.stat().st_mode & 0o777 == 0o700


def test_tasks_that_exceed_the_memory_together_run_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scan2sim.flows.engine.execution.expected_memory", lambda *_: 3.0)
    (tmp_path / "source.txt").write_text("1", encoding="utf-8")
    running: set[int] = set()
    most: list[int] = []

    def on_event(task: object, event: str, *_: object) -> None:
        (running.add if event == "start" else running.discard)(id(task))
        most.append(len(running))

    store = Store(tmp_path / "store")
    planned = plan(chain(tmp_path / "source.txt", tmp_path / "log"), store)
    outcome = execute(planned, store, jobs=4, on_event=on_event, memory=5.0)
    assert set(outcome.of_tile()) == set("abcd") and max(most) == 1
