"""GPS tracks: smoothing, and the estimated noise."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import GpsTrack
from scan2sim.slam.trajectory.gps import noise, smooth


def drive(error: float) -> tuple[GpsTrack, np.ndarray]:
    """Two minutes at 10 Hz with bends of 25 m radius, and the truth."""
    times = np.arange(0, 120, 0.1)
    heading = np.cumsum(np.where(np.sin(times / 8) > 0.6, 0.04, 0.0))
    truth = np.column_stack([np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), 0 * times])
    return GpsTrack(times, truth + np.random.default_rng(3).normal(0, error, truth.shape)), truth


def test_smoothing_removes_noise_and_outliers_and_keeps_corners() -> None:
    track, truth = drive(0.5)
    track.positions[[200, 500, 501, 900], 0] += 15
    off = np.linalg.norm((smooth(track).positions - truth)[:, :2], axis=1)
    assert off.mean() < 0.3 and off.max() < 1.2
    exact, truth = drive(0.0)
    assert np.abs(smooth(exact).positions - truth).max() < 0.35


def test_smoothing_does_not_reach_across_a_gap() -> None:
    track, _ = drive(0.0)
    positions = track.positions.copy()
    positions[600:] += 1000
    parts = GpsTrack(np.where(track.times < 60, track.times, track.times + 4), positions)
    assert np.abs(smooth(parts).positions - positions).max() < 0.4


@pytest.mark.parametrize("error", [0.2, 1.5])
def test_noise_is_estimated(error: float) -> None:
    assert noise(drive(error)[0]) == pytest.approx(error, rel=0.3)


def test_a_short_track_can_be_smoothed() -> None:
    two = GpsTrack(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [5, 0, 0]]))
    assert np.allclose(smooth(two).positions, two.positions, atol=1e-3)
    one = GpsTrack(np.zeros(1), np.ones((1, 3)))
    assert np.allclose(smooth(one).positions, 1) and np.allclose(one.at([0.0]), 1) and noise(one) == 0
