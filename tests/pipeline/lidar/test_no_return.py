"""Surfaces without any return have reflectance 0 in the files of the world: a window in a scanned wall."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F32, F64, Bools, Frame, Mesh, PointCloud
from scan2sim.pipeline.io.worlds.textured_mesh import REFLECTANCE_FILE
from scan2sim.pipeline.lidar.no_return import SUPPORT_M
from scan2sim.pipeline.lidar.sweeps import Sweeps
from scan2sim.pipeline.lidar.unreturned import NO_RINGS
from scan2sim.pipeline.steps.reflectance import REFLECTANCE
from tests.fakes import synthetic
from tests.pipeline.lidar.test_unreturned import rays, sweep

WALL_X = 10.0
HALF_WIDTH_M, LOW_M, HIGH_M = 0.96, 1.91, 2.79
"""Edges of the window, 10 m in front of the scanner."""


def in_window() -> Bools:
    """Rays that hit the window: 5.5 degrees to both sides, and .5 degrees below to 4.5 above the horizon."""
    way = rays()
    azimuth, elevation = np.degrees(np.arctan2(way[:, 1], way[:, 0])), np.degrees(np.arcsin(way[:, 2]))
    return np.asarray((np.abs(azimuth) < 5.5) & (np.abs(elevation - 2) < 2.5))


def grid(u: F64, v: F64, wall: bool) -> Mesh:
    """Mesh with a vertex every few centimetres: a wall at `WALL_X` over y and z, or level ground over x and y."""
    a, b = (values.ravel() for values in np.meshgrid(u, v, indexing="ij"))
    xyz = np.stack([np.full(len(a), WALL_X), a, b] if wall else [a, b, np.zeros(len(a))], axis=1)
    index = np.arange(len(a)).reshape(len(u), len(v))
    p, q, r, s = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, s], axis=1)]).astype(np.int32)
    uv, page = np.zeros((len(faces), 3, 2), np.float32), np.zeros(len(faces), np.int16)
    return Mesh(Frame(), xyz.astype(np.float32), faces, uv=uv, page=page)


MESHES = {
    "terrain": grid(np.arange(-9, 9.05, 0.1), np.arange(-9, 9.05, 0.1), wall=False),
    "building": grid(np.arange(-4, 4.05, 0.1), np.arange(0, 3.55, 0.1), wall=True),
}


def run(tmp_path: Path, sweeps: Sweeps, others: F32) -> tuple[Done, dict[str, F32]]:
    """Run the step with the returns of one sweep and of `others`; also returns reflectances of vertices by surface."""
    xyz = np.concatenate([sweeps.xyz, others]).astype(np.float32)
    code = np.where(np.abs(xyz[:, 0] - WALL_X) < 0.01, CODE["building"], CODE["terrain"]).astype(np.uint8)
    intensity = np.random.default_rng(0).integers(100, 60_000, len(xyz)).astype(np.uint16)
    PointCloud(Frame(), xyz, classification=code, intensity=intensity).save(tmp_path / "cloud.npz")
    sweeps.save(tmp_path / "sweeps.npz")
    PointCloud(Frame(), np.zeros((0, 3), np.float32), time=np.zeros(0)).save(tmp_path / "moving.npz")
    files = {name: tmp_path / f"{name}.npz" for name in ("cloud", "sweeps", "moving")}
    textured = {f"textured.{name}": synthetic.textured(tmp_path / name, mesh) for name, mesh in MESHES.items()}
    out = tmp_path / "out"
    out.mkdir()
    done = REFLECTANCE.run(files | textured, REFLECTANCE.params(), out, silent)
    found = {name: np.load(done.files["reflectance"] / name / REFLECTANCE_FILE) for name in MESHES}
    return done, found


def test_reflectance_of_a_window_is_0(tmp_path: Path) -> None:
    sweeps, _ = sweep(lost=in_window())
    done, found = run(tmp_path, sweeps, np.zeros((0, 3), np.float32))
    _, y, z = MESHES["building"].vertices.T
    depth = np.minimum(HALF_WIDTH_M - np.abs(y), np.minimum(z - LOW_M, HIGH_M - z))  # distance from the window's edge
    assert (found["building"][depth > SUPPORT_M + 0.1] == 0).all() and (depth > SUPPORT_M + 0.1).sum() > 10
    assert (found["building"][depth < 0] > 0).all()
    assert (found["terrain"] > 0).all()  # also near the vehicle, and where rays are sparse
    assert done.metrics["no_return_m2"]["terrain"] == 0
    assert done.metrics["no_return_m2"]["building"] == pytest.approx(
        1.0, abs=0.2
    )  # 25 cm inside the gap in the returns


def test_window_with_returns_of_another_sweep_has_a_reflectance(tmp_path: Path) -> None:
    sweeps, _ = sweep(lost=in_window())
    y, z = np.meshgrid(np.arange(-1, 1, 0.2), np.arange(1.8, 2.9, 0.2))
    others = np.stack([np.full(y.size, WALL_X), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    done, found = run(tmp_path, sweeps, others)
    assert done.metrics["no_return_m2"] == {"terrain": 0, "building": 0} and (found["building"] > 0).all()


def test_reflectance_is_kept_without_rings(tmp_path: Path) -> None:
    sweeps, _ = sweep(lost=in_window())
    mixed = sweeps.take(np.random.default_rng(0).permutation(len(sweeps)))
    done, found = run(tmp_path, mixed, np.zeros((0, 3), np.float32))
    assert done.metrics["unmarked"] == NO_RINGS and "no_return_m2" not in done.metrics
    assert (found["building"] > 0).all() and (found["terrain"] > 0).all()
