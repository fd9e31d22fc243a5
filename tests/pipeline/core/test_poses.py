"""Interpolation of poses by the motion between neighbouring poses."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from scan2sim.pipeline.core.poses import interpolate, nearest_rotation
from scan2sim.pipeline.core.types import Camera, Trajectory

TIMES = np.array([0.0, 1.0, 1.0, 3.0])  # the second one twice
TURNS = Rotation.from_euler("xyz", [[0, 0, 0], [10, -20, 30], [10, -20, 30], [80, 15, -40]], degrees=True)


def sample_poses() -> np.ndarray:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = TURNS.as_matrix(), [[0, 0, 0], [1, 2, 0], [1, 2, 0], [5, 2, 4]]
    return poses


def test_interpolation_is_linear_in_position_and_spherical_in_rotation() -> None:
    at = np.array([0.0, 0.25, 1.0, 2.0, 2.9, 3.0])
    found = interpolate(sample_poses(), TIMES, at)
    assert np.allclose(found[:, :3, :3], Slerp([0, 1, 3], TURNS[[0, 1, 3]])(at).as_matrix())
    places = np.array([[0, 0, 0], [0.25, 0.5, 0], [1, 2, 0], [3, 2, 2], [4.8, 2, 3.8], [5, 2, 4]])
    assert np.allclose(found[:, :3, 3], places)


def test_motion_is_extrapolated_and_trajectory_clamped_at_its_ends() -> None:
    poses, path = sample_poses(), Trajectory(TIMES, sample_poses()[:, :3, 3], sample_poses()[:, :3, :3])
    assert np.allclose(interpolate(poses, TIMES, np.array([-1.0, 5.0]))[:, :3, 3], [[-1, -2, 0], [9, 2, 8]])
    assert np.allclose(path.pose_at([-1.0, 0.5, 5.0]), interpolate(poses, TIMES, np.array([0.0, 0.5, 3.0])))
    assert np.allclose(interpolate(poses[:1], TIMES[:1], np.array([7.0, 8.0])), poses[[0, 0]])


def test_rounded_rotations_are_orthonormalized() -> None:
    exact = TURNS.as_matrix()
    near = nearest_rotation(exact.round(4))
    assert np.abs(near - exact).max() < 1e-4
    assert np.abs(near @ near.transpose(0, 2, 1) - np.eye(3)).max() < 1e-14 and np.allclose(np.linalg.det(near), 1)
    assert np.array_equal(nearest_rotation(exact[3].round(4)), near[3])


def test_resized_cameras_keep_the_directions_of_the_image_corners() -> None:
    from scan2sim.pipeline.camera.models import unproject

    camera = Camera("pinhole", 640, 480, 500.0, 510.0, 300.0, 250.0)
    small = camera.resized(320, 120)
    corner, same = np.array([[-0.5, -0.5], [639.5, 479.5]]), np.array([[-0.5, -0.5], [319.5, 119.5]])
    assert np.allclose(unproject(camera, corner), unproject(small, same))
    assert camera.scaled(0.5) == camera.resized(320, 240)
