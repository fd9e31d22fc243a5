"""Gazebo's own readers and physics as a test's judge (`check_world.cpp`)."""

from __future__ import annotations

import fcntl
import functools
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent
BUILD = HERE / "build"


class Refused(Exception):
    """Gazebo's readers find fault with a world; the text says which."""


@functools.cache
def program() -> Path:
    """The checker, built once; the test is skipped where what it needs is not installed."""
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed (tests/gazebo/packages.txt)")
    BUILD.mkdir(exist_ok=True)
    with open(BUILD / "lock", "w") as lock:  # tests may run in several processes
        fcntl.flock(lock, fcntl.LOCK_EX)
        made = _run("cmake", "-S", HERE, "-B", BUILD, "-DCMAKE_BUILD_TYPE=Release")
        if made.returncode:
            pytest.skip(f"Gazebo's libraries are not installed (tests/gazebo/packages.txt): {made.stderr[:300]}")
        built = _run("cmake", "--build", BUILD)
        assert built.returncode == 0, built.stdout[-3000:] + built.stderr[-3000:]
    return BUILD / "check_world"


def check_world(world: Path, drop_at: tuple[float, float, float]) -> dict[str, Any]:
    """What Gazebo reads of an exported world, and where a box (40 cm, 10 kg) dropped in it comes to rest.

    Triangles of every mesh file must be as many as `metadata.json` beside the world says.

    Returns:
        `world`; `spherical` (latitude, longitude, elevation, heading, `at_y_100`: latitude and
        longitude 100 m along y) or None; `meshes` (file, role, triangles, textures, low, high);
        `rest` (x, y, z) of the box's centre, world coordinates; `speed` m/s at the end.

    Raises:
        Refused: with the first problem.
    """
    expected = json.loads((world.parent / "metadata.json").read_text())["triangles_by_file"]
    files = [f"{file}={count}" for file, count in expected.items() if file.startswith("models/")]
    done = _run(program(), world, *drop_at, *files)
    if done.returncode:
        raise Refused(done.stderr.strip() or f"exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def _run(*command: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=300)
