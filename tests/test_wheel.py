"""The wheel: what `pip install scan2sim` puts on a machine, and that it works beside a user's own folders and files."""

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

import pytest

from tests.conftest import ROOT
from tests.test_architecture import ROOMS

PYTHONS = ("3.11", "3.12", "3.13")
HOME = Path(pwd.getpwuid(os.getuid()).pw_dir)
"""The user's home: where pyenv keeps Pythons, and pip its settings."""
LIGHT = ["--set", "unwrap.texel=0.1", "--set", "decimate.target=10000", "--set", "voxel.size=0.15"]


def done(*command: object, cwd: Path, code: int = 0, **env: str) -> str:
    """What a command prints, its errors included; it ends with `code`."""
    result = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=os.environ | {"PYTHONPATH": "", "COLUMNS": "200"} | env,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert result.returncode == code, result.stdout
    return result.stdout


def build(source: Path, kind: str, out: Path) -> Path:
    """The sdist or wheel of a source folder."""
    done(sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", out, cwd=source)
    return next(out.iterdir())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the sdist, as installers do that find no wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    with tarfile.open(build(ROOT, "sdist", folder / "sdist")) as sdist:
        sdist.extractall(folder / "source", filter="data")
    return build(next((folder / "source").iterdir()), "wheel", folder / "wheel")


@dataclass(frozen=True)
class Installed:
    """A virtual environment with the wheel, and a user's folder to be in: names in it are ours, and Python's."""

    environment: Path
    user: Path

    def scan2sim(self, *arguments: object, code: int = 0) -> str:
        """Run the command there."""
        return self.run(self.environment / "bin" / "scan2sim", *arguments, code=code)

    def run(self, *command: object, code: int = 0) -> str:
        """Run any command there."""
        return done(*command, cwd=self.user, code=code, PYTHONPATH=str(self.user / "src"))


def place(environment: Path, user: Path) -> Installed:
    """A user's folders and files beside an environment."""
    for room in ROOMS:
        (user / "src" / room).mkdir(parents=True)
        (user / "src" / room / "__init__.py").write_text(
            "raise SystemExit('this folder is the user's own')", encoding="utf-8"
        )
    for module in ("random", "inspect", "numpy"):
        (user / f"{module}.py").write_text("raise SystemExit('this file is the user's own')", encoding="utf-8")
    return Installed(environment, user)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel alone; what it depends on is the tests' own."""
    folder = tmp_path_factory.mktemp("installed")
    done(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
    python = folder / "venv" / "bin" / "python"
    done(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    packages = next((folder / "venv" / "lib").iterdir()) / "site-packages"
    (packages / "rest.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    return place(folder / "venv", folder / "user")


def test_it_holds_the_rooms_whole_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(next(name for name in names if name.endswith("/METADATA"))).decode()
    inside = {name for name in names if not name.split("/")[0].endswith(".dist-info")}
    rooms = {
        f"scan2sim/{path.relative_to(ROOT).as_posix()}"
        for room in ROOMS
        for path in (ROOT / room).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    pages = {f"scan2sim/docs/{path.relative_to(ROOT / 'docs').as_posix()}" for path in (ROOT / "docs").rglob("*.md")}
    assert inside == rooms - {"scan2sim/data_samples/README.md"} | pages | {"scan2sim/__init__.py"}
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert "License-Expression: Apache-2.0 AND MIT\n" in metadata and "Author: scan2sim contributors\n" in metadata


def test_a_users_folders_and_files_are_not_taken_for_ours(installed: Installed) -> None:
    assert installed.scan2sim("--version").startswith("scan2sim ")
    installed.scan2sim("sample", "--small", "tile")
    assert "not empty" in installed.scan2sim("sample", "--small", "tile", code=2)
    assert "EPSG:32633" in installed.scan2sim("inspect", "tile")
    assert "poisson.terrain" in installed.scan2sim("plan", "tile")
    call = "from scan2sim.pipeline.core import sandbox; print(sandbox.call('operator:add', 1, 2, timeout=60))"
    assert installed.run(installed.environment / "bin" / "python", "-P", "-c", call) == "3\n"
    printed = installed.scan2sim("plan", "tile", "--set", "voxel.size=-1", code=2)
    (page,) = re.findall(r"/\S+/docs/reference/settings.md", printed)  # hints name pages where they are
    assert "voxel.size" in Path(page).read_text(encoding="utf-8")
    (installed.user / "tile" / "cloud.laz").write_bytes(b"LASF")  # found out by the first step, in its own process
    printed = installed.scan2sim("run", "tile", "--out", "out", code=3)
    assert "cloud.laz" in printed and "the user's own" not in printed and "Traceback" not in printed


def interpreter(version: str) -> Path | None:
    """A Python of that version on this machine, on the path or among pyenv's."""
    found = [shutil.which(f"python{version}"), *HOME.glob(f".pyenv/versions/{version}.*/bin/python")]
    for python in map(str, filter(None, found)):
        try:
            printed = done(python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])", cwd=ROOT)
        except (AssertionError, OSError):
            continue  # a shim of pyenv's, of a version that isn't there
        if printed.strip() == version:
            return Path(python)
    return None


@pytest.mark.slow
@pytest.mark.parametrize("version", PYTHONS)
def test_a_world_is_made_from_the_wheel_alone(version: str, wheel: Path, tmp_path: Path) -> None:
    python = interpreter(version)
    if python is None:
        pytest.skip(f"there is no Python {version} on this machine")
    done(python, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
    pip = tmp_path / "venv" / "bin" / "pip"
    done(pip, "install", "-c", ROOT / "constraints.txt", f"{wheel}[flows]", cwd=tmp_path, HOME=str(HOME))
    here = place(tmp_path / "venv", tmp_path / "user")
    here.scan2sim("sample", "--small", "tile")
    printed = here.scan2sim("run", "tile", "--out", "out", "--set", "segment.overwrite=true", *LIGHT)
    assert "World:" in printed and (here.user / "out" / "world" / "sample_street.sdf").is_file()
    printed = here.scan2sim("survey", "tile", "--out", "town", "--runner", "dask", "--jobs", "2", *LIGHT)
    assert "Report:" in printed and (here.user / "town" / "world").is_dir()
