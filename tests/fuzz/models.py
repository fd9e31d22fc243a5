"""Valid inputs of importers (photos, COLMAP models, KITTI drives, sweeps) and of inspection (results, worlds)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeAlias

import numpy as np

from scan2sim.flows.commands.inspect import inspect_path
from scan2sim.flows.pipelines.kitti import import_kitti_odometry, import_kitti_raw
from scan2sim.pipeline.core.types import Camera, View
from scan2sim.pipeline.importers.photogrammetry import import_model
from scan2sim.pipeline.importers.sweeps import PhotoInput, PlacementParams, import_sweeps
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.sweep_files import read_bin, read_sweep
from scan2sim.pipeline.steps.views import _problem
from scan2sim.slam.video import open_video
from tests.fakes import synthetic
from tests.fakes.photo_files import write
from tests.pipeline.importers import test_sweeps as sweeps
from tests.pipeline.importers.test_colmap import make_model
from tests.pipeline.importers.test_kitti_odometry import make_sequence
from tests.pipeline.importers.test_kitti_raw import make_drive
from tests.pipeline.importers.test_photogrammetry import WRITERS, images

Make: TypeAlias = Callable[[Path], list[Path]]
Read: TypeAlias = Callable[[Path], object]


def photo(suffix: str) -> tuple[Make, Read]:
    """Photo file: writer and reader."""
    rgb = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)

    def make(folder: Path) -> list[Path]:
        write(folder / f"p{suffix}", rgb, "half" if suffix == ".exr" else "uint8", tile=16 * (suffix == ".tif"))
        return [folder / f"p{suffix}"]

    def read(folder: Path) -> None:
        path = folder / f"p{suffix}"
        _problem(View("p", Camera("pinhole", 64, 48, 50, 50, 31, 23), np.eye(4), path))
        image.read_rgb(path)

    return make, read


def colmap(form: str) -> tuple[Make, Read]:
    """COLMAP model: writer and reader (import)."""

    def make(folder: Path) -> list[Path]:
        make_model(folder, ["SIMPLE_RADIAL", "OPENCV", "PINHOLE"])
        return sorted((folder / form).iterdir())

    def read(folder: Path) -> object:
        out = folder / "tile"
        return import_model("colmap", folder / form, folder / "images", out, overwrite=out.exists())

    return make, read


def model(kind: str) -> tuple[Make, Read]:
    """Model of another photogrammetry program: writer and reader (import)."""

    def make(folder: Path) -> list[Path]:
        WRITERS[kind](folder)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        np.savetxt(folder / "dense.xyz", np.random.default_rng(0).uniform(0, 9, (50, 3)), "%.3f")
        return files

    def read(folder: Path) -> object:
        path = next(p for p in sorted(folder.rglob("*")) if p.suffix in (".json", ".xml", ".out", ".nvm"))
        out = folder / "tile"
        return import_model(kind, path, images(), out, cloud=folder / "dense.xyz", overwrite=out.exists())

    return make, read


def kitti(folder: Path) -> list[Path]:
    """Write a drive of KITTI raw: calibration, time stamps, OXTS, sweeps."""
    make_drive(folder)
    return sorted(path for path in folder.rglob("*") if path.suffix in (".txt", ".bin"))


def read_kitti(folder: Path) -> object:
    """Import the drive as a tile."""
    out = folder / "tile"
    return import_kitti_raw(folder / "2011_09_26", out, overwrite=out.exists())


def odometry(folder: Path) -> list[Path]:
    """Write a sequence of KITTI odometry."""
    make_sequence(folder)
    return sorted(path for path in folder.rglob("*") if path.suffix in (".txt", ".bin"))


def read_odometry(folder: Path) -> object:
    """Import the sequence as a tile."""
    out = folder / "tile"
    return import_kitti_odometry(folder / "sequences" / "31", out, overwrite=out.exists())


def drive(folder: Path) -> list[Path]:
    """Write sweeps, poses, photos and extrinsics."""
    sweeps.make(folder, sweeps=3, columns=150)
    return sorted(path for path in folder.rglob("*") if path.is_file())


def read_drive(folder: Path) -> object:
    """Import the sweeps and photos as a tile."""
    out = folder / "tile"
    photos = [PhotoInput(folder / "photos", sweeps.CAMERA)]
    return import_sweeps(
        folder / "sweeps", folder / "camera.csv", out, PlacementParams(), extrinsics=sweeps.T_CAMERA_SCANNER,
        photos=photos, overwrite=out.exists(),
    )  # fmt: skip


def sweep(suffix: str) -> tuple[Make, Read]:
    """Single sweep: writer and reader."""
    write = sweeps.to_bin if suffix == ".bin" else sweeps.to_open3d(suffix)

    def make(folder: Path) -> list[Path]:
        write(folder / "000000", sweeps.sweep(0.1, turning=False))
        return [folder / f"000000{suffix}"]

    def read(folder: Path) -> object:
        path = folder / f"000000{suffix}"
        return read_sweep(path), read_bin(path) if suffix == ".bin" else None

    return make, read


def result(folder: Path) -> list[Path]:
    """Write a cached result."""
    np.savez(folder / "r.npz", a=np.arange(1000), b=np.zeros((3, 4)), c=np.array(["x", "y"]))
    return [folder / "r.npz"]


SECOND = ("building.", "collision_terrain.")
"""Meshes of which another one has the same format: they are written, but not read."""


def world(folder: Path) -> list[Path]:
    """Write a world with its model, and a GLB."""
    synthetic.world(folder)
    kinds = (".sdf", ".obj", ".dae", ".glb", ".json")
    return sorted(p for p in folder.rglob("*") if p.suffix in kinds and not p.name.startswith(SECOND))


def read_world(folder: Path) -> None:
    """Inspect all files that `world` returns; meshes that are unchanged since the last inspection only once."""
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".sdf":
            inspect_path(path)
        elif path.suffix in (".obj", ".dae", ".glb") and not path.name.startswith(SECOND):
            _inspect_mesh(path, hashlib.sha256(path.read_bytes()).digest())


@cache
def _inspect_mesh(path: Path, digest: bytes) -> None:
    """Inspect a mesh with this content: takes a second, and only one file of a world is damaged at a time."""
    inspect_path(path)


def read_video(folder: Path) -> object:
    """Decode all frames."""
    return [frame.time for frame in open_video(folder / "g.mp4").frames()]
