"""Fit of boxes: one size for a whole track, poses smoothed over all of its sweeps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.tracking import extents, kalman
from scan2sim.pipeline.tracking.sizes import LARGEST, TYPICAL, categorize
from scan2sim.pipeline.tracking.tracks import Category

ACCELERATIONS_MPS2 = (0.5, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Standard deviation of the accelerations of road users in each iteration over category, direction and smoothed states,
which depend on each other: nearly straight at first, brisk starts and stops of cars at last."""
FIRST_SIGMA_M = 1.0
"""Standard deviation of the middle of the points as the first estimate of a centre."""
DIRECTION_MIN_MPS = 1.0
"""Speed from which the direction of travel is the yaw; slower vehicles keep the last one."""
SIDE_SPACING_MAX_M = 0.4
"""Spacing of points along a side from which its far end is unknown."""
RIDER_SHARE, RIDER_SIGMA_M = 0.75, 0.2
"""Share of the length of a two-wheeler below which only its rider was seen, as few rays hit the wheels; and standard
deviation of the rider's place, about the middle."""
END_SIGMA = 0.07
"""Standard deviation of the far end of a side, relative to the length: bodies are rounded."""
OUTSIDE_M = 0.3
"""Distance of points beyond the expected end of a box from which they may be of another object."""
MERGED_M = 0.3
"""Excess over the largest size of a category from which a cluster is of several objects."""
HIDDEN_M = 0.5
"""Distance of the last point of a side from its expected end from which something hides the end."""
SIGMA_MIN_M = 0.04
"""Standard deviation of positions that all sweeps share: the scanner's own."""
BEST_SHARE = 0.25
"""Share of the sweeps with the finest spacing that determine the category."""


@dataclass(frozen=True)
class Observation:
    """Returns of an object in one sweep.

    Attributes:
        xyz: (N, 3) local metres.
        height: (N,) metres above ground.
        times: (N,) seconds.
        time: seconds, of the pose.
        scanner: (2,) position of the scanner.
    """

    xyz: F64
    height: F64
    times: F64
    time: float
    scanner: F64


@dataclass(frozen=True)
class Fit:
    """Boxes of a track: `Track`'s fields, without z.

    Attributes:
        category: its class.
        size: length, width, height in metres.
        times: (T,) seconds.
        states: (T, 4) x, y of the centre and its velocity.
        yaw: (T,) radians.
        sigma: (T, 2) of the position (m) and of the yaw (rad).
        residual: median distance of measured ends from the smoothed boxes, metres.
    """

    category: Category
    size: tuple[float, float, float]
    times: F64
    states: F64
    yaw: F64
    sigma: F64
    residual: float


def fit(observations: Sequence[Observation], times: F64, category: Category | None = None) -> Fit:
    """Boxes at `times` (T,), ascending, which include the times of all observations.

    Args:
        observations: in order of time, at least two.
        times: seconds.
        category: if it is known; None: by size and speed.
    """
    at = np.searchsorted(times, [one.time for one in observations])
    measured: list[list[kalman.Measurement]] = [[] for _ in times]
    for k, one in zip(at, observations, strict=True):
        measured[k] = [
            kalman.Measurement(np.eye(6)[axis], float(np.median(one.xyz[:, axis])), FIRST_SIGMA_M**2) for axis in (0, 1)
        ]
    height = float(np.percentile([np.percentile(one.height, 98) for one in observations], 90))
    own: Category = category or "car"
    means = kalman.smooth(_first(observations[0], own), times, measured, ACCELERATIONS_MPS2[0]).mean
    residuals = [0.0]
    for acceleration in ACCELERATIONS_MPS2:
        yaw = directions(times, means)
        seen = []
        for k, one in zip(at, observations, strict=True):
            deskewed = one.xyz[:, :2] - (one.times - one.time)[:, None] * means[k, 2:4]
            seen.append(extents.extent(deskewed, means[k, :2], float(yaw[k]), one.scanner))
        if category is None:
            own = categorize(*_best(seen), height, float(np.median(np.hypot(*means[:, 2:4].T))))
        ends = [sum(extents.side_spacing(one, axis) < SIDE_SPACING_MAX_M for one in seen) for axis in (0, 1)]
        for k, part in zip(at, seen, strict=True):
            measured[k] = list(_measurements(part, means[k], float(yaw[k]), own, ends))
        smoothed = kalman.smooth(_first(observations[0], own), times, measured, acceleration)
        means = smoothed.mean
        residuals = [abs(m.value - float(m.by_state @ means[k])) for k in at for m in measured[k]]
    yaw = directions(times, means)
    length, width = (
        float(np.clip(means[:, 4 + axis].mean(), 0.7 * TYPICAL[own][axis], LARGEST[own][axis])) for axis in (0, 1)
    )
    sigma_m = np.sqrt(np.trace(smoothed.covariance[:, :2, :2], axis1=1, axis2=2) / 2 + SIGMA_MIN_M**2)
    speeds = np.maximum(np.hypot(*means[:, 2:4].T), 0.1)
    sigma_rad = np.sqrt(np.trace(smoothed.covariance[:, 2:4, 2:4], axis1=1, axis2=2) / 2) / speeds
    box = length, width, float(np.clip(height, 0.7 * TYPICAL[own].height, LARGEST[own].height))
    sigma = np.column_stack([sigma_m, np.minimum(sigma_rad, np.pi / 4)])
    return Fit(own, box, times, means[:, :4], yaw, sigma, float(np.median(residuals)))


def _first(observation: Observation, category: Category) -> kalman.State:
    """State before all measurements: anywhere near the first points, with the typical size."""
    typical = TYPICAL[category]
    mean = np.array([*np.median(observation.xyz[:, :2], axis=0), 0.0, 0.0, typical.length, typical.width])
    spread = extents.SPREAD[0] * typical.length, extents.SPREAD[1] * typical.width
    sigma = np.array([typical.length, typical.length, kalman.FIRST_SPEED_MPS, kalman.FIRST_SPEED_MPS, *spread])
    return kalman.State(mean, np.diag(sigma**2))


def _best(seen: Sequence[extents.Extent]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Length and width that were seen, each with the spacing of the points along it, metres."""
    many = max(1, int(len(seen) * BEST_SHARE))
    longest = [float(np.percentile([one.length[axis] for one in seen], 80)) for axis in (0, 1)]
    gaps = [np.sort([extents.side_spacing(one, axis) for one in seen])[:many] for axis in (0, 1)]
    length, width = ((one, float(gap.mean())) for one, gap in zip(longest, gaps, strict=True))
    return length, width


def _measurements(
    seen: extents.Extent, mean: F64, yaw: float, category: Category, ends: Sequence[int]
) -> Iterator[kalman.Measurement]:
    """What the ends of an extent about the state `mean` (6,) say about centre and size.

    `ends`: numbers of sweeps that see the far end of a side, along and across, whose errors are the same.
    """
    R = extents.axes(yaw)
    two_wheeled = category in ("cyclist", "motorcycle")
    for axis in (0, 1):
        if seen.length[axis] > LARGEST[category][axis] + MERGED_M:
            continue
        if two_wheeled and axis == 0 and seen.length[0] < RIDER_SHARE * TYPICAL[category].length:
            middle = float(R[:, 0] @ mean[:2] + (seen.low[0] + seen.high[0]) / 2)
            yield kalman.Measurement(np.array([*R[:, 0], 0.0, 0.0, 0.0, 0.0]), middle, RIDER_SIGMA_M**2)
            continue
        gap = extents.side_spacing(seen, axis)
        for end, side in ((seen.low, -1), (seen.high, 1)):
            by_state = np.zeros(6)
            by_state[:2], by_state[4 + axis] = R[:, axis], side / 2
            value = float(R[:, axis] @ mean[:2] + end[axis])
            inside = side * (float(by_state @ mean) - value)
            beyond = side * float(seen.scanner[axis] - end[axis])
            if beyond > extents.FRONTAL_MARGIN_M or inside < 0:  # a face, or points beyond the expected end
                yield kalman.Measurement(by_state, value, _one_sided(inside, seen.face_sigma))
            elif gap < SIDE_SPACING_MAX_M and inside < HIDDEN_M + gap:
                sigma = float(np.hypot(END_SIGMA * TYPICAL[category].length * np.sqrt(ends[axis]), gap))
                yield kalman.Measurement(by_state, value + side * gap, _one_sided(inside, sigma))


def _one_sided(inside: float, sigma: float) -> float:
    """Variance of an end of the points that lies `inside` metres within the expected box.

    A box's end may have no points: it is thin, dark, or below the rays. Points beyond it make the box longer, unless
    they are so far out that they are of another object.
    """
    return float(sigma**2 * (1 + (inside / (sigma if inside > 0 else OUTSIDE_M)) ** 2))


def directions(times: F64, means: F64) -> F64:
    """Yaw (T,) of the velocities, continuous; where an object is slow, that of its displacement around that time."""
    velocity = means[:, 2:4]
    speed = np.hypot(*velocity.T)
    yaw = np.arctan2(velocity[:, 1], velocity[:, 0])
    slow = speed < DIRECTION_MIN_MPS
    if slow.all():
        offset = means[-1, :2] - means[0, :2]
        return np.full(len(times), np.arctan2(offset[1], offset[0]))
    known = np.flatnonzero(~slow)
    unwrapped = np.interp(times, times[known], np.unwrap(yaw[known]))
    return np.asarray(unwrapped)
