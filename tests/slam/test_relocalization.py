"""Relocalization: the pose of a frame from two keyframes, against a known pose."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64, U8
from scan2sim.slam.geometry import exp_so3, inverse, rigid
from scan2sim.slam.odometry.relocalization import FrameFeatures, KeyframeFeatures, match_descriptors, relocalize

SIGMA = 1e-3
FIRST, SECOND = np.eye(4), rigid(np.eye(3), np.array([1.0, 0.2, 0.0]))


def features(T_world_cam: F64, points: F64, descriptors: U8, seed: int) -> FrameFeatures:
    """Features of points (N, 3) in shuffled order, with noise of their bearings and of a few descriptor bits."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(points))
    local = (points[order] - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    bearing = local / np.linalg.norm(local, axis=1)[:, None]
    noisy = Rotation.from_rotvec(rng.normal(0, SIGMA / 2, (len(points), 3))).apply(bearing)
    bits = np.unpackbits(descriptors[order], axis=1) ^ (rng.random((len(points), 256)) < 0.05)
    return FrameFeatures(noisy, np.packbits(bits.astype(np.uint8), axis=1))


def street(seed: int) -> tuple[F64, U8]:
    rng = np.random.default_rng(seed)
    return rng.uniform((-8, -3, 4), (8, 3, 20), (150, 3)), rng.integers(0, 256, (150, 32), dtype=np.uint8)


def test_pose_is_recovered_with_its_distance() -> None:
    points, descriptors = street(1)
    first = KeyframeFeatures(features(FIRST, points, descriptors, 2), FIRST)
    second = KeyframeFeatures(features(SECOND, points, descriptors, 3), SECOND)
    for centre, turn in (((0.3, 0.1, 1.5), 0.1), ((-2.0, 0.0, 3.0), 0.4), ((0.0, 0.0, 0.0), 0.2)):
        truth = rigid(exp_so3((0.0, turn, 0.05)), np.array(centre))
        now = features(truth, points, descriptors, 4)
        found = relocalize(now, first, second, sigma=SIGMA, rng=np.random.default_rng(0))
        assert found is not None
        wrong = inverse(truth) @ found
        assert np.linalg.norm(wrong[:3, 3]) < 0.02 and np.arccos(min(1.0, (np.trace(wrong[:3, :3]) - 1) / 2)) < 2e-3


def test_another_place_is_not_recognised() -> None:
    points, descriptors = street(1)
    first = KeyframeFeatures(features(FIRST, points, descriptors, 2), FIRST)
    second = KeyframeFeatures(features(SECOND, points, descriptors, 3), SECOND)
    elsewhere = features(FIRST, *street(5), 4)
    scrambled = features(FIRST, street(6)[0], descriptors, 4)  # looks alike, but has another geometry
    for now in (elsewhere, scrambled):
        assert relocalize(now, first, second, sigma=SIGMA, rng=np.random.default_rng(0)) is None


def test_ambiguous_descriptors_have_no_match() -> None:
    rng = np.random.default_rng(0)
    one = rng.integers(0, 256, (5, 32), dtype=np.uint8)
    assert match_descriptors(one, one[::-1].copy()).tolist() == [[i, 4 - i] for i in range(5)]
    twice = np.concatenate([one, one[:1]])  # the first has two equal candidates
    assert match_descriptors(one, twice)[:, 0].tolist() == [1, 2, 3, 4]
    assert match_descriptors(one[:1], one).shape == (0, 2)
