"""Calibration of a trajectory's covariances: simulated drives with known truth, and their 95 % ellipsoids."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.lens import GIVEN_SIGMA, changed_lens
from scan2sim.pipeline.core.types import F64, GpsTrack
from scan2sim.slam.global_map.covariance import covariances
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.lens import contradicts, fit_lens
from scan2sim.slam.trajectory import scale
from scan2sim.slam.trajectory.gps import smooth
from tests.fakes.slam_drive import (
    LENS,
    Follower,
    PerspectiveFollower,
    ate,
    drifting_turn,
    drive,
    inside,
    odometry_with_wrong_intrinsics,
    position_errors,
    run,
    scatter,
)

DRIVES, SECONDS = 20, 20.0


def covariance(out: Path) -> dict[str, float | None]:
    """Share of positions inside their 95 % ellipsoids: half of the drives with a 360 camera, half perspective."""
    held = []
    for seed in range(DRIVES):
        times, poses = drive(SECONDS, turn=0.05 * (1 + seed % 4))
        kind, count = ((Follower, 6000), (PerspectiveFollower, 20000))[seed % 2]
        odometry = run(times, kind(poses, scatter(poses, count, seed), seed=seed), parallax=(3.0, 1.0)[seed % 2])
        errors, known = position_errors(odometry, poses), covariances(MapCheckpoint.of(odometry, ()), None)
        held.append(float(inside(errors, known).mean()))
        if seed < 2:
            found = np.stack([odometry.pose_of(p)[:3, 3] for p in odometry.placed])
            _draw(out / f"ellipsoids_{kind.__name__.lower()}.png", found, found - errors, known)
    kinds = [float(np.mean(held[k::2])) for k in (0, 1)]
    print(f"95 % ellipsoids hold {np.mean(held):.1%} of positions over {DRIVES} drives", end=" ")
    print(
        f"(360 degrees {kinds[0]:.1%}, perspective {kinds[1]:.1%}; each {', '.join(f'{h:.0%}' for h in held)})",
        flush=True,
    )
    return {"covariance_95": float(np.mean(held))}


def gps_gain() -> dict[str, float | None]:
    """ATE of a turn with KITTI-like scale drift, with 10 cm GPS relative to without; mean of ten receivers."""
    times, truth, found = drifting_turn()
    tied = []
    for seed in range(10):
        gps = smooth(GpsTrack(times, truth + np.random.default_rng(seed).normal(0, 0.1, truth.shape)))
        factor = scale.factors(times, found, np.zeros(len(times), bool), gps, scale.DRIFT_PERSPECTIVE)
        tied.append(ate(scale.apply(found, factor), truth))
    alone = ate(found, truth)
    print(f"a turn whose scale drifts: {alone:.3f} m, with GPS of 10 cm {np.mean(tied):.3f} m", flush=True)
    return {"gps_gain": float(np.mean(tied)) / alone}


def lens() -> dict[str, float | None]:
    """Shares of ten simulated drives with a warning for a focal length 5 % off, and for a centre off by 5 % of it.

    Also false alarms on the same drives.
    """

    def alarms(*off: float) -> list[bool]:
        cameras = [changed_lens(LENS, np.array([*off, 0, 0, 0]) * (1, -1)[seed % 2]) for seed in range(10)]
        return [
            contradicts(fit_lens(camera, odometry_with_wrong_intrinsics(camera, seed).map.misfits, GIVEN_SIGMA))
            for seed, camera in enumerate(cameras)
        ]

    focal, centre, false = alarms(np.log(0.95), 0), alarms(0, 0.05), alarms(0, 0)
    print(f"focal length 5 % off: warning on {sum(focal)} of 10 drives; centre off by as much: {sum(centre)}", end="")
    print(f"; false alarms: {sum(false)}", flush=True)
    return {
        "focal_noticed": float(np.mean(focal)), "centre_noticed": float(np.mean(centre)),
        "focal_false_alarms": float(np.mean(false)),
    }  # fmt: skip


def _draw(file: Path, found: F64, truth: F64, known: F64) -> None:
    """Plot the path and the truth from above, and errors with their standard deviations along the map's x and z."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Ellipse

    figure, (above, along) = plt.subplots(1, 2, figsize=(13, 5))
    above.plot(*truth[:, [0, 2]].T, "k", lw=1, label="truth")
    above.plot(*found[:, [0, 2]].T, "C0", lw=1, label="found")
    for place, block in zip(found[::10], known[::10], strict=True):
        values, axes = np.linalg.eigh(block[np.ix_([0, 2], [0, 2])])
        size = 2 * np.sqrt(5.99 * values) * 20
        above.add_patch(
            Ellipse(place[[0, 2]], *size, angle=np.degrees(np.arctan2(axes[1, 0], axes[0, 0])), fill=False, ec="C3")
        )
    above.set(aspect="equal", title="95 % ellipses, 20 times as large")
    for k, name in ((0, "x"), (2, "z")):
        sigma = np.sqrt(known[:, k, k])
        along.plot(found[:, k] - truth[:, k], f"C{k}", label=f"error, {name}")
        along.fill_between(np.arange(len(sigma)), -1.96 * sigma, 1.96 * sigma, color=f"C{k}", alpha=0.2)
    along.set(xlabel="frame", title="errors and 95 %")
    for part in (above, along):
        part.legend()
        part.grid(alpha=0.3)
    figure.savefig(file, dpi=80)
    plt.close(figure)
