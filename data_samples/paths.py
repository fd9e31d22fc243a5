"""Driven paths, real (KITTI) and synthetic, and the camera's motion along them.

Paths are planar, (N, 2) metres. The ground is flat here (`hills` adds height): height only varies with the suspension.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, Trajectory

POINT_SPACING_M = 0.25  # of a smoothed path
LATERAL_ACCELERATION_MAX = 2.5  # m/s2, in bends
ACCELERATION_MAX, DECELERATION_MAX = 1.8, 2.2  # m/s2
CAMERA_HEIGHT_M = 2.0
SWAY_SIGMA = {"roll": np.radians(0.5), "pitch": np.radians(0.4), "height": 0.02}  # standard deviations while driving
SWAY_BAND_HZ = (0.25, 1.8)  # frequencies of the suspension


def kitti_path(file: Path, length: float | None = None) -> F64:
    """(N, 2) path of a KITTI odometry ground truth (row-major 3x4 poses), metres: x to the right, z forward becomes y.

    Args:
        file: KITTI pose file.
        length: keep only this length from the start, metres; None: all.
    """
    rows = np.loadtxt(file, ndmin=2)
    if rows.shape[1] != 12:
        raise DataError(
            str(file),
            f"has {rows.shape[1]} numbers per line, not 12",
            "Give KITTI poses: a row-major 3x4 matrix per line",
        )
    path = rows[:, [3, 11]]
    return path if length is None else path[chainage(path) <= length]


def loop_path(width: float = 140.0, depth: float = 90.0, laps: float = 1.25) -> F64:
    """(N, 2) path of laps around a block of slightly curved streets, metres."""
    side = [(width, 0.0), (0.0, depth), (-width, 0.0), (0.0, -depth)]
    legs = np.array(side * int(np.ceil(laps) + 1))
    path = _rounded(np.concatenate([[(0.0, 0.0)], np.cumsum(legs, axis=0)]))
    return path[chainage(path) <= laps * 2 * (width + depth)]


def town_path(seed: int, length: float) -> F64:
    """(N, 2) path through a town of curved blocks, metres: first around one block, then with random turns."""
    rng = np.random.default_rng([seed, 11])
    block = np.array([rng.uniform(110, 150), rng.uniform(80, 110)])
    turns = [0, 1, 1, 1, 0]
    at, way, corners = np.zeros(2), np.array([0, 1]), [np.zeros(2)]
    while len(corners) * block.min() < length + 2 * block.max():
        turn = turns.pop(0) if turns else int(rng.choice([-1, 0, 1]))
        way = way if turn == 0 else turn * np.array([way[1], -way[0]])  # 1: to the right
        at = at + way * block
        corners.append(at)
    path = _rounded(np.array(corners))
    return path[chainage(path) <= length]


def zigzag_path(length: float, block: float = 55.0, rounded: float = 4.0) -> F64:
    """(N, 2) path with a right angle every `block` metres, alternately right and left, metres.

    Args:
        length: of the path, metres.
        block: metres between two corners.
        rounded: standard deviation of the Gaussian that smooths the corners, metres; 4: sharp.
    """
    corners = block * np.array([((k + 1) // 2, k // 2) for k in range(int(length / block) + 3)], float)
    path = _rounded(corners, rounded)
    return path[chainage(path) <= length]


def _rounded(corners: F64, rounded: float = 6.5) -> F64:
    """Smooth path near the corners, with a point every 0.5 m; the curvature of streets depends on the position only."""
    s = chainage(corners)
    at = np.arange(0, s[-1], 0.5)
    path = np.stack([np.interp(at, s, corners[:, k]) for k in range(2)], axis=1)
    path = path + 5.0 * np.stack([np.sin(path[:, 1] / 31.0), np.sin(path[:, 0] / 37.0 + 1.0)], axis=1)
    return _smoothed(path, 0.5, rounded)


def chainage(path: F64) -> F64:
    """(N,) distance along the path from its start to each point, metres."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def smooth(path: F64) -> F64:
    """(M, 2) path smoothed by a Gaussian of 1.5 m, with a point every `POINT_SPACING_M` metres."""
    s = chainage(path)
    moved = np.concatenate([[True], np.diff(np.floor(s / 0.2)) > 0])  # skip points without motion
    path, s = path[moved], s[moved]
    if len(path) < 2:
        raise DataError("path", "is too short", "Give a path longer than a metre")
    at = np.arange(0, s[-1], POINT_SPACING_M)
    path = _smoothed(np.stack([np.interp(at, s, path[:, k]) for k in range(2)], axis=1), POINT_SPACING_M, 1.5)
    s = chainage(path)
    at = np.arange(0, s[-1], POINT_SPACING_M)
    return np.stack([np.interp(at, s, path[:, k]) for k in range(2)], axis=1)


def _smoothed(path: F64, step: float, sigma: float) -> F64:
    from scipy.ndimage import gaussian_filter1d

    pad = int(4 * sigma / step) + 1  # mirroring the path at its ends keeps them in place
    before, after = 2 * path[0] - path[pad:0:-1], 2 * path[-1] - path[-2 : -pad - 2 : -1]
    whole = gaussian_filter1d(np.concatenate([before, path, after]), sigma / step, axis=0)
    return whole[len(before) : len(before) + len(path)]


def extended(path: F64, length: float) -> F64:
    """(M, 2) smooth path extended straight by `length` metres at both ends."""
    steps = np.arange(POINT_SPACING_M, length + POINT_SPACING_M / 2, POINT_SPACING_M)[:, None]
    first, last = ((path[i] - path[j]) / np.linalg.norm(path[i] - path[j]) for i, j in ((1, 0), (-1, -2)))
    return np.concatenate([path[0] - steps[::-1] * first, path, path[-1] + steps * last])


def heading(path: F64) -> F64:
    """(N,) heading along a smooth path, radians counter-clockwise from x, continuous."""
    tangent = np.gradient(path, axis=0)
    return np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))


def drive(
    path: F64,
    speed: float = 12.0,
    fps: float = 15.0,
    *,
    seconds: float | None = None,
    still: float = 1.0,
    height: float = CAMERA_HEIGHT_M,
    sway: float = 1.0,
    seed: int = 0,
) -> Trajectory:
    """Trajectory of a camera (axes x right, y down, z forward; world z up) on a car that drives along a path.

    Args:
        path: (N, 2) metres.
        speed: m/s on straights; in bends limited by a lateral acceleration of 2.5 m/s2.
        fps: poses per second, the first at time 0.
        seconds: duration; default: to the path's end.
        still: seconds that the car stands before it starts.
        height: height of the camera above the (flat) ground, metres.
        sway: factor on the suspension's motion: 0.5 degrees of roll, 0.4 of pitch, 2 cm of height, below 2 Hz.
        seed: seed of the suspension's motion.
    """
    from scipy.interpolate import CubicHermiteSpline, CubicSpline

    path = smooth(path)
    s, yaw = chainage(path), heading(path)
    v, clock = _speeds(s, yaw, speed)
    duration = min(clock[-1] + still, np.inf if seconds is None else seconds)
    times = np.arange(int(np.floor(duration * fps + 1e-9)) + (seconds is None)) / fps
    going = np.clip(times - still, 0, clock[-1])
    where = CubicHermiteSpline(clock, s, v)(going)
    xy, angle = CubicSpline(s, path)(where), CubicSpline(s, yaw)(where)
    share = sway * np.clip(CubicHermiteSpline(clock, s, v)(going, 1) / 4, 0, 1) * (times > still)
    rng = np.random.default_rng([seed, 12])
    roll, pitch, up = (share * SWAY_SIGMA[name] * _suspension_noise(times, rng) for name in ("roll", "pitch", "height"))
    return Trajectory(times, np.column_stack([xy, height + up]), axes(angle, pitch, roll))


def _speeds(s: F64, yaw: F64, speed: float) -> tuple[F64, F64]:
    """(N,) speed at each point, m/s, starting from rest, and (N,) time when it is reached, seconds."""
    from scipy.ndimage import gaussian_filter1d, minimum_filter1d

    bend = gaussian_filter1d(np.abs(np.gradient(yaw, s)), 1.0 / POINT_SPACING_M)
    v = np.minimum(speed, np.sqrt(LATERAL_ACCELERATION_MAX / np.maximum(bend, 1e-6)))
    v = gaussian_filter1d(minimum_filter1d(v, int(6 / POINT_SPACING_M)), 2.0 / POINT_SPACING_M, mode="nearest")
    v[0] = 0.0
    for i in range(1, len(v)):
        v[i] = min(v[i], np.sqrt(v[i - 1] ** 2 + 2 * ACCELERATION_MAX * (s[i] - s[i - 1])))
    for i in range(len(v) - 2, 0, -1):
        v[i] = min(v[i], np.sqrt(v[i + 1] ** 2 + 2 * DECELERATION_MAX * (s[i + 1] - s[i])))
    return v, np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[1:] + v[:-1]))])


def _suspension_noise(times: F64, rng: np.random.Generator) -> F64:
    """(T,) smooth noise of standard deviation 1 within `SWAY_BAND_HZ`."""
    frequency, phase = rng.uniform(*SWAY_BAND_HZ, 12), rng.uniform(0, 2 * np.pi, 12)
    weight = 1 / frequency  # smaller amplitudes at higher frequencies
    weight /= np.sqrt((weight**2).sum() / 2)
    return np.sin(2 * np.pi * np.outer(times, frequency) + phase) @ weight


def axes(yaw: F64, pitch: F64, roll: F64) -> F64:
    """(T, 3, 3) rotation from camera axes to world: heading `yaw`, nose up by `pitch`, right side down by `roll`."""
    from scipy.spatial.transform import Rotation

    c, s, none = np.cos(yaw), np.sin(yaw), 0 * yaw
    level = np.stack([np.stack([s, -c, none], 1), np.stack([none, none, none - 1], 1), np.stack([c, s, none], 1)], 2)
    return level @ Rotation.from_euler("XZ", np.column_stack([pitch, roll])).as_matrix()
