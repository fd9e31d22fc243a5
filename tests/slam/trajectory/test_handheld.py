"""Evaluation of paths within a room: the length is that of the path, not of strides of a drive."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.slam.trajectory.evaluate import evaluate, segment_errors, stride_of


def handheld(radius: float, turns: float = 6.0) -> F64:
    """(N, 3) positions of a camera carried along a Lissajous figure, metres."""
    t = np.linspace(0, 2 * np.pi * turns, 3000)
    return np.column_stack([radius * np.sin(t), 0.7 * radius * np.sin(2 * t), 0.1 * radius * np.cos(t)])


@pytest.mark.parametrize("radius", [0.1, 0.4, 1.5, 5.0])
def test_length_and_drift_of_a_handheld_path(radius: float) -> None:
    truth = handheld(radius) + np.random.default_rng(1).normal(0, radius / 2000, (3000, 3))
    length = float(np.linalg.norm(np.diff(handheld(radius)[:, :2], axis=0), axis=1).sum())
    times = np.arange(len(truth)) / 100
    error = 0.01 * radius * np.column_stack([np.sin(times), np.cos(times), 0 * times])
    found = evaluate(Trajectory(times, truth + error), Trajectory(times, truth))
    assert found.length == pytest.approx(length, rel=0.02) and found.coverage == pytest.approx(1)
    assert found.drift_percent == pytest.approx(100 * found.global_mean / length, rel=0.02)


def test_strides_of_drives_are_a_metre() -> None:
    assert stride_of(handheld(30.0)[:, :2]) == 1.0


def test_short_segments_have_errors() -> None:
    path = handheld(0.4)[:, :2]
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    _, errors = segment_errors(path, path, distance, segment=0.5, step=0.05)
    assert len(errors) > 50 and errors.max() < 1e-9
