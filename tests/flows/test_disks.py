"""Disks as strangers have them: exFAT without links and permissions, network drives without locks."""

from __future__ import annotations

import errno
import fcntl
import os
import platform
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scan2sim.flows.commands.drive import _link
from scan2sim.flows.engine.lock import locked, warning_of_local_locks
from scan2sim.pipeline.core.errors import BusyError, UnavailableError
from scan2sim.pipeline.io.file_checks import copy_tree
from scan2sim.pipeline.io.worlds.merge import link, swap
from tests.flows.inline_steps import inline_steps
from tests.flows.tiny import COARSE, tiny
from tests.flows.tiny import scan2sim as run_scan2sim


def refuse(code: int) -> Callable[..., Any]:
    """A function of the operating system that always fails."""

    def refused(*arguments: Any, **options: Any) -> None:
        raise OSError(code, os.strerror(code))

    return refused


@pytest.fixture
def tile(small_street: Path, tmp_path: Path) -> Path:
    return tiny(small_street, tmp_path / "tile", photo_scale=0.5, truth=False)


@pytest.fixture
def exfat(monkeypatch: pytest.MonkeyPatch) -> None:
    for owner, name in ((os, "link"), (os, "symlink"), (os, "chmod")):
        monkeypatch.setattr(owner, name, refuse(errno.EPERM))


def test_a_world_is_built_on_a_disk_without_links(tile: Path, tmp_path: Path, exfat: None) -> None:
    out = tmp_path / "out"
    for reused in (False, True):
        with inline_steps():
            code, text = run_scan2sim("run", tile, "--out", out, settings=COARSE)
        assert code == 0, text
        assert ("nothing to do" in text) == reused, text
    assert (out / "world" / "street.sdf").is_file()
    photos = list((out / "steps" / "views").glob("*/views/photos/*"))
    assert photos and not any(photo.is_symlink() for photo in photos)


def test_folders_are_copied_to_a_disk_that_refuses_times(
    tmp_path: Path, exfat: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "utime", refuse(errno.EPERM))
    (tmp_path / "made" / "meshes").mkdir(parents=True)
    (tmp_path / "made" / "meshes" / "ground.glb").write_bytes(b"mesh")
    for _ in range(2):  # the second time into the folder of the first one
        copy_tree(tmp_path / "made", tmp_path / "world", link)
    assert (tmp_path / "world" / "meshes" / "ground.glb").read_bytes() == b"mesh"


def test_world_is_replaced_although_a_simulator_has_the_earlier_ones_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NFS keeps the name of an open file, and so its folder."""
    for name in ("first", "second", "third"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "ground.glb").write_text(name, encoding="utf-8")
    with monkeypatch.context() as nfs:
        nfs.setattr(shutil, "rmtree", lambda *_, **__: None)
        for name in ("first", "second", "third"):
            swap(tmp_path / name, tmp_path / "world")
            assert (tmp_path / "world" / "ground.glb").read_text(encoding="utf-8") == name
    (tmp_path / "fourth").mkdir()
    swap(tmp_path / "fourth", tmp_path / "world")
    assert [path.name for path in tmp_path.iterdir()] == ["world"], "closed files are deleted by the next run"


def test_results_of_a_drive_are_named_where_they_cant_be_linked(tmp_path: Path, exfat: None) -> None:
    (tmp_path / "steps" / "corridor").mkdir(parents=True)
    _link(tmp_path / "steps" / "corridor", tmp_path / "corridor")
    assert (tmp_path / "corridor.txt").read_text(encoding="utf-8") == "steps/corridor\n"


@pytest.mark.parametrize(
    ("options", "warned"),
    [
        ("nfs rw,vers=3,nolock,local_lock=all", True),
        ("nfs4 rw,vers=4.2,local_lock=none", False),
        ("lustre rw,localflock", True),
        ("cifs rw,nobrl", True),
        ("lustre rw,flock", False),
        ("ext4 rw", False),
    ],
)
def test_drives_whose_locks_hold_for_one_machine_only(options: str, warned: bool, tmp_path: Path) -> None:
    kind, _, options = options.partition(" ")
    (tmp_path / "mountinfo").write_text(f"22 1 0:1 / / rw - {kind} server:/ {options}\n", encoding="utf-8")
    text = warning_of_local_locks(Path("/data/town"), tmp_path / "mountinfo") or ""
    assert ("two runs on two machines" in text and "/data/town" in text) == warned


def test_busy_folder_names_the_run_that_uses_it(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(BusyError) as caught, locked(tmp_path):
        pass
    assert f"({platform.node()}, process {os.getpid()}, since 20" in caught.value.cause
    assert "delete" not in caught.value.remedy


def test_lock_of_a_lost_machine_can_be_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NFS keeps the locks of a machine until it starts again, which one of a cloud never does."""
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(platform, "node", lambda: "spot-7")
        holder = locked(tmp_path)
        holder.__enter__()
    with pytest.raises(BusyError) as caught, locked(tmp_path):
        pass
    assert "(spot-7, process" in caught.value.cause and f"delete {tmp_path / '.lock'}" in caught.value.remedy
    holder.__exit__(None, None, None)


@pytest.mark.parametrize(
    ("code", "error", "text"),
    [
        (errno.EWOULDBLOCK, BusyError, "another run is using this folder"),
        (errno.EACCES, BusyError, "another run is using this folder"),
        (errno.ENOLCK, UnavailableError, "can't be locked on this disk"),
        (errno.ENOSYS, UnavailableError, "can't be locked on this disk"),
    ],
)
def test_locks_of_network_drives(
    code: int, error: type[Exception], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fcntl, "flock", refuse(code))
    with pytest.raises(error, match=text), locked(tmp_path / "out"):
        pass
