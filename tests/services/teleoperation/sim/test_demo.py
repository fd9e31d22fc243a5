"""The demo: its processes are started again when they end, and none outlives it."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")

from scan2sim.pipeline.core.splats import SplatLayer, Splats
from scan2sim.pipeline.io.worlds.scene import SPLATS_FILE
from scan2sim.services.teleoperation.settings import DemoParams
from scan2sim.services.teleoperation.sim import demo as demo_module
from scan2sim.services.teleoperation.sim.demo import FOLDER_PREFIX, LOCK_FILE, Demo, delete_abandoned_folders
from tests.conftest import ROOT
from tests.fakes import synthetic
from tests.waiting import until


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Demo:
    """A demo of processes that only wait."""
    monkeypatch.setattr(demo_module, "RESTART_DELAY_MIN_S", 0.1)
    monkeypatch.setattr(demo_module, "CHILD", "import sys, time; time.sleep(600)")
    one = Demo(DemoParams(world=tmp_path), tmp_path)
    for name in ("gateway", "station", "adapter", "vehicle"):
        one._run(name)
    return one


def test_any_process_that_ends_is_started_again_and_reported(demo: Demo) -> None:
    try:
        for name, pid in demo.pids().items():
            os.kill(pid, signal.SIGKILL)
            news: list[str] = []

            def restarted() -> bool:
                demo.supervise(news.append)  # noqa: B023
                return demo.pids()[name] != pid  # noqa: B023

            until(restarted)
            assert f"{name} was killed by signal 9; it starts again" in news[0] and "was started again" in news[1]
            assert len({*demo.pids().values()}) == 4
    finally:
        demo.close()
    assert all(part.process.poll() is not None for part in demo._parts.values())


def test_car_shows_splats_with_one_camera_or_surfaces_with_four(tmp_path: Path) -> None:
    tile = synthetic.scene(tmp_path, tiles=1).tiles[0]
    world = tile.folder.parents[1]
    four = [("front", 0), ("left", 90), ("right", -90), ("rear", 180)]

    def chosen(**settings: object) -> list[str]:
        return demo_module.camera_options(DemoParams.model_validate({"world": world, **settings}))

    assert chosen() == [f"{name}=world:{world}@{turn}" for name, turn in four]
    splats = Splats.of(np.zeros((1, 3)), np.ones((1, 3)), np.eye(1, 4), np.full(1, 0.9), np.ones((1, 3)))
    SplatLayer(splats, np.ones((2, 4, 3), np.float32)).save(tile.folder / SPLATS_FILE)
    assert chosen() == [f"front=world:{world}@0"]
    assert chosen(cameras=2) == [f"{name}=world:{world}@{turn}" for name, turn in four[:2]]
    assert chosen(surfaces=True) == [f"{name}=surfaces:{world}@{turn}" for name, turn in four]


def test_failure_is_reported_with_its_log(demo: Demo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_module, "CHILD", "raise SystemExit('the world is flat')")
    try:
        demo._run("camera")
        news: list[str] = []

        def reported() -> bool:
            demo.supervise(news.append)
            return len(news) >= 3

        until(reported)
        assert "camera has ended with exit status 1: the world is flat; it starts again in 0 s" in news[0]
    finally:
        demo.close()


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel ends children with their parent on Linux only")
def test_children_end_with_a_killed_demo(tmp_path: Path) -> None:
    """With the real program of its processes, of which `adapter` waits for orders."""
    key = tmp_path / "key"
    key.write_text("k" * 32, encoding="utf-8")
    key.chmod(0o600)
    program = f"""
import time
from pathlib import Path
from scan2sim.services.teleoperation.settings import DemoParams
from scan2sim.services.teleoperation.sim.demo import Demo
demo = Demo(DemoParams(world=Path("w")), Path({str(tmp_path)!r}))
demo._run("adapter", "ros", "--port", "0", "--key", {str(key)!r})
while "listens on" not in demo._log("adapter").read_text():
    time.sleep(0.1)
print(demo.pids()["adapter"], flush=True)
time.sleep(600)
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, env=environment
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        assert Path(f"/proc/{child}").exists()
        parent.kill()
        until(lambda: not Path(f"/proc/{child}").exists() or "zombie" in Path(f"/proc/{child}/status").read_text())


def test_folders_of_killed_demos_are_deleted_and_those_of_running_ones_stay(tmp_path: Path) -> None:
    for name in ("killed", "running"):
        folder = tmp_path / f"{FOLDER_PREFIX}{name}" / "parties" / "gateway"
        folder.mkdir(parents=True)
        (folder / "key.pem").write_text("secret", encoding="utf-8")
        (tmp_path / f"{FOLDER_PREFIX}{name}" / LOCK_FILE).touch()
    (tmp_path / f"{FOLDER_PREFIX}starting").mkdir()
    (tmp_path / "other").mkdir()
    with (tmp_path / f"{FOLDER_PREFIX}running" / LOCK_FILE).open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert delete_abandoned_folders(tmp_path) == 1
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {f"{FOLDER_PREFIX}running", f"{FOLDER_PREFIX}starting", "other"}
