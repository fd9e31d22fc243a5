"""Covariances of trajectories."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.slam.global_map.covariance import covariances
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.mapping.marginalization import Information, MotionSigma
from tests.fakes.slam_drive import Follower, drive, inside, position_errors, run, scatter


def test_confidence_ellipsoids_contain_the_errors_and_are_not_degenerate() -> None:
    held = []
    for seed in range(4):
        times, poses = drive(12, turn=0.05 * (1 + seed))
        odometry = run(times, Follower(poses, scatter(poses, seed=seed), seed=seed))
        known = covariances(MapCheckpoint.of(odometry, ()), None)
        assert (np.linalg.eigvalsh(known) > 0).all()
        held.append(inside(position_errors(odometry, poses), known).mean())
    assert np.mean(held) > 0.85
    assert np.degrees(odometry.map.information.noise(0.0)) == pytest.approx(0.03, rel=0.1)


def test_poses_after_a_gap_stay_uncertain() -> None:
    times, poses = drive(20)
    black = (times >= 10) & (times < 12)
    hidden = Follower(poses, scatter(poses), hide=lambda frame, points: np.full(len(points), black[frame]))
    odometry = run(times, hidden)
    known = np.sqrt(np.trace(covariances(MapCheckpoint.of(odometry, ()), None)[:, :3, :3], axis1=1, axis2=2))
    assert known[-1] > 10 * known[np.flatnonzero(black)[0] - 1]
    assert all(p.unsure for p in odometry.placed[100:])  # no constraints across the gap


def test_band_inverse_equals_the_dense_inverse() -> None:
    rng, count = np.random.default_rng(0), 9
    known, whole = Information(4), np.zeros((6 * count, 6 * count))
    for first in range(count - 3):
        J = rng.normal(size=(30, 24))
        known.add(range(first, first + 4), np.arange(3) + 3 * first, J.T @ J, np.ones(50))
        at = slice(6 * first, 6 * first + 24)
        whole[at, at] += J.T @ J
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    far = MotionSigma(1e6, 1e6)
    found = known.covariance(poses, [MotionSigma(1.0, 1.0), *[far] * (count - 1)], [], np.full(count, np.inf), 1.0)
    whole = whole / known.noise(1.0) ** 2
    whole[:6, :6] += np.eye(6)
    blocks = np.linalg.inv(whole).reshape(count, 6, count, 6)
    assert np.allclose(found, [blocks[k, :, k] for k in range(count)], rtol=1e-3, atol=1e-6)
