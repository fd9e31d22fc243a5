"""Jacobians of relative poses equal central differences."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.geometry.least_squares import moved
from scan2sim.slam.geometry import exp_so3, lever_arm_jacobian, relative_pose_error


def test_relative_pose_jacobian_is_that_of_central_differences() -> None:
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = exp_so3(rng.normal(size=(3, 3))), 10 * rng.normal(size=(3, 3))
    mount, first, second = poses[0], poses[1:2], poses[2:3]
    measured = np.linalg.inv(first @ mount) @ second @ mount

    def error(step: F64) -> F64:
        return relative_pose_error(
            moved(first, step[None, :6]) @ mount, moved(second, step[None, 6:]) @ mount, measured
        )[0]

    numeric = np.stack([(error(h) - error(-h))[0] / 2e-6 for h in 1e-6 * np.eye(12)], axis=1)
    _, J = relative_pose_error(first @ mount, second @ mount, measured)
    arms = [(pose @ mount)[:, :3, 3] - pose[:, :3, 3] for pose in (first, second)]
    found = np.concatenate([J[0, k] @ lever_arm_jacobian(arm)[0] for k, arm in enumerate(arms)], axis=1)
    np.testing.assert_allclose(found, numeric, atol=1e-7)
