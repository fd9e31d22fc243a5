"""Smoothing of paths."""

import numpy as np

from scan2sim.pipeline.tracking import kalman


def test_smoothed_path_is_closer_than_the_measurements_and_within_its_uncertainty() -> None:
    rng = np.random.default_rng(0)
    times = np.arange(40, dtype=np.float64) / 10
    true = np.column_stack([8 * times, 0.4 * times**2])
    found = true + rng.normal(scale=0.3, size=true.shape)
    measured = [[kalman.Measurement(np.eye(4)[axis], xy[axis], 0.09) for axis in (0, 1)] for xy in found]
    first = kalman.State(np.array([*found[0], 0.0, 0.0]), np.diag([1.0, 1.0, 200.0, 200.0]))
    means, covariances = kalman.smooth(first, times, measured, 2.0)
    error = np.hypot(*(means[:, :2] - true).T)
    assert np.sqrt((error**2).mean()) < 0.6 * np.sqrt(((found - true) ** 2).sum(axis=1).mean())
    chi2 = [e @ np.linalg.solve(C[:2, :2], e) for e, C in zip(means[:, :2] - true, covariances, strict=True)]
    assert 0.5 < np.mean(chi2) < 4
    np.testing.assert_allclose(means[20, 2:4], [8, 0.8 * times[20]], atol=0.5)


def test_uncertainty_increases_in_gaps() -> None:
    times = np.arange(10, dtype=np.float64) / 10
    measured = [
        [kalman.Measurement(np.eye(4)[0], 5.0 * t, 0.01)] if not 3 <= k < 7 else [] for k, t in enumerate(times)
    ]
    means, covariances = kalman.smooth(kalman.State(np.zeros(4), np.eye(4) * 100.0), times, measured, 2.0)
    assert abs(means[5, 0] - 2.5) < 0.05
    assert covariances[5, 0, 0] > covariances[1, 0, 0]
