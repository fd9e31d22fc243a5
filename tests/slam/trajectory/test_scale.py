"""Rescaling to GPS, weighted by the drift of the camera and the noise of the receiver."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.data_samples.gps import receiver
from scan2sim.pipeline.core.types import GpsTrack, Trajectory
from scan2sim.slam.trajectory import scale
from scan2sim.slam.trajectory.gps import smooth
from tests.fakes.slam_drive import ate, drifting_turn


@pytest.mark.parametrize("seed", range(3))
def test_gps_with_10_cm_noise_halves_the_error_of_a_turn(seed: int) -> None:
    times, truth, found = drifting_turn()
    gps = smooth(GpsTrack(times, truth + np.random.default_rng(seed).normal(0, 0.1, truth.shape)))
    factor = scale.factors(times, found, np.zeros(51, bool), gps, scale.DRIFT_PERSPECTIVE)
    assert ate(scale.apply(found, factor), truth) < 0.5 * ate(found, truth)


def test_consumer_gps_noise_does_not_degrade_360_scale() -> None:
    times = np.arange(0, 60, 0.1)
    heading = 0.5 * np.sin(times / 9)
    truth = np.cumsum(np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1), axis=0)
    moments, fixes = receiver(Trajectory(times, truth), seed=1)
    factor = scale.factors(times, truth, np.zeros(len(times), bool), smooth(GpsTrack(moments, fixes)))
    assert np.abs(factor - 1).max() < 0.008
