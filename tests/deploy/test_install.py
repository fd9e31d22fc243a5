"""Installation by `make demo` when system packages are missing."""

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
    """Module deploy/install.py, which belongs to no package."""
    spec = importlib.util.spec_from_file_location("install", ROOT / "deploy" / "install.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def set_path(folder: Path, monkeypatch: pytest.MonkeyPatch, **scripts: str) -> None:
    """Set PATH to a folder that contains only these commands, each a shell script."""
    for name, body in scripts.items():
        (folder / name).write_text(f"#!/bin/sh\n{body}\n", encoding="utf-8")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))


def without_libusb(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system_libs, "loads", lambda name: name not in USB)


def test_a_missing_library_is_reported_with_its_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    without_libusb(monkeypatch)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    set_path(tmp_path, monkeypatch, **{"apt-get": ""})
    with pytest.raises(UnavailableError) as caught:
        system_libs.check()
    assert caught.value.where == "libusb-1.0.so.0"
    assert caught.value.remedy == "Run: sudo apt-get install --no-install-recommends libusb-1.0-0"
    (tmp_path / "apt-get").rename(tmp_path / "dnf")
    assert system_libs.command(USB) == "sudo dnf install 'libusb-1.0.so.0()(64bit)'"


def test_a_run_reports_a_missing_library_before_it_starts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_street: Path
) -> None:
    from scan2sim.flows.commands.run import run_tile
    from scan2sim.flows.pipelines.settings import Settings

    without_libusb(monkeypatch)
    with pytest.raises(UnavailableError, match=r"libusb-1\.0\.so\.0"):
        run_tile(ROOT / "data_samples" / "tile", tmp_path / "out", Settings())
    assert not any((tmp_path / "out" / "steps").glob("*/*"))


def test_without_permission_the_installing_command_is_printed(
    install: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    set_path(tmp_path, monkeypatch, **{"apt-get": f"touch {tmp_path}/called", "sudo": "exit 1"})
    with pytest.raises(SystemExit) as stopped:
        install.install_system_packages(USB)
    assert "sudo apt-get install --no-install-recommends libusb-1.0-0" in str(stopped.value)
    assert "Missing on this system: libusb-1.0.so.0 (package libusb-1.0-0)" in capsys.readouterr().out
    assert not (tmp_path / "called").exists()


@pytest.mark.parametrize("root", [True, False], ids=["root", "sudo without a password"])
def test_with_permission_missing_packages_are_installed(
    install: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    root: bool,
) -> None:
    requests = tmp_path / "requests"
    monkeypatch.setattr(os, "geteuid", lambda: 0 if root else 1000)
    monkeypatch.setattr(system_libs, "loads", lambda name: name not in USB or requests.exists())
    scripts = {"apt-get": f'echo "$@" >> {requests}', "env": 'shift; exec "$@"', "sudo": 'shift; "$@"'}
    set_path(tmp_path, monkeypatch, **scripts)
    install.install_system_packages(USB)
    assert "install --no-install-recommends libusb-1.0-0" in requests.read_text(encoding="utf-8")
    assert "Installing these packages with apt-get as root" in capfd.readouterr().out


def test_an_installation_without_effect_is_reported(
    install: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    without_libusb(monkeypatch)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    set_path(tmp_path, monkeypatch, **{"apt-get": "", "env": 'shift; exec "$@"'})
    with pytest.raises(SystemExit, match=r"still missing: libusb-1\.0\.so\.0"):
        install.install_system_packages(USB)


def test_an_unsupported_python_version_is_reported(install: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 9, 2))
    with pytest.raises(SystemExit, match=r"needs Python 3\.11, 3\.12 or 3\.13; .* is 3\.9\.2"):
        install.check_python()


def test_a_python_without_venv_is_reported(install: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert install.missing_packages()["Python's venv"] == f"python3.{sys.version_info[1]}-venv"


def test_a_missing_python_is_reported() -> None:
    done = subprocess.run(["make", "-B", "-n", "demo", "PYTHON="], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode and "No Python found" in done.stderr


def test_packages_txt_contains_the_packages_of_all_libraries() -> None:
    assert set((ROOT / "packages.txt").read_text(encoding="utf-8").split()) == set(system_libs.PACKAGE_OF.values())


def test_all_libraries_of_all_wheels_are_available() -> None:
    pytest.importorskip("elftools")
    from deploy.libraries import missing_libraries, needed_libraries

    count, wanted = needed_libraries(Path(sys.prefix))
    assert count > 50 and "libusb-1.0.so.0" in wanted
    assert missing_libraries(wanted) == {}


def test_a_library_that_only_this_machine_has_is_detected() -> None:
    from deploy.libraries import missing_libraries

    wanted = {"libusb-1.0.so.0": ["a.so"], "libc.so.6": ["a.so"], "libpython3.so": ["a.so"], "libcuda.so.1": ["b.so"]}
    assert missing_libraries(wanted) == {"libpython3.so": ["a.so"]}


def test_kernels_compiled_from_older_code_are_removed(
    install: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(install, "ROOT", tmp_path)
    cache = tmp_path / "pipeline" / "steps" / "__pycache__"
    cache.mkdir(parents=True)
    for name in ("voxel.thin-9.py311.nbi", "voxel.thin-9.py311.1.nbc", "voxel.cpython-311.pyc"):
        (cache / name).touch()
    install.remove_compiled_kernels()
    assert [path.name for path in cache.iterdir()] == ["voxel.cpython-311.pyc"]
