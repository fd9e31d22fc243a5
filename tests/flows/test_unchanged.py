"""Commands that do nothing: recognised by the status of files, and by nothing less than all of them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from scan2sim.flows.commands import unchanged
from scan2sim.flows.commands.unchanged import OWN_FILES, Watch
from scan2sim.flows.engine.lock import locked
from scan2sim.pipeline.core.errors import BusyError
from tests.conftest import ROOT

Change = Callable[[Path], object]
LINES = ["World: out/world", "nothing to do"]


def command(folder: Path, *more: str) -> list[str]:
    return ["run", str(folder / "tile"), "--out", str(folder / "out"), "--config", str(folder / "a.toml"), *more]


@pytest.fixture
def finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a tile, photos elsewhere, and a recorded run."""
    names = ("tile/tile.toml", "tile/cloud.laz", "photos/1.jpg", "a.toml", "out/steps/voxel/1/cloud.npz")
    for name in (*names, "out/world/world.sdf", "out/run.log", "program/step.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name, encoding="utf-8")
    monkeypatch.setattr(unchanged, "PROGRAM", tmp_path / "program")
    monkeypatch.setattr(unchanged, "SETTLED_NS", 0)
    monkeypatch.setattr(unchanged, "arguments", command(tmp_path))
    watch = Watch([tmp_path / "tile" / "cloud.laz", tmp_path / "photos" / "1.jpg"])
    (tmp_path / "out" / "world" / "mesh.glb").write_text("made by the run", encoding="utf-8")
    watch.record(tmp_path / "out", LINES)
    return tmp_path


def replace_by_same_bytes(path: Path) -> None:
    """Another file with the same content, size and modification time."""
    stat, copy = path.stat(), path.with_suffix(".copy")
    copy.write_bytes(path.read_bytes())
    os.utime(copy, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    copy.replace(path)


def damage(path: Path) -> None:
    """Other bytes with the same size and modification time."""
    stat = path.stat()
    path.write_bytes(bytes(b ^ 1 for b in path.read_bytes()))
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_unchanged_files_and_the_same_command_do_nothing(finished: Path) -> None:
    for name in OWN_FILES[:2]:
        (finished / "out" / name).write_text("more", encoding="utf-8")
    assert unchanged.unchanged(command(finished)) == LINES


@pytest.mark.parametrize(
    "change",
    [
        lambda f: (f / "photos" / "1.jpg").write_text("other", encoding="utf-8"),
        lambda f: (f / "photos" / "1.jgw").write_text("a world file", encoding="utf-8"),
        lambda f: (f / "tile" / "cloud.laz").unlink(),
        lambda f: (f / "tile" / "tile.toml").touch(),
        lambda f: damage(f / "tile" / "cloud.laz"),
        lambda f: replace_by_same_bytes(f / "tile" / "cloud.laz"),
        lambda f: (f / "a.toml").write_text("[voxel]", encoding="utf-8"),
        lambda f: damage(f / "out" / "steps" / "voxel" / "1" / "cloud.npz"),
        lambda f: (f / "out" / "world" / "world.sdf").unlink(),
        lambda f: (f / "out" / "world" / "mesh.glb").write_text("edited", encoding="utf-8"),
        lambda f: (f / "out" / "steps" / "unchanged.json").write_text('{"state": 1}', encoding="utf-8"),
        lambda f: (f / "program" / "step.py").write_text("VERSION = 2", encoding="utf-8"),
    ],
)  # fmt: skip
def test_any_change_leads_to_the_full_comparison(finished: Path, change: Change) -> None:
    change(finished)
    assert unchanged.unchanged(command(finished)) is None


@pytest.mark.parametrize("more", [("--set", "voxel.size=0.2"), ("--force",), ("--from", "voxel"), ("--bus=ros2",)])
def test_other_options_lead_to_the_full_comparison(finished: Path, more: tuple[str, ...]) -> None:
    assert unchanged.unchanged(command(finished, *more)) is None


def test_sources_that_were_just_written_are_not_recorded(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unchanged, "SETTLED_NS", 10**12)
    (finished / "out" / unchanged.RECORD).unlink()
    Watch([finished / "tile" / "cloud.laz"]).record(finished / "out", LINES)
    assert unchanged.unchanged(command(finished)) is None


def test_folder_in_use_is_reported(finished: Path) -> None:
    with locked(finished / "out"), pytest.raises(BusyError):
        unchanged.unchanged(command(finished))


def test_comparison_imports_no_step() -> None:
    code = "import sys, scan2sim.flows.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not {"numpy", "pydantic", "rich.console", "scan2sim.pipeline.core.step"} & set(loaded.split())
