"""Memory reservation: requests beyond the total wait, killed processes release their memory."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.memory import parse_memory, reserve_memory
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


def test_reservations_beyond_the_total_wait() -> None:
    inside, most = [], []

    def work() -> None:
        with reserve_memory(4.0, 1.5):
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.2)
            inside.pop()

    threads = [threading.Thread(target=work) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 2 and len(most) == 5


def test_reservation_larger_than_the_total_runs_alone() -> None:
    with reserve_memory(1.0, 50.0):
        waited = threading.Event()

        def wait() -> None:
            with reserve_memory(1.0, 0.25):
                waited.set()

        thread = threading.Thread(target=wait)
        thread.start()
        assert not waited.wait(0.5)
    assert waited.wait(5)
    thread.join()


def test_killed_process_releases_its_memory(tmp_path: Path) -> None:
    script = (
        f"import tempfile, time; tempfile.tempdir = {str(tmp_path)!r}\n"
        "from scan2sim.flows.engine.memory import reserve_memory\n"
        "with reserve_memory(1.0, 1.0): print('held', flush=True); time.sleep(60)"
    )
    child = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE)
    assert child.stdout and child.stdout.readline()
    child.send_signal(signal.SIGKILL)
    child.wait()
    with reserve_memory(1.0, 1.0):
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
