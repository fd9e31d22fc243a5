"""Votes of photos for points against a reference implementation: weights and bilinear interpolation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.types import Camera, Frame, PointCloud, View
from scan2sim.segmentation.labels import CLASSES, SKY
from scan2sim.segmentation.votes import HALF_WEIGHT_DISTANCE_M, vote

CAMERAS = {
    "pinhole": Camera("pinhole", 320, 240, 200.0, 210.0, 150.0, 130.0),
    "equirectangular": Camera("equirectangular", 400, 200),
}


def interpolated(labels: np.ndarray, camera: Camera, uv: np.ndarray) -> np.ndarray:
    """(N, C) bilinear interpolation of labels (h, w, C); panoramas wrap around."""
    rows, columns = labels.shape[:2]
    x, y = ((uv + 0.5) * [columns / camera.width, rows / camera.height] - 0.5).T
    out = np.zeros((len(uv), labels.shape[2]))
    for i, (s, t) in enumerate(zip(x, y, strict=True)):
        for column in (int(np.floor(s)), int(np.floor(s)) + 1):
            for row in (int(np.floor(t)), int(np.floor(t)) + 1):
                at = column % columns if camera.model == "equirectangular" else np.clip(column, 0, columns - 1)
                share = (1 - abs(s - column)) * (1 - abs(t - row))
                out[i] += share * labels[np.clip(row, 0, rows - 1), at] / 255.0
    return out


@pytest.mark.parametrize("name", CAMERAS)
def test_votes_are_weighted_and_interpolated(name: str, tmp_path: Path) -> None:
    camera, rng = CAMERAS[name], np.random.default_rng(2)
    pose = look_at((-4.0, 1.0, 2.0), (3.0, 0.0, 1.0))
    y, z = (part.ravel() for part in np.mgrid[-4:4:0.5, 0:3:0.5])
    wall = np.stack([3 + 0.6 * y, y, z], axis=1)  # with increasingly oblique incidence
    normal = np.tile([-1.0, 0.6, 0] / np.hypot(1, 0.6), (len(wall), 1))
    cloud = PointCloud(Frame(), wall.astype(np.float32), normal=normal.astype(np.float32))
    labels = rng.integers(0, 256, (30, 40, len(CLASSES)), dtype=np.uint8)
    labels[..., SKY] //= 3
    np.save(tmp_path / "0.npy", labels)
    found = vote(cloud, [View("a", camera, pose, tmp_path / "a.png")], tmp_path, radius=0.08)

    local = (wall - pose[:3, 3]) @ pose[:3, :3]
    uv, ok = project(camera, local)
    seen = ok & (
        (camera.model == "equirectangular") | ((uv >= 0) & (uv <= [camera.width - 1, camera.height - 1])).all(1)
    )
    assert seen.sum() > 30 and ((found.weight > 0) == seen).all() and found.sky_share == 0
    far = np.linalg.norm(local, axis=1)
    cos = np.abs(np.einsum("ij,ij->i", wall - pose[:3, 3], normal)) / far
    weight = (0.2 + 0.8 * cos) / (1 + (far / HALF_WEIGHT_DISTANCE_M) ** 2)
    probabilities = interpolated(labels, camera, uv)
    expected = np.where(np.arange(len(CLASSES)) == SKY, 0, weight[:, None] * probabilities)
    assert np.allclose(found.score[seen], expected[seen], atol=1e-3)
    assert np.allclose(found.weight[seen], (weight * (1 - probabilities[:, SKY]))[seen], atol=1e-3)
