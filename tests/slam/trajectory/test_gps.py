"""GPS tracks: smoothing, and the estimated noise."""

from __future__ import annotations

import re

import numpy as np
import pytest

from scan2sim.pipeline.core.types import GpsTrack
from scan2sim.slam.trajectory.gps import noise, smooth, video_clock


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


NOON = 1_700_000_000.0


@pytest.mark.parametrize(
    ("start", "length", "first", "said"),
    [
        (NOON + 2.5 * 3600, 4 * 3600, 2.5 * 3600, None),  # long after the logger was switched on
        (NOON - 20, 600, -20, None),  # before the first fix
        (NOON + 2 * 3600 + 30, 600, 30, r"\+2 h from UTC"),  # a camera that writes local time
        (NOON - 5e7, 600, 0, "isn't within the GPS track.*--gps-offset"),  # a camera whose clock was never set
        (NOON + 7 * 3600, 4 * 3600, 0, "isn't within the GPS track"),  # several time zones are possible
    ],
)
def test_video_clock_is_compared_with_the_track(start: float, length: float, first: float, said: str | None) -> None:
    warnings: list[str] = []
    times = NOON + np.arange(0.0, length, 10.0)
    track = GpsTrack(times, np.column_stack([times - NOON, np.zeros((len(times), 2))]))
    moved = video_clock(track, start, warnings.append)
    assert moved.times[0] == pytest.approx(-first, abs=1e-6)
    assert not warnings if said is None else re.search(said, warnings[0])
