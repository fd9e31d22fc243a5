"""Trajectory errors agree with those of `evo` (GPL: only used in tests)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import Trajectory
from scan2sim.slam.trajectory.evaluate import Evaluation, evaluate

pytest.importorskip("evo")

from evo.core.metrics import APE, RPE, PathPair, PoseRelation, StatisticsType, Unit
from evo.core.trajectory import PosePath3D

BETWEEN = 0.77
"""Metres from pose to pose: the first more than 10 m away (KITTI's choice, and ours) is the nearest to it (evo's)."""


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    """300 m with bends and a slope."""
    s = BETWEEN * np.arange(390)
    heading = 1.2 * np.sin(s / 60)
    step = BETWEEN * np.stack([np.cos(heading), np.sin(heading), 0 * s], axis=1)
    places = np.concatenate([np.zeros((1, 3)), np.cumsum(step[:-1], axis=0)])
    return Trajectory(s / 10, places, Rotation.from_euler("ZY", np.stack([heading, 0.02 * s**0.5], 1)).as_matrix())


@pytest.fixture(scope="module")
def estimate(truth: Trajectory) -> Trajectory:
    """The same path with scale drift, noise in all six degrees of freedom, moved, and 7 % too small."""
    rng, n = np.random.default_rng(0), len(truth)
    drift = np.cumsum(rng.normal(0, 0.01, (n, 3)), axis=0) + rng.normal(0, 0.02, (n, 3))
    turn = Rotation.from_euler("xyz", [0.02, -0.03, 0.9])
    places = 0.93 * turn.apply(truth.positions + drift) + [40.0, -7.0, 3.0]
    turned = turn * Rotation.from_matrix(truth.rotations) * Rotation.from_rotvec(rng.normal(0, 0.004, (n, 3)))
    return replace(truth, positions=places, rotations=turned.as_matrix())


def paths(truth: Trajectory, estimate: Trajectory, *, scaled: bool) -> PathPair:
    """Both as evo trajectories, the estimate aligned with the truth."""
    reference, found = (PosePath3D(poses_se3=list(t.poses)) for t in (truth, estimate))
    found.align(reference, correct_scale=scaled)
    return reference, found


def ape(pair: PathPair) -> float:
    metric = APE(PoseRelation.translation_part)
    metric.process_data(pair)
    return float(metric.get_statistic(StatisticsType.rmse))


def rpe(pair: PathPair, delta: float, unit: Unit) -> tuple[float, float]:
    """RMS translation error in metres, mean rotation error in degrees per metre of the true path, for all pairs."""
    found = []
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
        metric = RPE(relation, delta, unit, rel_delta_tol=0.05, all_pairs=True, pairs_from_reference=True)
        metric.process_data(pair)
        found.append(metric)
    way = (1 if unit == Unit.frames else 13) * BETWEEN
    rms, mean = (m.get_statistic(s) for m, s in zip(found, (StatisticsType.rmse, StatisticsType.mean), strict=True))
    return float(rms), float(mean) / way


@pytest.mark.parametrize("scaled", [True, False], ids=["similarity", "rigid"])
def test_ate_and_rpe_equal_those_of_evo(truth: Trajectory, estimate: Trajectory, scaled: bool) -> None:
    found: Evaluation = evaluate(estimate, truth, alignment="similarity3d" if scaled else "rigid2d")
    pair = paths(truth, estimate, scaled=scaled)
    assert (found.ate_similarity if scaled else found.ate_rigid) == pytest.approx(ape(pair), rel=1e-9)
    assert found.rpe is not None and found.rpe_frame is not None
    for ours, theirs in (
        (found.rpe_frame, rpe(pair, 1, Unit.frames)),
        (found.rpe, rpe(pair, 10.0, Unit.meters)),
    ):
        assert ours.translation == pytest.approx(theirs[0], rel=1e-9)
        assert ours.rotation_deg_per_m == pytest.approx(theirs[1], rel=1e-3)  # distance < path length
    assert ape(pair) > 0.1
