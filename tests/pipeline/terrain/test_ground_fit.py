"""Ground fitted to its points: closer to the true surface than the noisy mesh, and smooth without points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.terrain.ground_fit import fit_heights, heights_above_ground
from tests.fakes import synthetic

KERB = 0.12


def truth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A road with a kerb at x = 5."""
    return 0.02 * y + np.where(x > 5, KERB, 0.0)


@pytest.fixture(scope="module")
def bumpy() -> Mesh:
    """The road as a mesh with local errors of 3 cm."""
    flat = synthetic.ground(50)
    z = truth(*flat.vertices[:, :2].T) + np.random.default_rng(0).normal(0, 0.03, len(flat.vertices))
    return Mesh(flat.frame, np.column_stack([flat.vertices[:, :2], z]).astype(np.float32), flat.faces)


def points(n: int = 100_000, noise: float = 0.02) -> np.ndarray:
    random = np.random.default_rng(1)
    xy = random.uniform(-10, 10, (n, 2))
    return np.column_stack([xy, truth(*xy.T) + random.normal(0, noise, n)]).astype(np.float32)


def error(mesh: Mesh) -> np.ndarray:
    """Height error of vertices that are not at the kerb."""
    x, y, z = mesh.vertices[abs(mesh.vertices[:, 0] - 5) > 0.5].T
    return np.asarray(np.abs(z - truth(x, y)))


def test_fitted_ground_is_closer_to_the_truth_than_the_points(bumpy: Mesh) -> None:
    smooth = fit_heights(bumpy, points(), np.zeros(len(bumpy.vertices), bool))
    assert np.percentile(error(bumpy), 95) > 0.05 and np.percentile(error(smooth), 95) < 0.01
    assert np.array_equal(smooth.vertices[:, :2], bumpy.vertices[:, :2]) and smooth.faces is bumpy.faces


def test_kerb_keeps_its_height(bumpy: Mesh) -> None:
    smooth = fit_heights(bumpy, points(), np.zeros(len(bumpy.vertices), bool))
    x, y, z = smooth.vertices.T
    level = z - 0.02 * y
    assert level[(x > 5.3) & (x < 5.7)].mean() - level[(x > 4.3) & (x < 4.7)].mean() == pytest.approx(KERB, abs=0.005)


def test_ground_fit_is_robust_to_outliers(bumpy: Mesh) -> None:
    many = points()
    many[::20, 2] += 0.1
    smooth = fit_heights(bumpy, many, np.zeros(len(bumpy.vertices), bool))
    assert np.percentile(error(smooth), 95) < 0.012


def test_border_vertices_are_fixed(bumpy: Mesh) -> None:
    fixed = bumpy.vertices[:, 0] < -9.9
    smooth = fit_heights(bumpy, points(), fixed)
    assert np.array_equal(smooth.vertices[fixed], bumpy.vertices[fixed])
    assert not np.array_equal(smooth.vertices[~fixed], bumpy.vertices[~fixed])


def test_ground_without_points_is_smoother(bumpy: Mesh) -> None:
    seen = points()
    hole = np.linalg.norm(seen[:, :2] + 4, axis=1) > 2
    smooth = fit_heights(bumpy, seen[hole], np.zeros(len(bumpy.vertices), bool))
    inside = np.linalg.norm(bumpy.vertices[:, :2] + 4, axis=1) < 1.5
    off = [m.vertices[inside, 2] - truth(*m.vertices[inside, :2].T) for m in (bumpy, smooth)]
    assert np.std(off[1]) < np.std(off[0]) / 2


def test_mesh_without_points_is_unchanged(bumpy: Mesh) -> None:
    fixed = np.zeros(len(bumpy.vertices), bool)
    assert fit_heights(bumpy, np.zeros((0, 3), np.float32), fixed) is bumpy
    assert fit_heights(bumpy, points(100) + np.float32(50), fixed).vertices.shape == bumpy.vertices.shape
    assert fit_heights(bumpy, points(100), ~fixed) is bumpy


def test_height_above_a_slope_is_measured_vertically() -> None:
    slope = synthetic.ground(4)
    vertices = slope.vertices.copy()
    vertices[:, 2] = vertices[:, 0] * 0.5
    xy = np.array([[-3.3, 2.1], [7.7, -8.2], [30, 0]])
    above = np.column_stack([xy, xy[:, 0] * 0.5 + 0.1]).astype(np.float32)
    face, shares, height = heights_above_ground(replace(slope, vertices=vertices, uv=None, page=None), above)
    assert len(face) == 2 and height == pytest.approx(0.1, abs=1e-5) and shares.sum(axis=1) == pytest.approx(1)
