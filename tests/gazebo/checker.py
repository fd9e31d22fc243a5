"""Gazebo's own readers and physics as a test's judge (`check_world.cpp`, `drive_world.cpp`)."""

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
Body = tuple[str, tuple[float, float, float]]


class Refused(Exception):
    """Gazebo's readers find fault with a world; the text says which."""


@functools.cache
def built() -> str:
    """Build the programs once; returns why they can't be, or an empty text."""
    if shutil.which("cmake") is None:
        return "cmake is not installed (tests/gazebo/packages.txt)"
    BUILD.mkdir(exist_ok=True)
    with open(BUILD / "lock", "w", encoding="utf-8") as lock:  # tests may run in several processes
        fcntl.flock(lock, fcntl.LOCK_EX)
        made = _run("cmake", "-S", HERE, "-B", BUILD, "-DCMAKE_BUILD_TYPE=Release")
        if made.returncode:
            return f"Gazebo's libraries are not installed (tests/gazebo/packages.txt): {made.stderr[:300]}"
        done = _run("cmake", "--build", BUILD)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return ""


def program(name: str) -> Path:
    """One of the programs; the test is skipped where what it needs is not installed."""
    if why := built():
        pytest.skip(why)
    return BUILD / name


def check_world(world: Path, *bodies: Body) -> dict[str, Any]:
    """What Gazebo reads of an exported world, and where bodies that are dropped in it come to rest.

    Triangles of every mesh file must be as many as `metadata.json` beside the world says.

    Args:
        world: its .sdf.
        bodies: what is dropped, all at once, and from where, world coordinates: a "box" (40 cm), a "ball" (22 cm), a
            "car" (a box of 4.2 x 1.8 x 1.4 m).

    Returns:
        `world`; `spherical` (latitude, longitude, elevation, heading, `at_y_100`: latitude and
        longitude 100 m along y) or None; `meshes` (file, role, triangles, textures, low, high); `solids`: how many
        shapes can be collided with; `bodies`: `rest` (x, y, z) of each one's centre, world coordinates, `lies`, the
        quaternion (w, x, y, z) of its attitude, and `speed` m/s at the end.

    Raises:
        Refused: with the first problem.
    """
    expected = json.loads((world.parent / "metadata.json").read_text(encoding="utf-8"))["triangles_by_file"]
    files = [f"{file}={count}" for file, count in expected.items() if file.startswith("models/")]
    dropped = [f"{kind}@{x:.4f},{y:.4f},{z:.4f}" for kind, (x, y, z) in bodies]
    done = _run(program("check_world"), world, *dropped, *files)
    if done.returncode:
        raise Refused(done.stderr.strip() or f"exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def load_meshes(*files: Path) -> dict[str, float]:
    """`seconds` of the processor and `megabytes` at most that ignition-common takes to load meshes.

    Raises:
        Refused: one can't be loaded.
    """
    done = _run(program("load_meshes"), *files)
    if done.returncode:
        raise Refused(done.stderr.strip() or f"exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


class Driven:
    """The exported robot in Gazebo's physics, its wheels turned as told (`drive_world.cpp`); a context.

    Args:
        world: its .sdf.
        name: of the robot's model.
        joints: its left and its right one.
    """

    def __init__(self, world: Path, name: str, joints: tuple[str, str]) -> None:
        command = [str(part) for part in (program("drive_world"), world, name, *joints)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        self.place = self._told()

    def __enter__(self) -> Driven:
        return self

    def __exit__(self, *raised: object) -> None:
        self._process.kill()
        self._process.communicate()

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Have the wheels turn so fast, radians a second; then `place` tells `rest` and `lies`, as `check_world` does.

        Raises:
            Refused: the physics gave up.
        """
        assert self._process.stdin is not None
        self._process.stdin.write(f"{left:.9g} {right:.9g} {seconds:.9g}\n")
        self._process.stdin.flush()
        self.place = self._told()

    def _told(self) -> dict[str, Any]:
        assert self._process.stdout is not None and self._process.stderr is not None
        line = self._process.stdout.readline()
        if not line:
            raise Refused(self._process.stderr.read().strip() or "it ended")
        return dict(json.loads(line))


def _run(*command: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=900)
