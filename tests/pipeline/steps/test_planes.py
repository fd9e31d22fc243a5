"""Step `planes`: corners and ends of walls rounded by Poisson become straight, round surfaces are unchanged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.step import Done, Step, silent
from scan2sim.pipeline.core.types import F64, Frame, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.planes import PLANES
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.voxel import VOXEL
from tests.fakes.steps import step_params

NOISE = 0.01
PATH = Trajectory(np.array([0.0, 1.0]), np.array([[-8.0, -8.0, 2.0], [-7.0, -9.0, 2.0]]))


def go(step: Step, folder: Path, inputs: dict[str, Path], **given: Any) -> Done:
    out = folder / step.name
    out.mkdir(exist_ok=True)
    return step.run(inputs, step_params(step.params, **given), out, silent)


def run_step(
    xyz: F64, folder: Path, *, others: F64 | None = None, noise: float = NOISE, **given: Any
) -> tuple[Mesh, Mesh, dict[str, Any]]:
    """Meshes of points before and after the step, and its metrics."""
    noisy = (xyz + np.random.default_rng(1).normal(0, noise, xyz.shape)).astype(np.float32)
    points, path, other = (folder / f"{name}.npz" for name in ("points", "path", "other"))
    PointCloud(Frame(), noisy).save(points)
    PATH.save(path)
    PointCloud(Frame(), (np.zeros((0, 3)) if others is None else others).astype(np.float32)).save(other)
    cloud = go(VOXEL, folder, {"cloud": points, "path": path}).files["cloud"]
    rough = go(POISSON, folder, {"cloud": cloud}).files["mesh"]
    mesh = go(TRIM, folder, {"mesh": rough, "cloud": cloud}).files["mesh"]
    done = go(PLANES, folder, {"mesh": mesh, "cloud": cloud, "points": points, "other.terrain": other}, **given)
    pieces = go(ISLANDS, folder, {"mesh": done.files["mesh"]}).files["mesh"]
    return Mesh.load(mesh), Mesh.load(pieces), done.metrics


def wall(start: tuple[float, float], end: tuple[float, float], height: float = 3.0, density: int = 900) -> F64:
    """Points of an upright wall."""
    random = np.random.default_rng(0)
    a, b = np.array(start), np.array(end)
    u = random.uniform(0, 1, (int(density * height * np.linalg.norm(b - a)), 1))
    return np.column_stack([a + u * (b - a), random.uniform(0, height, len(u))])


def extents(mesh: Mesh, way: tuple[float, float, float], low: float, high: float) -> F64:
    """Maximum coordinate of the mesh along a direction, for each 10 cm of height between two heights."""
    far = mesh.vertices @ np.array(way)
    level = np.floor(mesh.vertices[:, 2] / 0.1).astype(int)
    return np.array([far[level == k].max() for k in range(int(low / 0.1), int(high / 0.1))])


def test_corner_of_two_walls_is_sharp(tmp_path: Path) -> None:
    before, after, metrics = run_step(np.concatenate([wall((0, 0), (0, 4)), wall((0, 0), (4, 0))]), tmp_path)
    corner = np.array([-1.0, -1.0, 0.0]) / np.sqrt(2)  # the true corner is at 0
    assert metrics["planes"] == 2
    assert np.median(extents(before, tuple(corner), 0.5, 2.5)) < -0.02
    assert np.abs(extents(after, tuple(corner), 0.5, 2.5)).max() < 0.01


def test_wall_ends_with_its_points_and_extends_into_the_ground(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(-1, 5, 0.1), np.arange(-2, 2, 0.1))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    before, after, _ = run_step(wall((0, 0), (4, 0)), tmp_path, others=ground)
    assert np.median(extents(before, (1, 0, 0), 0.5, 2.5)) > 4.1  # after `trim`
    assert np.abs(extents(after, (1, 0, 0), 0.5, 2.5) - 4).max() < 0.02
    assert np.abs(extents(after, (-1, 0, 0), 0.5, 2.5)).max() < 0.02
    assert after.vertices[:, 2].min() < -0.05
    assert np.quantile(np.abs(after.vertices[:, 1]), 0.99) < 0.005


def test_wall_with_noise_and_boards_is_flat(tmp_path: Path) -> None:
    """As scanned by a lidar on a car: 3 cm of noise, boards of 30 cm, alternately 3 cm in front and behind."""
    boards = wall((0, 0), (5, 0), density=400)
    boards[:, 1] += np.where(boards[:, 0] % 0.6 < 0.3, 0.015, -0.015)
    before, after, metrics = run_step(boards, tmp_path, noise=0.03)

    def tilted(mesh: Mesh) -> float:
        """Share of the wall's area whose normal deviates from the wall's by more than 20 degrees."""
        middle = mesh.vertices[mesh.faces].mean(axis=1)
        inside = (np.abs(middle[:, 0] - 2.5) < 2.0) & (np.abs(middle[:, 2] - 1.5) < 1.0)
        away = np.abs(mesh.face_normal[:, 1]) < np.cos(np.radians(20))
        return float(mesh.face_area[inside & away].sum() / mesh.face_area[inside].sum())

    assert metrics["planes"] == 1
    assert tilted(before) > 0.1 and tilted(after) < 0.01


def test_tile_borders_are_not_moved(tmp_path: Path) -> None:
    """Planes of neighbouring tiles differ, but their meshes agree at the border."""
    corner = np.concatenate([wall((0, 0), (0, 4)), wall((0, 0), (4, 0))])
    before, after, _ = run_step(corner, tmp_path, seed=(-1.0, 1.0), neighbours={"east": (5.0, 1.0)})
    was, now = (mesh.vertices[np.abs(mesh.vertices[:, 0] - 2) < 0.25] for mesh in (before, after))
    assert len(was) == len(now) > 100
    assert cKDTree(now).query(was)[0].max() < 0.003  # noise for decimation
    inner = np.abs(after.vertices[:, 0] - 1) < 0.3
    assert np.quantile(np.abs(after.vertices[inner, 1]), 0.99) < 0.005


def test_window_gets_reveals(tmp_path: Path) -> None:
    front = wall((0, 0), (4, 0))
    hole = (front[:, 0] > 1.5) & (front[:, 0] < 2.7) & (front[:, 2] > 0.8) & (front[:, 2] < 2.2)
    pane = front[hole] + [0, 0.15, 0]
    _, after, metrics = run_step(np.concatenate([front[~hole], pane]), tmp_path)
    middle = (np.abs(after.vertices[:, 2] - 1.5) < 0.4) & (np.abs(after.vertices[:, 0] - 2.1) < 0.8)
    between = after.vertices[middle & (after.vertices[:, 1] > 0.01) & (after.vertices[:, 1] < 0.14)]
    assert metrics["steps"] >= 4
    assert np.quantile(np.minimum(np.abs(between[:, 0] - 1.5), np.abs(between[:, 0] - 2.7)), 0.75) < 0.03


@pytest.mark.parametrize("offset", np.arange(0, 0.1, 0.02))
def test_round_surfaces_are_unchanged(offset: float, tmp_path: Path) -> None:
    """Wherever they stand in the grid."""
    random = np.random.default_rng(0)
    angle, z = random.uniform(0, 2 * np.pi, 12_000), random.uniform(0, 3, 12_000)
    before, after, metrics = run_step(np.column_stack([0.6 * np.cos(angle) + offset, 0.6 * np.sin(angle), z]), tmp_path)
    assert metrics["planes"] == 0
    assert np.array_equal(before.vertices, after.vertices) and np.array_equal(before.faces, after.faces)
