"""Check worlds with Gazebo's own libraries: `check_world`, `drive_world`, `cast_rays` and `load_meshes` (.cpp)."""

from __future__ import annotations

import fcntl
import functools
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64

HERE = Path(__file__).resolve().parent
BUILD = HERE / "build"
Body = tuple[str, tuple[float, float, float]]


class WorldRejected(Exception):
    """Gazebo's libraries reject a world; the message says why."""


@functools.cache
def build() -> str:
    """Build the programs once; returns the reason if that isn't possible, otherwise an empty string."""
    if shutil.which("cmake") is None:
        return "cmake is not installed (tests/gazebo/packages.txt)"
    BUILD.mkdir(exist_ok=True)
    with open(BUILD / "lock", "w", encoding="utf-8") as lock:  # tests may run in parallel processes
        fcntl.flock(lock, fcntl.LOCK_EX)
        configured = _run("cmake", "-S", HERE, "-B", BUILD, "-DCMAKE_BUILD_TYPE=Release")
        if configured.returncode:
            return f"Gazebo's libraries are not installed (tests/gazebo/packages.txt): {configured.stderr[:300]}"
        built = _run("cmake", "--build", BUILD)
        assert built.returncode == 0, built.stdout[-3000:] + built.stderr[-3000:]
    return ""


def program(name: str) -> Path:
    """Path of one of the programs; skips the test if they can't be built."""
    if reason := build():
        pytest.skip(reason)
    return BUILD / name


def check_world(world: Path, *bodies: Body) -> dict[str, Any]:
    """Load an exported world as Gazebo does, and drop bodies in it.

    Triangle counts of all mesh files must agree with `metadata.json` beside the world.

    Args:
        world: SDF file.
        bodies: bodies dropped at the same time, and their initial positions, world coordinates: "box" (40 cm), "ball"
            (22 cm), "car" (a box of 4.2 x 1.8 x 1.4 m).

    Returns:
        `world`: name; `spherical`: None or latitude, longitude, elevation, heading, and `at_y_100`, the latitude and
        longitude 100 m along y; `meshes`: file, role, triangles, textures, low, high; `solids`: number of collision
        shapes; `bodies`: final position of the centre `rest` (x, y, z), world coordinates, orientation `lies`
        (quaternion w, x, y, z) and `speed` in m/s.

    Raises:
        WorldRejected: with the first problem.
    """
    expected = json.loads((world.parent / "metadata.json").read_text(encoding="utf-8"))["triangles_by_file"]
    files = [f"{file}={count}" for file, count in expected.items() if file.startswith("models/")]
    dropped = [f"{kind}@{x:.4f},{y:.4f},{z:.4f}" for kind, (x, y, z) in bodies]
    done = _run(program("check_world"), world, *dropped, *files)
    if done.returncode:
        raise WorldRejected(done.stderr.strip() or f"exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def load_meshes(*files: Path) -> dict[str, float]:
    """CPU time (`seconds`) and peak memory (`megabytes`) to load meshes by ignition-common.

    Raises:
        WorldRejected: a mesh can't be loaded.
    """
    done = _run(program("load_meshes"), *files)
    if done.returncode:
        raise WorldRejected(done.stderr.strip() or f"exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def cast_rays(world: Path, origins: F64, directions: F64) -> tuple[F64, F64]:
    """Ranges (N,) of rays through the visuals of a world, inf without a hit, and `laser_retro` of what they hit.

    Args:
        world: SDF file.
        origins: (N, 3) world coordinates, metres.
        directions: (N, 3) unit vectors.

    Raises:
        WorldRejected: a visual can't be loaded.
    """
    rays = "\n".join(" ".join(f"{value:.9g}" for value in ray) for ray in np.hstack([origins, directions]).tolist())
    command = [str(program("cast_rays")), str(world)]
    done = subprocess.run(command, input=rays, capture_output=True, text=True, timeout=900)
    if done.returncode:
        raise WorldRejected(done.stderr.strip() or f"exit code {done.returncode}")
    hits = [line.split() for line in done.stdout.splitlines()]
    ranges = np.array([float(hit[0]) if len(hit) > 1 else np.inf for hit in hits])
    return ranges, np.array([float(hit[-1]) if len(hit) > 1 else 0.0 for hit in hits])


class SimulatedRobot:
    """Exported robot in Gazebo's physics with commanded wheel velocities (`drive_world.cpp`); a context manager.

    Args:
        world: SDF file.
        name: model name of the robot.
        joints: names of the left and the right wheel joint.

    Attributes:
        pose: current `rest` and `lies`, as in `check_world`.
    """

    def __init__(self, world: Path, name: str, joints: tuple[str, str]) -> None:
        command = [str(part) for part in (program("drive_world"), world, name, *joints)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        self.pose = self._read_pose()

    def __enter__(self) -> SimulatedRobot:
        return self

    def __exit__(self, *raised: object) -> None:
        self._process.kill()
        self._process.communicate()

    def turn(self, left: float, right: float, seconds: float) -> None:
        """Turn the wheels at these velocities (radians per second) for some time, and update `pose`.

        Raises:
            WorldRejected: the simulation ended with an error.
        """
        assert self._process.stdin is not None
        self._process.stdin.write(f"{left:.9g} {right:.9g} {seconds:.9g}\n")
        self._process.stdin.flush()
        self.pose = self._read_pose()

    def _read_pose(self) -> dict[str, Any]:
        assert self._process.stdout is not None and self._process.stderr is not None
        line = self._process.stdout.readline()
        if not line:
            raise WorldRejected(self._process.stderr.read().strip() or "the simulation ended unexpectedly")
        return dict(json.loads(line))


def _run(*command: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=900)
