"""Priors of exposures and poses, in the units of their settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import Camera, View
from scan2sim.texturing.exposure import HUBER_RESIDUAL, ExposureParams
from scan2sim.texturing.exposure import _prior as exposure_prior
from scan2sim.texturing.photo_cache import SRGB_GAMMA, Exposures
from scan2sim.texturing.pose_refinement.bundle_adjustment import Corrections, Priors, _prior


def test_exposure_prior_weighs_its_share_of_the_observations(tmp_path: Path) -> None:
    view = View("a", Camera("pinhole", 8, 6, 5, 5, 3.5, 2.5), np.eye(4), tmp_path / "a.png")
    params = ExposureParams(own_exposure=0.1, tint=0.2)
    _, precision = exposure_prior([view], np.array([0]), np.array([5000]), [], Exposures(), params)
    assert np.ones(3) @ precision @ np.ones(3) == pytest.approx(0.1 * 3 * 5000, rel=1e-3)
    covariance = np.linalg.inv(precision) * HUBER_RESIDUAL**2 / (np.log(2) / SRGB_GAMMA) ** 2  # in stops
    bluish = np.array([1, 0, -1]) / np.sqrt(2)
    assert np.sqrt(bluish @ covariance @ bluish) == pytest.approx(0.2)
    assert np.ones(3) @ covariance @ bluish == pytest.approx(0, abs=1e-9)


def test_pose_prior_correlation_decays_with_distance() -> None:
    priors = Priors(0.1, 0.01, camera_shift=0.3, camera_turn=0.02, correlation_length=5.0, lens=np.full(5, 0.04))
    centres = np.column_stack([[0.0, 12.0, 3.0, 4.0], np.zeros(4), np.zeros(4)])
    order = np.array([0, 2, 3, 1])
    covariance = np.linalg.inv(_prior(centres, order, 1, priors).toarray())
    sigma = [*([0.01] * 3 + [0.1] * 3) * 4, *[0.02] * 3, *[0.3] * 3, *[0.04] * 5]
    assert np.allclose(np.sqrt(np.diag(covariance)), sigma)
    correlation = covariance[3::6, 3::6][:4, :4] / 0.1**2  # of the shifts along x
    distance = np.abs(centres[:, None, 0] - centres[None, :, 0])
    assert np.allclose(correlation, np.exp(-distance / 5.0))


def test_camera_correction_is_in_camera_axes() -> None:
    pose, turned = np.eye(4), Rotation.from_euler("xyz", [20, -30, 50], degrees=True)
    pose[:3, :3], pose[:3, 3] = turned.as_matrix(), [3, 4, 5]
    correction = np.array([[0.02, -0.01, 0.03, 0.1, 0.2, -0.3]])
    mounted = np.eye(4)
    mounted[:3, :3], mounted[:3, 3] = Rotation.from_rotvec(correction[0, :3]).as_matrix(), correction[0, 3:]
    found = Corrections(np.zeros((1, 6)), correction, np.zeros((1, 5))).apply(pose[None], np.array([0]))
    assert np.allclose(found[0], pose @ mounted)
