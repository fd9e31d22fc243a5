"""Camera pose of the first image of the report."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.pipeline.steps.pictures import whole_pose


@pytest.mark.parametrize("size", [(100, 20, 8), (30, 200, 40), (50, 50, 1)])
def test_all_points_fill_the_image(size: tuple[float, float, float]) -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (5000, 3)) * size + (300.0, -40.0, 12.0)
    camera = pinhole(1280, 720, field=75)
    pose = whole_pose(points, camera)
    T = np.linalg.inv(pose)
    uv, valid = project(camera, points @ T[:3, :3].T + T[:3, 3])
    low, high = uv.min(axis=0), uv.max(axis=0)
    assert valid.all() and (low > -1.5).all() and (high < [1280.5, 720.5]).all()
    assert (high - low)[0] > 1270 or (high - low)[1] > 710
    assert pose[2, 2] < -0.3 and pose[2, 3] > points[:, 2].max()  # looks down from above
