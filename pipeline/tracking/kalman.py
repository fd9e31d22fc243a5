"""Kalman filter of constant velocity in plan, and the Rauch-Tung-Striebel smoother (1965) with the size of the box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64

FIRST_SPEED_MPS = 15.0
"""Standard deviation of the velocity of an object that was seen once."""
SIZE_NOISE_M = 1e-3
"""Process noise of the size: it is constant, but matrices must be regular."""


class State(NamedTuple):
    """Mean (N,) and covariance (N, N) of x, y (m), their velocities (m/s), and further constants."""

    mean: F64
    covariance: F64


class Measurement(NamedTuple):
    """A measured scalar: its derivative by the state (N,), its value and its variance."""

    by_state: F64
    value: float
    variance: float


def start(position: F64, noise: F64) -> State:
    """State (4) after one measurement of the position (2,) with covariance (2, 2)."""
    covariance = np.eye(4) * FIRST_SPEED_MPS**2
    covariance[:2, :2] = noise
    return State(np.concatenate([position, [0.0, 0.0]]), covariance)


def predict(state: State, seconds: float, acceleration: float) -> State:
    """State after `seconds`, under random accelerations of standard deviation `acceleration` (m/s2)."""
    F = _transition(seconds, len(state.mean))
    noise = _process_noise(seconds, acceleration, len(state.mean))
    return State(F @ state.mean, F @ state.covariance @ F.T + noise)


def update(state: State, position: F64, noise: F64) -> State:
    """State after a measurement of the position (2,) with covariance (2, 2)."""
    gain = state.covariance[:, :2] @ np.linalg.inv(state.covariance[:2, :2] + noise)
    covariance = state.covariance - gain @ state.covariance[:2]
    return State(state.mean + gain @ (position - state.mean[:2]), (covariance + covariance.T) / 2)


def updated(state: State, measured: Measurement) -> State:
    """State after the measurement of a scalar."""
    towards = state.covariance @ measured.by_state
    gain = towards / (measured.by_state @ towards + measured.variance)
    covariance = state.covariance - np.outer(gain, towards)
    mean = state.mean + gain * (measured.value - measured.by_state @ state.mean)
    return State(mean, (covariance + covariance.T) / 2)


def smooth(first: State, times: F64, measured: Sequence[Sequence[Measurement]], acceleration: float) -> State:
    """States given all measurements, those after them, too.

    Args:
        first: state before the first measurement.
        times: (T,) seconds, ascending.
        measured: measurements at each time.
        acceleration: m/s2, standard deviation of random accelerations.

    Returns:
        Means (T, N) and covariances (T, N, N).
    """
    state, filtered, predicted = first, [], [first]
    for k in range(len(times)):
        if k:
            state = predict(state, float(times[k] - times[k - 1]), acceleration)
            predicted.append(state)
        for one in measured[k]:
            state = updated(state, one)
        filtered.append(state)
    means, covariances = (np.array([getattr(state, name) for state in filtered]) for name in State._fields)
    for k in range(len(times) - 2, -1, -1):
        F = _transition(float(times[k + 1] - times[k]), len(first.mean))
        gain = np.linalg.solve(predicted[k + 1].covariance, F @ covariances[k]).T
        means[k] += gain @ (means[k + 1] - predicted[k + 1].mean)
        covariances[k] += gain @ (covariances[k + 1] - predicted[k + 1].covariance) @ gain.T
    return State(means, covariances)


def _transition(seconds: float, count: int) -> F64:
    F = np.eye(count)
    F[0, 2] = F[1, 3] = seconds
    return F


def _process_noise(seconds: float, acceleration: float, count: int) -> F64:
    """(N, N) covariance of white acceleration that is constant between two measurements."""
    G = np.vstack([np.eye(2) * seconds**2 / 2, np.eye(2) * seconds])
    noise = 1e-9 * np.eye(count)
    noise[:4, :4] += acceleration**2 * G @ G.T
    noise[4:, 4:] += SIZE_NOISE_M**2 * np.eye(count - 4)
    return noise
