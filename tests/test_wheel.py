"""The wheel contains all packages, and works in folders with the user's own modules of the same names."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.test_architecture import PACKAGES

PYTHONS = ("3.11", "3.12", "3.13")
HOME = Path(pwd.getpwuid(os.getuid()).pw_dir)
"""The user's home directory, with Pythons of pyenv and settings of pip."""
COARSE_SETTINGS = ["--set", "unwrap.texel=0.1", "--set", "decimate.target=10000", "--set", "voxel.size=0.15"]


def run(*command: object, cwd: Path, code: int = 0, **env: str) -> str:
    """Run a command that must end with exit status `code`; returns its output, including standard error."""
    result = subprocess.run(
        [str(part) for part in command], cwd=cwd,
        env=os.environ | {"PYTHONPATH": "", "PYTHONSAFEPATH": "", "COLUMNS": "200"} | env,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert result.returncode == code, result.stdout
    return result.stdout


def tracked(*paths: str) -> set[str]:
    """Files of the repository that git knows, below these folders."""
    listed = run("git", "-c", "safe.directory=*", "ls-files", "-z", "--", *paths, cwd=ROOT).split("\0")
    return {name for name in listed if name and os.path.lexists(ROOT / name)}


def build(source: Path, kind: str, out: Path) -> Path:
    """Build the sdist or wheel of a source folder."""
    run(sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", out, cwd=source)
    return next(out.iterdir())


SAFE_EXTRACTION: dict[str, Any] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
"""Python 3.11.2 (Debian 12) has no extraction filters."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Wheel built from the sdist, as installers do without a wheel for their platform; without stray files."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in tracked():
        (folder / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / "checkout" / name, follow_symlinks=False)
    with tarfile.open(build(folder / "checkout", "sdist", folder / "sdist")) as sdist:
        sdist.extractall(folder / "source", **SAFE_EXTRACTION)
    return build(next((folder / "source").iterdir()), "wheel", folder / "wheel")


@dataclass(frozen=True)
class Installed:
    """A virtual environment with the wheel, and a user's working folder with modules named as ours and Python's."""

    environment: Path
    user: Path

    def scan2sim(self, *arguments: object, code: int = 0) -> str:
        """Run scan2sim in the user's folder."""
        return self.run(self.environment / "bin" / "scan2sim", *arguments, code=code)

    def run(self, *command: object, code: int = 0) -> str:
        """Run a command in the user's folder."""
        return run(*command, cwd=self.user, code=code, PYTHONPATH=str(self.user / "src"))


def create_user_folder(environment: Path, user: Path) -> Installed:
    """Create a user's folders and files, which raise an error if imported."""
    for package in PACKAGES:
        (user / "src" / package).mkdir(parents=True)
        (user / "src" / package / "__init__.py").write_text(
            "raise SystemExit('this folder is the user's own')", encoding="utf-8"
        )
    for module in ("random", "inspect", "numpy"):
        (user / f"{module}.py").write_text("raise SystemExit('this file is the user's own')", encoding="utf-8")
    return Installed(environment, user)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """Environment with the wheel; its dependencies are those of the tests' environment."""
    folder = tmp_path_factory.mktemp("installed")
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
    python = folder / "venv" / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    packages = next((folder / "venv" / "lib").iterdir()) / "site-packages"
    (packages / "rest.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    return create_user_folder(folder / "venv", folder / "user")


def test_the_wheel_contains_exactly_the_packages_and_pages(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(next(name for name in names if name.endswith("/METADATA"))).decode()
    inside = {name for name in names if not name.split("/")[0].endswith(".dist-info")}
    files = {f"scan2sim/{name}" for name in tracked(*PACKAGES)}
    pages = {f"scan2sim/{name}" for name in tracked("docs") if name.endswith(".md")}
    assert inside == files - {"scan2sim/data_samples/README.md"} | pages | {"scan2sim/__init__.py"}
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert "License-Expression: Apache-2.0 AND MIT\n" in metadata and "Author: scan2sim contributors\n" in metadata


def test_the_users_modules_are_not_imported(installed: Installed) -> None:
    assert installed.scan2sim("--version").startswith("scan2sim ")
    installed.scan2sim("sample", "--small", "tile")
    assert "not empty" in installed.scan2sim("sample", "--small", "tile", code=2)
    assert "EPSG:32633" in installed.scan2sim("inspect", "tile")
    assert "poisson.terrain" in installed.scan2sim("plan", "tile")
    call = "from scan2sim.pipeline.core import sandbox; print(sandbox.call('operator:add', 1, 2, timeout=60))"
    assert installed.run(installed.environment / "bin" / "python", "-P", "-c", call) == "3\n"
    printed = installed.scan2sim("plan", "tile", "--set", "voxel.size=-1", code=2)
    (page,) = re.findall(r"/\S+/docs/reference/settings.md", printed)  # hints contain the paths of installed pages
    assert "voxel.size" in Path(page).read_text(encoding="utf-8")
    (installed.user / "tile" / "cloud.laz").write_bytes(b"LASF")  # detected by the first step, in its own process
    printed = installed.scan2sim("run", "tile", "--out", "out", code=3)
    assert "cloud.laz" in printed and "the user's own" not in printed and "Traceback" not in printed


def interpreter(version: str) -> Path | None:
    """A Python of this version, from PATH or pyenv."""
    found = [shutil.which(f"python{version}"), *HOME.glob(f".pyenv/versions/{version}.*/bin/python")]
    for python in map(str, filter(None, found)):
        try:
            printed = run(python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])", cwd=ROOT)
        except (AssertionError, OSError):
            continue  # a pyenv shim of a version that isn't installed
        if printed.strip() == version:
            return Path(python)
    return None


@pytest.mark.slow
@pytest.mark.parametrize("version", PYTHONS)
def test_the_installed_wheel_builds_a_world(version: str, wheel: Path, tmp_path: Path) -> None:
    python = interpreter(version)
    if python is None:
        pytest.skip(f"Python {version} isn't installed")
    run(python, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
    pip = tmp_path / "venv" / "bin" / "pip"
    run(pip, "install", "-c", ROOT / "constraints.txt", f"{wheel}[flows]", cwd=tmp_path, HOME=str(HOME))
    installed = create_user_folder(tmp_path / "venv", tmp_path / "user")
    installed.scan2sim("sample", "--small", "tile")
    printed = installed.scan2sim("run", "tile", "--out", "out", "--set", "segment.overwrite=true", *COARSE_SETTINGS)
    assert "World:" in printed and (installed.user / "out" / "world" / "sample_street.sdf").is_file()
    printed = installed.scan2sim("survey", "tile", "--out", "town", "--runner", "dask", "--jobs", "2", *COARSE_SETTINGS)
    assert "Report:" in printed and (installed.user / "town" / "world").is_dir()
