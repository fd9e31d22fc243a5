"""Covariance of every pose: from observed points, dead reckoning over gaps, and GPS."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, GpsTrack
from scan2sim.slam.geometry import lever_arm_jacobian
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.mapping.marginalization import MotionSigma

ORIGIN_SIGMA = MotionSigma(1e-3, 1e-5)
"""First camera, if it is the origin of the world; not zero, so that readers can invert the covariance."""
UPRIGHT_SIGMA = MotionSigma(1e3, 0.02)
"""First camera, if GPS places the path: unknown position, but upright within 0.02 rad, as cameras are on average."""
BASELINE_SHARE = 1e-3
"""Standard deviation of the first two keyframes' distance, as a share of it; without GPS it is the unit of length."""
NEW_MAP_BASELINE_SHARE = 0.3
"""The same for a map that was started after tracking was lost."""
DEAD_RECKONING_DRIFT, DEAD_RECKONING_TURN = 0.3, 0.1
"""Standard deviation of dead-reckoned poses: share of the distance, and radians per second. The car may brake or
turn."""
RELOCALIZED_SIGMA = MotionSigma(0.05, 0.01)
"""Keyframe (share of the distance; radians) that was relocalized by those before a loss of tracking."""
UNCONNECTED_SIGMA = MotionSigma(1.0, 0.5)
"""Share of the distance, and radians, between keyframes without common points."""
GPS_SIGMA_M = 1.5
"""Error of a receiver that reports no DOP."""
GPS_CORRELATION_S = 60.0
"""Correlation time of a receiver's error."""


def covariances(checkpoint: MapCheckpoint, gps: GpsTrack | None, unit: float = 1.0, *, placed: bool = False) -> F64:
    """(T, 6, 6) covariance of every frame's pose, position and rotation (rad), about world axes, in the map's unit.

    Args:
        checkpoint: the map.
        gps: GPS track in the frames' times, which determines the scale, and the position if `placed`.
        unit: metres per unit of length of the map.
        placed: whether the path is placed by GPS; otherwise the world's origin is the first camera.
    """
    checkpoint.map.marginalize()
    keyframes = checkpoint.map.keyframes
    poses = checkpoint.map.poses(list(range(len(keyframes))))
    motions = [UPRIGHT_SIGMA if placed else ORIGIN_SIGMA, *_motion_sigmas(checkpoint)]
    fixes = np.full(len(poses), np.inf)
    if gps is not None:
        fixes = _gps_sigmas(np.array([k.time for k in keyframes]), gps) / unit
    baselines = _baselines(checkpoint, gps)
    known = checkpoint.map.information.covariance(poses, motions, baselines, fixes, checkpoint.map.sigma)
    out, seen = np.zeros((len(checkpoint.placed), 6, 6)), checkpoint.placed[0]
    for i, p in enumerate(checkpoint.placed):
        pose = checkpoint.pose_of(p)
        own = p.covariance
        if keyframes[p.keyframe].time == p.time:
            own = np.zeros((6, 6))
        if own is None:
            distance = float(np.linalg.norm(pose[:3, 3] - checkpoint.pose_of(seen)[:3, 3]))
            own = _covariance(dead_reckoning_sigma(distance, p.time - seen.time))
        else:
            seen = p
        lever = lever_arm_jacobian(pose[:3, 3] - poses[p.keyframe, :3, 3])
        out[i] = lever @ known[p.keyframe] @ lever.T + own
    return out


def dead_reckoning_sigma(distance: float, seconds: float) -> MotionSigma:
    """Standard deviation of a pose that was dead-reckoned over a distance in metres and a time in seconds."""
    metres = DEAD_RECKONING_DRIFT * distance + ORIGIN_SIGMA.metres
    return MotionSigma(metres, DEAD_RECKONING_TURN * seconds + ORIGIN_SIGMA.radians)


def _covariance(sigma: MotionSigma) -> F64:
    return np.diag(np.repeat([sigma.metres**2, sigma.radians**2], 3))


def _motion_sigmas(checkpoint: MapCheckpoint) -> list[MotionSigma]:
    """Standard deviation of the motion to each keyframe but the first from its predecessor, ignoring points."""
    out = []
    for before, now in zip(checkpoint.map.keyframes, checkpoint.map.keyframes[1:], strict=False):
        distance = float(np.linalg.norm(now.T_world_cam[:3, 3] - before.T_world_cam[:3, 3]))
        if before.part == now.part:
            share, radians = UNCONNECTED_SIGMA
            out.append(MotionSigma(share * distance + ORIGIN_SIGMA.metres, radians))
        elif now.tied:
            share, radians = RELOCALIZED_SIGMA
            out.append(MotionSigma(share * distance + ORIGIN_SIGMA.metres, radians))
        else:
            out.append(dead_reckoning_sigma(distance, now.time - before.time))
    return out


def _baselines(checkpoint: MapCheckpoint, gps: GpsTrack | None) -> list[tuple[int, float]]:
    """First keyframe of each map, and the relative standard deviation of its distance to the second."""
    parts = [k.part for k in checkpoint.map.keyframes]
    starts = [k for k in range(len(parts) - 1) if parts[k] == parts[k + 1] and (k == 0 or parts[k - 1] != parts[k])]
    return [(k, BASELINE_SHARE if parts[k] == 0 and gps is None else NEW_MAP_BASELINE_SHARE) for k in starts]


def _gps_sigmas(times: F64, gps: GpsTrack) -> F64:
    """(C,) standard deviation of each keyframe's GPS position, metres; infinite where there is none.

    Keyframes within the correlation time share one error: each is down-weighted by their number.
    """
    known = np.isfinite(gps.at(times)[:, 0])
    sigma = np.full(len(times), GPS_SIGMA_M) if gps.sigma is None else np.interp(times, gps.times, gps.sigma)
    half = GPS_CORRELATION_S / 2
    correlated = np.searchsorted(times, times + half) - np.searchsorted(times, times - half)
    return np.where(known, sigma * np.sqrt(np.maximum(correlated, 1)), np.inf)


def transformed(covariance: F64, R: F64, unit: float) -> F64:
    """(T, 6, 6) covariances rotated by R (3, 3), and scaled to metres; `unit`: metres per old unit of length."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = unit * R, R
    return np.asarray(turn @ covariance @ turn.T, np.float64)
