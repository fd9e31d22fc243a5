"""Compiled kernels have a folder for users who can write neither the installation nor their home."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from numba import njit
from numba.core.caching import Cache

from scan2sim.pipeline.core import kernel_cache
from tests.conftest import ROOT


@pytest.fixture
def read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder below which nothing can be written; the temporary folder is beside it."""
    access = os.access
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(os, "access", lambda path, mode: "read only" not in str(path) and access(path, mode))
    (tmp_path / "read only").mkdir()
    return tmp_path / "read only"


def test_numbas_own_choices_come_first(read_only: Path, tmp_path: Path) -> None:
    for environment, code in (
        ({"HOME": str(read_only)}, tmp_path),
        ({"HOME": str(tmp_path)}, read_only),
        ({"HOME": str(read_only), "XDG_CACHE_HOME": str(tmp_path)}, read_only),
        ({"HOME": str(read_only), kernel_cache.VARIABLE: "chosen"}, read_only),
    ):
        before = dict(environment)
        kernel_cache.choose(environment, code)
        assert environment == before


@pytest.mark.parametrize("home", ["/dev/null", "/"])
def test_a_folder_of_ones_own_is_the_last_choice(
    home: str, read_only: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) != "/" and access(path, mode))
    environment = {"HOME": home}
    kernel_cache.choose(environment, read_only)
    folder = Path(environment[kernel_cache.VARIABLE])
    assert folder.parent == tmp_path and folder.stat().st_mode & 0o777 == 0o700
    again = {"HOME": home}
    kernel_cache.choose(again, read_only)
    assert again == environment, "kernels are compiled once"


def test_homes_of_others_and_users_without_a_home(
    read_only: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exists = Path.exists

    def refuse(path: Path) -> bool:
        if "root" in path.parts[:-1]:
            raise PermissionError(13, "Permission denied", str(path))
        return exists(path)

    def unknown(user: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {user}")

    monkeypatch.setattr(Path, "exists", refuse)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    monkeypatch.delenv("HOME")
    environments: list[dict[str, str]] = [{"HOME": "/root"}, {}]
    for environment in environments:
        kernel_cache.choose(environment, read_only)
        assert Path(environment[kernel_cache.VARIABLE]).parent == tmp_path


def test_folders_that_others_can_write_arent_used(read_only: Path, tmp_path: Path) -> None:
    """Whoever can write compiled kernels can run code as their user."""
    place = tmp_path / f"scan2sim-kernels-{os.getuid()}"
    place.symlink_to(read_only)
    environment = {"HOME": str(read_only)}
    kernel_cache.choose(environment, read_only)
    assert environment[kernel_cache.VARIABLE] != str(place)
    place.unlink()
    place.mkdir()
    place.chmod(0o777)
    environment = {"HOME": str(read_only)}
    kernel_cache.choose(environment, read_only)
    assert environment[kernel_cache.VARIABLE] != str(place)


def test_a_kernel_runs_if_the_disk_of_its_cache_is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(cache: object, signature: object, data: object) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    @njit(cache=True)
    def double(value: float) -> float:
        return 2 * value

    monkeypatch.setattr(Cache, "_save_overload", refuse)
    with pytest.raises(OSError, match="quota"):
        double(1)
    monkeypatch.setattr(Cache, "save_overload", Cache.save_overload)  # restored after the test
    kernel_cache.run_without_space()
    assert double(1.5) == 3


def test_a_kernel_runs_where_numba_can_write_nowhere(tmp_path: Path) -> None:
    program = """
import numba.core.caching as caching, os, sys
assert "scan2sim" not in sys.modules
def refuse(self):
    raise PermissionError(13, "read-only")
caching.InTreeCacheLocator.ensure_cache_path = refuse
access = os.access
os.access = lambda path, mode: "__pycache__" not in str(path) and access(path, mode)
import scan2sim
caching.config.reload_config()
from scan2sim.texturing.splats import descent
print(os.environ["NUMBA_CACHE_DIR"])
"""
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "HOME": "/dev/null", "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).parent == tmp_path
