"""Trajectory errors compared with analytic cases and KITTI's devkit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, GpsTrack, Trajectory
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.slam.trajectory.evaluate import distance_along, evaluate, plot, segment_errors


def yaw(degrees: float | F64) -> F64:
    return Rotation.from_rotvec(np.multiply.outer(np.radians(degrees), [0.0, 0, 1])).as_matrix()


def straight(metres: int = 1000) -> Trajectory:
    """Path to the east, one metre per pose, ten poses per second."""
    x = np.arange(metres + 1.0)
    return Trajectory(x / 10, np.column_stack([x, 0 * x, 0 * x]), np.tile(np.eye(3), (len(x), 1, 1)))


def winding(metres: int = 1500) -> Trajectory:
    """Path with bends and hills, one metre per pose, with the sensor facing along it."""
    s = np.arange(metres + 1.0)
    heading = 1.5 * np.sin(s / 90) + s / 700
    positions = np.column_stack([np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), 5 * np.sin(s / 200)])
    return Trajectory(s / 10, positions, yaw(np.degrees(heading)))


def moved(t: Trajectory, rotation: F64, shift: F64, scale: float = 1.0) -> Trajectory:
    assert t.rotations is not None
    return replace(t, positions=scale * t.positions @ rotation.T + shift, rotations=rotation @ t.rotations)


SHIFT = np.array([300.0, -70.0, 12.0])


def test_transformed_copy_has_no_error() -> None:
    result = evaluate(moved(winding(), yaw(130), SHIFT, 0.7), winding())
    assert result.global_mean < 1e-9 and result.local_median is not None and result.local_median < 1e-9
    assert result.scale == pytest.approx(1 / 0.7) and result.ate_similarity < 1e-9 < 1 < result.ate_rigid
    assert result.rpe is not None and result.rpe.translation < 1e-9
    assert result.rpe.rotation_deg_per_m == pytest.approx(0, abs=1e-9)
    assert result.kitti is not None and result.kitti.translation < 1e-9
    assert result.coverage == 1 and result.truth_noise is None


def test_error_of_a_wrong_scale_without_scaling_is_analytic() -> None:
    """A straight of 1000 m, 5 % too long: errors are 5 % of |x - 500|, on average half of the 25 m at the ends."""
    result = evaluate(moved(straight(), np.eye(3), SHIFT, 1.05), straight(), alignment="rigid2d")
    assert result.global_mean == pytest.approx(12.5, rel=2e-3) and result.scale == 1
    assert result.drift_percent == pytest.approx(1.25, rel=2e-3)
    assert result.local_median == pytest.approx(0, abs=1e-9)  # middles coincide
    assert result.ate_rigid == pytest.approx(50 / np.sqrt(12), rel=2e-3)
    assert result.kitti is not None and result.kitti.translation == pytest.approx(5, rel=0.01)
    assert result.rpe is not None and result.rpe.translation == pytest.approx(0.55, rel=1e-6)  # 11 poses on: > 10 m
    assert result.rpe_frame is not None and result.rpe_frame.translation == pytest.approx(0.05)


def test_error_of_scale_drift_is_analytic() -> None:
    """x (1 + x / L): residual of the best linear fit to a parabola; the middle of 400 m has an error of 40 m."""
    truth = straight()
    x = truth.positions[:, 0]
    bent = replace(truth, positions=np.column_stack([x + x**2 / 1000, 0 * x, 0 * x]))
    result = evaluate(bent, truth)
    # similarity: regression of the truth on the estimate along the line
    u = bent.positions[:, 0]
    line = np.polynomial.Polynomial.fit(u, x, 1)
    assert result.global_mean == pytest.approx(np.abs(line(u) - x).mean())
    slope = line.convert().coef[1]
    assert result.scale == pytest.approx(slope)
    # middle of [a, a + 400] of x + x^2 / 1000: 200^2 / 1000 = 40 before its mean of ends, for any a
    assert np.allclose(result.local_errors, 40 * slope) and result.local_at[[0, -1]].tolist() == [200, 800]


def test_error_of_heading_drift_is_analytic() -> None:
    """The estimate of a straight is an arc with known sagitta over 400 m, and degrees per metre."""
    truth = straight()
    bend = 1e-4  # rad/m
    s = truth.positions[:, 0]
    arc = np.column_stack([np.sin(bend * s) / bend, (1 - np.cos(bend * s)) / bend, 0 * s])
    result = evaluate(Trajectory(truth.times, arc, yaw(np.degrees(bend * s))), truth, alignment="rigid2d")
    assert np.allclose(result.local_errors, (1 - np.cos(200 * bend)) / bend, rtol=1e-3)
    for error in (result.rpe, result.rpe_frame, result.kitti):
        assert error is not None and error.rotation_deg_per_m == pytest.approx(np.degrees(bend), rel=0.02)


def test_excursion_counts_in_segments_with_their_middle_there() -> None:
    """A 2 m sideways excursion at 500 m is an error of segments whose middle is there, and of no others."""
    truth = straight()
    positions = truth.positions.copy()
    positions[495:506, 1] = 2
    at, errors = segment_errors(
        positions[:, :2], truth.positions[:, :2], distance_along(truth.positions[:, :2]), step=1.0
    )
    assert np.allclose(errors[(at > 494) & (at < 506)], 2) and np.allclose(errors[(at > 310) & (at < 490)], 0)
    assert np.median(errors) == pytest.approx(0, abs=1e-9)
    short = evaluate(replace(truth, positions=positions), truth, segment=100)
    assert short.local_at[0] == 50 and short.figures()["local_median_100_m"] == short.local_median


def test_umeyama_is_the_least_squares_similarity() -> None:
    random = np.random.default_rng(5)
    source = random.normal(0, 10, (60, 3))
    target = 1.7 * source @ Rotation.random(rng=random).as_matrix().T + SHIFT + random.normal(0, 2, (60, 3))
    rigid = umeyama(source, target, scaled=False)
    _, reference, _ = trimesh.registration.procrustes(source, target, reflection=False, scale=False)
    assert np.allclose(rigid.apply(source), reference) and rigid.scale == 1

    def residual(p: F64) -> F64:
        return (p[6] * source @ Rotation.from_rotvec(p[:3]).as_matrix().T + p[3:6] - target).ravel()

    ours = umeyama(source, target, scaled=True)
    start = np.concatenate([Rotation.from_matrix(ours.rotation).as_rotvec() + 0.1, SHIFT, [1.0]])
    best = least_squares(residual, start, xtol=1e-12, ftol=1e-14, gtol=1e-12)
    assert np.allclose(ours.apply(source).ravel() - target.ravel(), residual(best.x), atol=1e-5)
    assert np.linalg.det(umeyama(source * [1, 1, -1], target, scaled=True).rotation) == pytest.approx(1)
    flat = umeyama(source[:, :2], source[:, :2] @ yaw(200)[:2, :2].T * 3, scaled=True)
    assert flat.scale == pytest.approx(3) and np.allclose(flat.rotation, yaw(200)[:2, :2])


def test_an_estimate_in_another_orientation_is_levelled_by_similarity3d() -> None:
    tilted = moved(winding(), Rotation.from_euler("xyz", [80, 20, 10], degrees=True).as_matrix(), SHIFT, 3.0)
    assert evaluate(tilted, winding(), alignment="similarity3d").global_mean < 1e-9
    assert evaluate(tilted, winding()).global_mean > 10


def test_association_by_time_omits_poses_outside_the_ground_truth() -> None:
    truth = winding()
    times = np.arange(20.02, 200, 0.31)
    found = truth.pose_at(times)
    estimate = Trajectory(times, found[:, :3, 3] + SHIFT, found[:, :3, :3])
    result = evaluate(estimate, truth)
    assert result.global_mean < 1e-9 and result.times[-1] <= truth.times[-1]
    assert result.coverage == pytest.approx(1 - 200 / 1500, abs=0.01)
    with pytest.raises(DataError, match=r"0 poses in common.*20\.0 to 199\.8 s.*Shift the truth"):
        evaluate(estimate, replace(truth, times=truth.times + 1e9))
    with pytest.raises(DataError, match=r"by time"):
        evaluate(estimate, truth, by="index")
    assert evaluate(truth, replace(truth, times=truth.times + 1e9), by="index").global_mean < 1e-9


def test_rotation_error_against_gps_is_only_noise() -> None:
    path = winding()
    scatter = np.random.default_rng(0).normal(0, 0.8, path.positions.shape)
    near = np.arange(len(path)) % 3 == 0  # 3.3 fixes per second
    gap = (path.times > 60) & (path.times < 70)
    track = GpsTrack(path.times[near & ~gap], (path.positions + scatter)[near & ~gap])
    result = evaluate(moved(path, yaw(50), SHIFT, 2.0), track)
    assert result.truth_noise == pytest.approx(0.8, rel=0.2)
    assert 0.5 < result.global_mean < 1.3 and result.scale == pytest.approx(0.5, rel=1e-3)
    assert not ((result.times > 60) & (result.times < 70)).any()
    assert result.rpe is not None and result.rpe.rotation_deg_per_m is None
    assert result.kitti is not None and result.kitti.rotation_deg_per_m is None and result.kitti.translation < 1
    assert evaluate(path, track, truth_noise=0.1).truth_noise == 0.1


def test_distance_of_a_standing_receiver_is_small() -> None:
    jitter = np.random.default_rng(0).normal(0, 0.1, (2000, 2))
    assert distance_along(jitter)[-1] < 1
    assert distance_along(winding().positions[:, :2])[-1] == pytest.approx(1500, rel=1e-9)


def test_short_paths_have_no_segment_errors_and_invalid_ones_are_rejected() -> None:
    result = evaluate(straight(30), straight(30))
    assert result.local_median is None and result.kitti is None and result.rpe is not None
    assert result.figures()["kitti_percent"] is None
    with pytest.raises(DataError, match=r"doesn't move"):
        evaluate(replace(straight(), positions=np.zeros((1001, 3))), straight())
    with pytest.raises(DataError, match=r"contains NaN"):
        evaluate(replace(straight(), positions=np.full((1001, 3), np.nan)), straight())


def kitti_reference(truth: F64, found: F64) -> tuple[float, float]:
    """Per cent and degrees per metre as computed by KITTI's devkit for poses (T, 4, 4), z forward."""
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    shares, turns = [], []
    for first in range(0, len(truth), 10):
        for length in range(100, 801, 100):
            beyond = np.flatnonzero(way > way[first] + length)
            if len(beyond):
                last = beyond[0]
                error = (
                    np.linalg.inv(np.linalg.inv(found[first]) @ found[last]) @ np.linalg.inv(truth[first]) @ truth[last]
                )
                shares.append(100 * np.linalg.norm(error[:3, 3]) / length)
                turns.append(np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))) / length)
    return float(np.mean(shares)), float(np.mean(turns))


def test_kitti_errors_equal_those_of_the_devkit() -> None:
    truth = winding(700)
    assert truth.rotations is not None
    truth = replace(truth, positions=truth.positions * [1, 1, 0])  # the devkit's distance is 3D, ours in the plane
    random = np.random.default_rng(2)
    drift = Rotation.from_rotvec(np.cumsum(random.normal(0, 2e-4, (701, 3)), axis=0)).as_matrix()
    found = Trajectory(truth.times, truth.positions * 1.01 + random.normal(0, 0.05, (701, 3)), drift @ truth.rotations)
    result = evaluate(found, truth, alignment="rigid2d").kitti
    assert result is not None
    percent, degrees = kitti_reference(truth.poses, found.poses)
    assert result.translation == pytest.approx(percent, rel=2e-3)
    assert result.rotation_deg_per_m == pytest.approx(degrees, rel=2e-3)


def test_plot_is_written(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    truth = winding()
    found = replace(truth, positions=truth.positions * [1.02, 0.98, 1])
    plot(evaluate(found, truth, truth_noise=0.5), tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG") and len(list(tmp_path.iterdir())) == 1
