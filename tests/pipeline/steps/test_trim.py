"""Trim: removed and kept triangles, one by one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F32, Frame, Mesh, PointCloud
from scan2sim.pipeline.steps.trim import TrimParams, trim

CORNERS = np.array([[0, 0, 0], [0.15, 0, 0], [0, 0.15, 0]], np.float32)


def trimmed(
    folder: Path, triangles: list[F32], density: list[list[float]], points: F32
) -> tuple[list[int], dict[str, Any]]:
    """Indices of kept triangles, and metrics."""
    vertices = np.concatenate(triangles).astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    classification = np.arange(len(faces), dtype=np.uint8)
    Mesh(Frame(), vertices, faces, np.ravel(density).astype(np.float32), classification=classification).save(
        folder / "in.npz"
    )
    PointCloud(Frame(), points).save(folder / "points.npz")
    done = trim({"mesh": folder / "in.npz", "cloud": folder / "points.npz"}, TrimParams(), folder, silent)
    left = Mesh.load(done.files["mesh"]).classification
    assert left is not None
    return left.tolist(), done.metrics


def test_long_edges_sparse_samples_and_surface_far_from_points_are_removed(tmp_path: Path) -> None:
    x, y = np.mgrid[0:40, 0:6]
    points = np.stack([x.ravel() * 0.1, y.ravel() * 0.1, 0.0 * x.ravel()], axis=1).astype(np.float32)
    shift = np.array([3.5, 0, 0], np.float32)
    long = CORNERS * np.array([1.6, 1, 1], np.float32) + shift  # 24 cm and 15 cm, and 28 cm between their ends
    away = CORNERS + np.array([2, 0.7, 0], np.float32)  # 20 cm beyond the points, and one corner 35 cm
    dense, sparse = [10.0] * 3, [10.0, 10.0, 5.9]  # samples at one corner are 5 cm x 2^4.1 = 86 cm apart
    still = CORNERS + np.array([3, 0, 0], np.float32), [9.0, 8.0, 6.1]
    triangles = [CORNERS, CORNERS + np.array([1, 0, 0], np.float32), away, long, still[0]]
    left, metrics = trimmed(tmp_path, triangles, [dense, sparse, dense, dense, still[1]], points)
    assert left == [0, 4]
    assert [metrics[name] for name in ("long_edges", "sparse", "far_from_points", "widened")] == [1, 1, 1, 1.0]


def test_limits_near_uncovered_points_follow_their_spacing(tmp_path: Path) -> None:
    x, y = np.mgrid[0:80, 0:12]
    covered = np.stack([x.ravel() * 0.1, y.ravel() * 0.1, 0.0 * x.ravel()], axis=1).astype(np.float32)
    x, y = np.mgrid[0:20, 0:4]
    uncovered = np.stack([20 + x.ravel() * 0.3, y.ravel() * 0.3, 0.0 * x.ravel()], axis=1).astype(np.float32)
    big = CORNERS * 3.5  # edges of 53 and 74 cm
    vertices = np.concatenate([big, big + [21, 0, 0], big * 2 + [22, 0, 0]]).astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    Mesh(Frame(), vertices, faces, np.full(9, 10, np.float32)).save(tmp_path / "mesh.npz")
    PointCloud(Frame(), covered).save(tmp_path / "cloud.npz")
    PointCloud(Frame(), uncovered).save(tmp_path / "uncovered.npz")
    inputs = {name: tmp_path / f"{name}.npz" for name in ("mesh", "cloud", "uncovered")}
    done = trim(inputs, TrimParams(), tmp_path, silent)
    left = Mesh.load(done.files["mesh"])
    assert len(left) == 1 and 20 < left.vertices[:, 0].min() < left.vertices[:, 0].max() < 22
