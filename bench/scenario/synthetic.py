"""Tracks of the synthetic street with traffic compared with its true ones.

Whole boxes are compared: a vehicle that is only ever seen from behind has the typical length of its class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from scan2sim.pipeline.core.types import PointCloud, Trajectory
from scan2sim.pipeline.lidar.sweeps import sweep_numbers
from scan2sim.pipeline.tracking.extents import axes
from scan2sim.pipeline.tracking.tracks import Track

MAX_RANGE_M = 40.0
MIN_RETURNS = 5
"""Returns of a road user in a sweep from which it must be followed."""
MATCH_M = 1.0
"""Largest distance of a track from a true one that it follows."""
MARGIN_M = 0.1


@dataclass(frozen=True)
class Comparison:
    """Sweeps in which moving road users have returns (`expected`); errors (m) and turns (rad) where they have a box."""

    expected: int
    errors: list[float]
    turns: list[float]


def result(streets: Sequence[Comparison]) -> dict[str, float]:
    """Recall over all sweeps of all streets, and the median errors of position in plan and yaw."""
    errors = [error for one in streets for error in one.errors]
    turns = [turn for one in streets for turn in one.turns]
    return {
        "synthetic_recall": len(errors) / max(sum(one.expected for one in streets), 1),
        "synthetic_position_m": float(np.median(errors)) if errors else float("nan"),
        "synthetic_yaw_deg": float(np.degrees(np.median(turns))) if turns else float("nan"),
    }


def compare(cloud: PointCloud, path: Trajectory, truth: Sequence[Track], tracks: Sequence[Track]) -> Comparison:
    """Tracks compared with the true ones in every sweep.

    Args:
        cloud: all returns, with times.
        path: path of the scanner.
        truth: true tracks.
        tracks: found ones, in the same coordinates.
    """
    assert cloud.time is not None
    sweep = sweep_numbers(cloud.time, path.times)
    errors: dict[int, list[float]] = {}
    turns: list[float] = []
    expected: dict[int, int] = {}
    moving = [track for track in tracks if track.moving and track.category != "ego"]
    for own in np.split(np.argsort(sweep, kind="stable"), np.cumsum(np.bincount(sweep))[:-1]):
        xyz, times = cloud.xyz[own].astype(np.float64), cloud.time[own]
        seen = []
        for track in truth:
            if not track.moving or not track.times[0] <= np.median(times) <= track.times[-1]:
                continue
            pose = track.at([np.median(times)])[0]
            near = np.hypot(*(xyz[:, :2] - pose[:2]).T) < track.size[0]
            moments = times[near]
            poses = track.at(moments)
            local = np.einsum(
                "ni,nij->nj", xyz[near, :2] - poses[:, :2], np.array([axes(p[3]) for p in poses]).reshape(-1, 2, 2)
            )
            inside = (np.abs(local) < np.array(track.size[:2]) / 2 + MARGIN_M).all(axis=1)
            inside &= (xyz[near, 2] > pose[2] + 0.15) & (xyz[near, 2] < pose[2] + track.size[2] + MARGIN_M)
            range_m = np.hypot(*(pose[:2] - path.at(np.array([np.median(times)]))[0, :2]))
            if inside.sum() >= MIN_RETURNS and range_m < MAX_RANGE_M:
                seen.append((track, float(moments[inside].mean())))
        found = [track for track in moving if track.times[0] - 0.06 <= np.median(times) <= track.times[-1] + 0.06]
        distance = np.array(
            [[np.hypot(*(true.at([t])[0, :2] - one.at([t])[0, :2])) for one in found] for true, t in seen]
        ).reshape(len(seen), len(found))
        rows, columns = linear_sum_assignment(np.minimum(distance, 10))
        for true, _ in seen:
            expected[true.id] = expected.get(true.id, 0) + 1
        for row, column in zip(rows, columns, strict=True):
            if distance[row, column] < MATCH_M:
                true, moment = seen[row]
                errors.setdefault(true.id, []).append(float(distance[row, column]))
                turn = true.at([moment])[0, 3] - found[column].at([moment])[0, 3]
                turns.append(abs((turn + np.pi) % (2 * np.pi) - np.pi))
    for track in truth:
        if track.id in expected:
            own_errors = errors.get(track.id, [])
            middle = f"{np.median(own_errors):.3f} m" if own_errors else "-"
            print(f"  {track.category} {track.id}: {len(own_errors)} of {expected[track.id]} sweeps, position {middle}")
    every = [error for own_errors in errors.values() for error in own_errors]
    return Comparison(sum(expected.values()), every, turns)
