"""The mission's solver against ours, with all else equal: simulated drives, the same chords, the same GPS."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scan2sim.pipeline.core.types import F64, Camera, GpsTrack
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.trajectory.gps import smooth
from tests.slam.synthetic import Follower, ate, drive, scatter

SEEDS, SECONDS, TRACKS, PARALLAX = 10, 8.0, 150, 6.0
WANDER, MEMORY, JITTER = 1.5, 60.0, 0.15
"""Of a receiver: metres of its slow error, seconds until that has decayed to 1/e, metres of its white one."""

Chords = Literal["long", "adjacent"]


def receiver(times: F64, places: F64, seed: int) -> GpsTrack:
    """One fix a second, smoothed, off by a slow error and a white one."""
    rng = np.random.default_rng([seed, 7])
    which = np.arange(0, len(times), 10)
    keep = np.exp(-1 / MEMORY)
    error = rng.normal(0, WANDER, (len(which), 3))
    for i in range(1, len(which)):
        error[i] = keep * error[i - 1] + np.sqrt(1 - keep**2) * error[i]
    return smooth(GpsTrack(times[which], places[which] + error + rng.normal(0, JITTER, error.shape)))


def error(seed: int, backend: str, chords: Chords) -> float:
    """ATE of a simulated drive in per cent of its way."""
    times, poses = drive(SECONDS, turn=0.05 * (1 + seed % 4))
    truth = poses[:, :3, 3]
    follower = Follower(poses, scatter(poses, 5000, seed), count=TRACKS, noise=np.radians(0.05), seed=seed)
    odometry = Odometry(
        Camera("equirectangular", 2048, 1024), OdometryParams(gps_chords=chords, parallax=PARALLAX, seed=seed),
        tracker=follower,
        gps=receiver(times, truth, seed), backend=backend,
    )  # fmt: skip
    for time in times:
        odometry.add(float(time), np.zeros((4, 8), np.uint8))
    found = np.stack([odometry.pose_of(p)[:3, 3] for p in odometry.placed])
    way = float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    return 100 * ate(found, truth) / way


def solvers() -> dict[str, float | None]:
    """Wilcoxon's paired test over the seeds: `adam` against `lm` with chords alike; and chords with `lm` alone."""
    from scipy.stats import wilcoxon

    kinds: tuple[tuple[str, Chords], ...] = (("lm", "long"), ("adam", "long"), ("lm", "adjacent"))
    found = {kind: np.array([error(seed, *kind) for seed in range(SEEDS)]) for kind in kinds}
    ours = found[kinds[0]]
    for (backend, chords), errors in found.items():
        told = f"{backend}, {chords} chords: {errors.mean():.4f} % ({errors.min():.4f} to {errors.max():.4f})"
        better = int((errors < ours).sum())
        p = 1.0 if errors is ours else float(wilcoxon(errors, ours).pvalue)
        print(f"{told}, better than lm with long ones on {better} of {SEEDS} drives, p {p:.3f}", flush=True)
    return {"adam_lm_p": float(wilcoxon(found[kinds[1]], ours).pvalue)}
