"""Points that moved hide what a photo shows there, also where the network doesn't recognize a vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2sim.pipeline.camera.projection import pixels
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.texturing.splats.moving import MovingMask
from tests.texturing.splats.test_training import BETWEEN, photo

TIME_S = 100.0
FRAME = Frame(origin=(0.0, 0.0, 0.0))


def board(time: float) -> PointCloud:
    """A board of 0.6 x 0.6 m, one metre before the camera, scanned at a time."""
    y, z = np.meshgrid(np.arange(-0.1, 0.5, 0.05), np.arange(0.9, 1.5, 0.05))
    xyz = np.column_stack([np.full(y.size, -3.5), y.ravel(), z.ravel()]).astype(np.float32)
    normal = np.tile(np.array([-1, 0, 0], np.float32), (len(xyz), 1))
    return PointCloud(FRAME, xyz, normal=normal, time=np.full(len(xyz), time))


def test_points_that_moved_are_masked_with_a_margin() -> None:
    one = photo(BETWEEN)
    one = replace(one, view=replace(one.view, time=TIME_S))
    mask = MovingMask(None, FRAME, True, board(TIME_S)).of(one)
    uv, _ = pixels(one.camera, one.view.T_world_cam, board(TIME_S).xyz)
    column, row = np.rint(uv).astype(int).T
    assert mask[row, column].all()
    assert (column.max() - column.min()) * (row.max() - row.min()) < mask.sum() < 0.5 * mask.size


def test_points_of_another_moment_and_photos_without_a_time_are_not_masked() -> None:
    one = photo(BETWEEN)
    assert not MovingMask(None, FRAME, True, board(TIME_S)).of(one).any()
    later = replace(one, view=replace(one.view, time=TIME_S + 2))
    assert not MovingMask(None, FRAME, True, board(TIME_S)).of(later).any()


def test_points_behind_the_surface_are_not_masked() -> None:
    one = photo(BETWEEN)
    one = replace(one, view=replace(one.view, time=TIME_S))
    hidden = board(TIME_S)
    hidden = replace(hidden, xyz=hidden.xyz + np.array([0, 0, -3], np.float32))  # below the ground
    assert not MovingMask(None, FRAME, True, hidden).of(one).any()
