"""Uncertainty: each pose's covariance by the graph: what points tie together, how gaps were bridged, what GPS says."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, GpsTrack
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.mapping.marginalization import Tie

HELD = Tie(1e-3, 1e-5)
"""The first camera, where the world begins; not zero, which no reader could invert."""
UPRIGHT = Tie(1e3, 0.02)
"""The first camera, where GPS places the path: cameras stand upright on average, about so well."""
BASELINE = 1e-3
"""Of the first two keyframes' distance, which is the unit of lengths where there is no GPS."""
BELIEVED = 0.3
"""Of the first two keyframes' distance in a map that began after a gap."""
BRIDGED_DRIFT, BRIDGED_TURN = 0.3, 0.1
"""Of the way, and radians a second, by which poses that were carried on may be off: the car may brake, or turn."""
RECOGNISED = Tie(0.05, 0.01)
"""Of the way, and radians, of a keyframe that the last ones before a gap have told the place of."""
UNKNOWN = Tie(1.0, 0.5)
"""Of the way, and radians, between keyframes that no point ties together."""
GPS_SIGMA, GPS_MEMORY = 1.5, 60.0
"""Metres, of a receiver that tells no DOP, and seconds after which its error is another."""


def covariances(mapped: Mapped, gps: GpsTrack | None, unit: float = 1.0, *, placed: bool = False) -> F64:
    """(T, 6, 6) of every frame's pose, position and rotation (rad), about the axes of the map's world, in its lengths.

    Args:
        gps: the track that ties scale and place, in the frames' times.
        unit: metres of the map's unit of length.
        placed: GPS tells where the path is, too; else it begins at the first camera.
    """
    mapped.map.tell()
    keyframes = mapped.map.keyframes
    poses = mapped.map.poses(list(range(len(keyframes))))
    ties = [UPRIGHT if placed else HELD, *_ties(mapped)]
    fixes = np.full(len(poses), np.inf) if gps is None else _fixes(np.array([k.time for k in keyframes]), gps) / unit
    known = mapped.map.information.covariance(poses, ties, _chords(mapped, gps), fixes, mapped.map.sigma)
    out, seen = np.zeros((len(mapped.placed), 6, 6)), mapped.placed[0]
    for i, p in enumerate(mapped.placed):
        pose = mapped.pose_of(p)
        own = p.covariance
        if keyframes[p.keyframe].time == p.time:
            own = np.zeros((6, 6))
        if own is None:
            way = float(np.linalg.norm(pose[:3, 3] - mapped.pose_of(seen)[:3, 3]))
            own = _square(bridged(way, p.time - seen.time))
        else:
            seen = p
        lever = leverage(pose[:3, 3] - poses[p.keyframe, :3, 3])
        out[i] = lever @ known[p.keyframe] @ lever.T + own
    return out


def bridged(way: float, seconds: float) -> Tie:
    """How far a pose is off that was carried on over so many metres and seconds."""
    return Tie(BRIDGED_DRIFT * way + HELD.metres, BRIDGED_TURN * seconds + HELD.radians)


def leverage(arm: F64) -> F64:
    """(6, 6) how a change of pose (metres, radians about world axes) moves what is `arm` (3,) from it."""
    x, y, z = arm
    out = np.eye(6)
    out[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    return out


def _square(tie: Tie) -> F64:
    return np.diag(np.repeat([tie.metres**2, tie.radians**2], 3))


def _ties(mapped: Mapped) -> list[Tie]:
    """How far each keyframe but the first may be from where the one before says that it is, whatever points say."""
    out = []
    for before, now in zip(mapped.map.keyframes, mapped.map.keyframes[1:], strict=False):
        way = float(np.linalg.norm(now.T_world_cam[:3, 3] - before.T_world_cam[:3, 3]))
        if before.part == now.part:
            out.append(Tie(UNKNOWN.metres * way + HELD.metres, UNKNOWN.radians))
        elif now.tied:
            out.append(Tie(RECOGNISED.metres * way + HELD.metres, RECOGNISED.radians))
        else:
            out.append(bridged(way, now.time - before.time))
    return out


def _chords(mapped: Mapped, gps: GpsTrack | None) -> list[tuple[int, float]]:
    """First keyframes of the maps, and how well their distance to the second is known."""
    parts = [k.part for k in mapped.map.keyframes]
    starts = [k for k in range(len(parts) - 1) if parts[k] == parts[k + 1] and (k == 0 or parts[k - 1] != parts[k])]
    return [(k, BASELINE if parts[k] == 0 and gps is None else BELIEVED) for k in starts]


def _fixes(times: F64, gps: GpsTrack) -> F64:
    """(C,) metres by which GPS's place of each keyframe may be off; as much more as its errors are the same ones."""
    known = np.isfinite(gps.at(times)[:, 0])
    sigma = np.full(len(times), GPS_SIGMA) if gps.sigma is None else np.interp(times, gps.times, gps.sigma)
    alike = np.searchsorted(times, times + GPS_MEMORY / 2) - np.searchsorted(times, times - GPS_MEMORY / 2)
    return np.where(known, sigma * np.sqrt(np.maximum(alike, 1)), np.inf)


def moved(covariance: F64, R: F64, unit: float) -> F64:
    """(T, 6, 6) about other axes, R (3, 3), and in metres of which the old unit has so many."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = unit * R, R
    return np.asarray(turn @ covariance @ turn.T, np.float64)
