"""Runs that are stopped, results that are damaged, and a full disk: messages, and the same world after the next run."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.flows.command import assert_fails, in_process, options, stdout_of
from tests.flows.inline_steps import inline_steps
from tests.flows.processes import processes
from tests.flows.tiny import COARSE, tiny
from tests.waiting import until

FAST = options(COARSE | {"export": {}})


@pytest.fixture(scope="module")
def street(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small street with a tenth of its points and half of its photos, of half their size."""
    return tiny(small_street, tmp_path_factory.mktemp("street") / "tile", photos=4, photo_scale=0.5, truth=False)


@pytest.fixture(scope="module")
def world(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the small street, with all steps in one process."""
    out = tmp_path_factory.mktemp("world")
    with inline_steps():
        stdout_of(in_process("run", street, "--out", out, "--hold-out", 2, *FAST))
    return out


def without_last_steps(world: Path, out: Path, first: str) -> None:
    """Copy a finished run without the result of a step and those of all steps that ended later."""
    shutil.copytree(world, out, symlinks=True)
    ended = {path.parent: path.stat().st_mtime_ns for path in (out / "steps").glob("*/*/manifest.json")}
    since = min(time for folder, time in ended.items() if folder.parent.name == first)
    for step in {folder.parent for folder, time in ended.items() if time >= since}:
        shutil.rmtree(step)


def flip(path: Path, *, hide: bool = False) -> None:
    """Flip a bit in the middle of a file; with `hide`, restore its modification time."""
    stat, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    if hide:
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


@inline_steps()
def test_damaged_results_are_reported_and_rebuilt(street: Path, world: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(world, out, symlinks=True)
    command = ["run", street, "--out", out, "--hold-out", 2, *FAST]
    assert "are intact" in stdout_of(in_process("verify", out))
    assert "nothing to do" in stdout_of(in_process(*command))

    (page,) = list((out / "world").rglob("*building*.png"))[:1]
    (sdf,) = (out / "world").glob("*.sdf")
    whole = page.read_bytes(), sdf.read_bytes()
    flip(page)
    flip(sdf)  # can't be distinguished from an edit
    changed = f"{sdf} was edited and is kept"
    checked = in_process("verify", out)
    assert checked.returncode == 5 and changed in checked.stdout and "1 of" in checked.stderr
    assert changed in stdout_of(in_process(*command))
    assert page.read_bytes() == whole[0] and sdf.read_bytes() != whole[1]
    assert changed in stdout_of(in_process(*command))
    sdf.unlink()
    stdout_of(in_process(*command))
    made = next((out / "steps" / "export").rglob(sdf.name))
    assert (page.read_bytes(), sdf.read_bytes()) == (whole[0], made.read_bytes())

    kept = next((out / "steps" / "decimate.terrain").glob("*/mesh.npz"))
    whole = kept.read_bytes(), page.read_bytes()
    flip(kept, hide=True)
    page.unlink()
    page.write_bytes(whole[1])
    flip(page, hide=True)
    result = in_process("verify", out)
    assert result.returncode == 5 and "Traceback" not in result.stderr
    assert "decimate.terrain" in result.stdout and page.name in result.stdout
    printed = stdout_of(in_process(*command))
    assert (kept.read_bytes(), page.read_bytes()) == whole
    assert [line.split()[1] for line in printed.splitlines() if line.startswith("✓")] == ["decimate.terrain"]
    stdout_of(in_process("verify", out))
    assert_fails(in_process("verify", tmp_path), 3, "contains no results")


@pytest.mark.parametrize("megabytes", [6, pytest.param(40, marks=pytest.mark.slow)])
def test_full_disk_is_a_space_error(small_street: Path, tmp_path: Path, megabytes: int) -> None:
    mount = tmp_path / "small_disk"
    mount.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(mount)], capture_output=True
    ).returncode:
        pytest.skip("a small file system can't be mounted here (not root)")
    try:
        assert_fails(
            in_process("run", small_street, "--out", mount / "out", *FAST), 6, "no space left", "Free some space"
        )
    finally:
        subprocess.run(["umount", "--lazy", str(mount)], check=True)


def test_ctrl_c_prints_a_message_and_releases_the_lock(street: Path, world: Path, tmp_path: Path) -> None:
    started = tmp_path / "out" / "steps" / "poisson.terrain"
    without_last_steps(world, tmp_path / "out", started.name)
    arguments = ["run", str(street), "--out", str(tmp_path / "out"), "--hold-out", "2", *FAST]
    command = [sys.executable, "-m", "scan2sim.flows.cli", *arguments]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until(lambda: child.poll() is not None or started.exists(), 240, what="the step")
    child.send_signal(signal.SIGINT)
    _, message = child.communicate()
    assert child.returncode == 130 and "finished steps are kept" in message and "Traceback" not in message
    assert_fails(
        in_process("run", street, "--out", tmp_path / "out", "--from", "roof"), 2, "no such step"
    )  # not BusyError


@pytest.mark.parametrize(
    "step",
    [
        "poisson.terrain",
        *(pytest.param(s, marks=pytest.mark.slow) for s in ("ingest", "unwrap.building", "texture.terrain", "export")),
    ],
)
def test_resume_after_sigkill_gives_identical_textures(
    street: Path, world: Path, tmp_path: Path, step: str
) -> None:  # fmt: skip
    arguments = ["run", str(street), "--out", str(tmp_path / "out"), "--hold-out", "2", *FAST]
    command = [sys.executable, "-m", "scan2sim.flows.cli", *arguments]
    own = {"RUN_TO_KILL": str(tmp_path)}
    child = subprocess.Popen(
        command, cwd=ROOT, env=os.environ | own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    folder = tmp_path / "out" / "steps" / step
    until(lambda: child.poll() is not None or folder.exists(), 240, what="the step")
    child.send_signal(signal.SIGKILL)
    child.wait()
    until(lambda: not processes("RUN_TO_KILL", str(tmp_path)), what="the end of all its processes")
    finished = {p.parent.name for p in (tmp_path / "out" / "steps").glob("*/*") if not p.name.startswith(".tmp-")}
    with inline_steps():
        out = stdout_of(in_process(*arguments))
    again = {line.split()[1] for line in out.splitlines() if line.startswith("✓")}
    assert not finished & again, "finished steps are not repeated"
    assert (tmp_path / "out" / "report.html").is_file()
    assert not list((tmp_path / "out" / "steps").rglob(".tmp-*"))
    for path in sorted((world / "world").rglob("*.png")):
        twin = tmp_path / "out" / path.relative_to(world)
        assert np.array_equal(np.frombuffer(path.read_bytes(), np.uint8), np.frombuffer(twin.read_bytes(), np.uint8)), (
            path
        )
