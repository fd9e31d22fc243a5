"""What `make demo` says and does where the system lacks something."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from scan2sim.pipeline.core import system_libs
from scan2sim.pipeline.core.errors import UnavailableError
from tests.conftest import ROOT

USB = {"libusb-1.0.so.0": "libusb-1.0-0"}


@pytest.fixture
def install() -> ModuleType:
    """deploy/install.py, which is no package's."""
    spec = importlib.util.spec_from_file_location("install", ROOT / "deploy" / "install.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def commands(folder: Path, monkeypatch: pytest.MonkeyPatch, **scripts: str) -> None:
    """A PATH that has these commands alone, each a shell script."""
    for name, body in scripts.items():
        (folder / name).write_text(f"#!/bin/sh\n{body}\n", encoding="utf-8")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))


def lacking_usb(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system_libs, "loads", lambda name: name not in USB)


def test_the_missing_library_and_its_package_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    lacking_usb(monkeypatch)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    commands(tmp_path, monkeypatch, **{"apt-get": ""})
    with pytest.raises(UnavailableError) as caught:
        system_libs.check()
    assert caught.value.where == "libusb-1.0.so.0"
    assert caught.value.remedy == "Run: sudo apt-get install --no-install-recommends libusb-1.0-0"
    (tmp_path / "apt-get").rename(tmp_path / "dnf")
    assert system_libs.command(USB) == "sudo dnf install 'libusb-1.0.so.0()(64bit)'"


def test_a_run_says_so_before_it_starts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_street: Path) -> None:
    from scan2sim.flows.commands.run import run_tile
    from scan2sim.flows.pipelines.settings import Settings

    lacking_usb(monkeypatch)
    with pytest.raises(UnavailableError, match=r"libusb-1\.0\.so\.0"):
        run_tile(ROOT / "data_samples" / "tile", tmp_path / "out", Settings())
    assert not any((tmp_path / "out" / "steps").glob("*/*"))


def test_what_may_not_be_installed_is_told_with_its_command(
    install: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    commands(tmp_path, monkeypatch, **{"apt-get": f"touch {tmp_path}/called", "sudo": "exit 1"})
    with pytest.raises(SystemExit) as stopped:
        install.install_system_packages(USB)
    assert "sudo apt-get install --no-install-recommends libusb-1.0-0" in str(stopped.value)
    assert "lacks libusb-1.0.so.0 (package libusb-1.0-0)" in capsys.readouterr().out
    assert not (tmp_path / "called").exists()


@pytest.mark.parametrize("root", [True, False], ids=["root", "sudo without a password"])
def test_what_may_be_installed_is_said_and_installed(
    install: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    root: bool,
) -> None:
    requests = tmp_path / "asked"
    monkeypatch.setattr(os, "geteuid", lambda: 0 if root else 1000)
    monkeypatch.setattr(system_libs, "loads", lambda name: name not in USB or requests.exists())
    scripts = {"apt-get": f'echo "$@" >> {requests}', "env": 'shift; exec "$@"', "sudo": 'shift; "$@"'}
    commands(tmp_path, monkeypatch, **scripts)
    install.install_system_packages(USB)
    assert "install --no-install-recommends libusb-1.0-0" in requests.read_text(encoding="utf-8")
    assert "Installing these packages now, by apt-get as root" in capfd.readouterr().out


def test_packages_that_do_not_help_are_told(
    install: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    lacking_usb(monkeypatch)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    commands(tmp_path, monkeypatch, **{"apt-get": "", "env": 'shift; exec "$@"'})
    with pytest.raises(SystemExit, match=r"didn't bring libusb-1\.0\.so\.0"):
        install.install_system_packages(USB)


def test_another_python_is_told(install: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 9, 2))
    with pytest.raises(SystemExit, match=r"needs Python 3\.11, 3\.12 or 3\.13; .* is 3\.9\.2"):
        install.check_python()


def test_a_python_without_venv_is_told(install: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert install.lacking()["Python's venv"] == f"python3.{sys.version_info[1]}-venv"


def test_no_python_at_all_is_told() -> None:
    done = subprocess.run(["make", "-B", "-n", "demo", "PYTHON="], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode and "There is no Python here" in done.stderr


def test_packages_txt_holds_the_packages_of_all_libraries() -> None:
    assert set((ROOT / "packages.txt").read_text(encoding="utf-8").split()) == set(system_libs.PACKAGE_OF.values())


def test_every_shared_object_of_every_wheel_finds_its_libraries() -> None:
    pytest.importorskip("elftools")
    from bench.packaging.libraries import needed, nowhere

    count, wanted = needed(Path(sys.prefix))
    assert count > 50 and "libusb-1.0.so.0" in wanted
    assert nowhere(wanted) == {}


def test_a_library_of_this_machine_alone_is_noticed() -> None:
    from bench.packaging.libraries import nowhere

    wanted = {"libusb-1.0.so.0": ["a.so"], "libc.so.6": ["a.so"], "libpython3.so": ["a.so"], "libcuda.so.1": ["b.so"]}
    assert nowhere(wanted) == {"libpython3.so": ["a.so"]}


def test_kernels_of_an_earlier_state_go(install: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install, "ROOT", tmp_path)
    cache = tmp_path / "pipeline" / "steps" / "__pycache__"
    cache.mkdir(parents=True)
    for name in ("voxel.thin-9.py311.nbi", "voxel.thin-9.py311.1.nbc", "voxel.cpython-311.pyc"):
        (cache / name).touch()
    install.drop_compiled()
    assert [path.name for path in cache.iterdir()] == ["voxel.cpython-311.pyc"]
