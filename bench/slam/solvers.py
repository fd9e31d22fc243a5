"""The `adam` solver of D3.2 compared with `lm`, all else equal: simulated drives, distance constraints and GPS."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scan2sim.pipeline.core.types import F64, Camera, GpsTrack
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.trajectory.gps import smooth
from tests.fakes.slam_drive import Follower, ate, drive, scatter

SEEDS, SECONDS, TRACKS, PARALLAX_DEG = 10, 8.0, 150, 6.0
GPS_DRIFT_M, GPS_DRIFT_S, GPS_NOISE_M = 1.5, 60.0, 0.15
"""Slow error of the receiver, its correlation time (decay to 1/e), and its white noise."""

DistanceConstraints = Literal["long", "adjacent"]


def receiver(times: F64, positions: F64, seed: int) -> GpsTrack:
    """One smoothed fix per second with a slowly varying error and white noise."""
    rng = np.random.default_rng([seed, 7])
    rows = np.arange(0, len(times), 10)
    keep = np.exp(-1 / GPS_DRIFT_S)
    error = rng.normal(0, GPS_DRIFT_M, (len(rows), 3))
    for i in range(1, len(rows)):
        error[i] = keep * error[i - 1] + np.sqrt(1 - keep**2) * error[i]
    return smooth(GpsTrack(times[rows], positions[rows] + error + rng.normal(0, GPS_NOISE_M, error.shape)))


def error(seed: int, backend: str, chords: DistanceConstraints) -> float:
    """ATE of a simulated drive in percent of its length."""
    times, poses = drive(SECONDS, turn=0.05 * (1 + seed % 4))
    truth = poses[:, :3, 3]
    follower = Follower(poses, scatter(poses, 5000, seed), count=TRACKS, noise=np.radians(0.05), seed=seed)
    odometry = Odometry(
        Camera("equirectangular", 2048, 1024), OdometryParams(gps_distances=chords, parallax=PARALLAX_DEG, seed=seed),
        tracker=follower,
        gps=receiver(times, truth, seed), backend=backend,
    )  # fmt: skip
    for time in times:
        odometry.add(float(time), np.zeros((4, 8), np.uint8))
    found = np.stack([odometry.pose_of(p)[:3, 3] for p in odometry.placed])
    way = float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    return 100 * ate(found, truth) / way


def solvers() -> dict[str, float | None]:
    """Paired Wilcoxon test over the seeds: `adam` and adjacent distance constraints, each compared with `lm`."""
    from scipy.stats import wilcoxon

    kinds: tuple[tuple[str, DistanceConstraints], ...] = (("lm", "long"), ("adam", "long"), ("lm", "adjacent"))
    found = {kind: np.array([error(seed, *kind) for seed in range(SEEDS)]) for kind in kinds}
    ours = found[kinds[0]]
    for (backend, chords), errors in found.items():
        summary = f"{backend}, {chords} distances: {errors.mean():.4f} % ({errors.min():.4f} to {errors.max():.4f})"
        better = int((errors < ours).sum())
        p = 1.0 if errors is ours else float(wilcoxon(errors, ours).pvalue)
        print(f"{summary}, better than lm with long ones on {better} of {SEEDS} drives, p {p:.3f}", flush=True)
    return {"adam_lm_p": float(wilcoxon(found[kinds[1]], ours).pvalue)}
