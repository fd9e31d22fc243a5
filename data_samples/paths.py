"""Where a car drives: real paths (KITTI) and made-up ones, and the camera's motion along them.

Paths are planar, (N, 2) metres. The ground is flat here (`hills` lifts it): height comes from the suspension alone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, Trajectory

STEP = 0.25  # metres between the points of a smoothed path
SIDEWAYS = 2.5  # m/s2 that a driver bears in a bend
FASTER, SLOWER = 1.8, 2.2  # m/s2
CAMERA_HEIGHT = 2.0
SWAY = {"roll": np.radians(0.5), "pitch": np.radians(0.4), "height": 0.02}  # standard deviations at speed
BAND = (0.25, 1.8)  # Hz, of the suspension


def kitti_path(file: Path, length: float | None = None) -> F64:
    """(N, 2) metres of a KITTI odometry ground truth (row-major 3x4 poses): x to the right, z forward becomes y.

    Args:
        length: keep the first metres only.
    """
    rows = np.loadtxt(file, ndmin=2)
    if rows.shape[1] != 12:
        raise DataError(str(file), f"{rows.shape[1]} numbers a line", "Expected 12: a row-major 3x4 pose a line")
    path = rows[:, [3, 11]]
    return path if length is None else path[chainage(path) <= length]


def loop_path(width: float = 140.0, depth: float = 90.0, laps: float = 1.25) -> F64:
    """(N, 2) metres: laps around a block of bent streets."""
    side = [(width, 0.0), (0.0, depth), (-width, 0.0), (0.0, -depth)]
    legs = np.array(side * int(np.ceil(laps) + 1))
    path = _through(np.concatenate([[(0.0, 0.0)], np.cumsum(legs, axis=0)]))
    return path[chainage(path) <= laps * 2 * (width + depth)]


def town_path(seed: int, length: float) -> F64:
    """(N, 2) metres through a town of bent blocks: first around one of them, then wherever a die says."""
    rng = np.random.default_rng([seed, 11])
    block = np.array([rng.uniform(110, 150), rng.uniform(80, 110)])
    turns = [0, 1, 1, 1, 0]
    at, way, corners = np.zeros(2), np.array([0, 1]), [np.zeros(2)]
    while len(corners) * block.min() < length + 2 * block.max():
        turn = turns.pop(0) if turns else int(rng.choice([-1, 0, 1]))
        way = way if turn == 0 else turn * np.array([way[1], -way[0]])  # 1: to the right
        at = at + way * block
        corners.append(at)
    path = _through(np.array(corners))
    return path[chainage(path) <= length]


def zigzag_path(length: float, block: float = 55.0) -> F64:
    """(N, 2) metres: a right angle every `block` metres, to the right and to the left, sharper than in a town."""
    corners = block * np.array([((k + 1) // 2, k // 2) for k in range(int(length / block) + 3)], float)
    path = _through(corners, 4.0)
    return path[chainage(path) <= length]


def _through(corners: F64, rounded: float = 6.5) -> F64:
    """A smooth path near the corners, 0.5 m a point; streets are bent alike wherever they are passed."""
    s = chainage(corners)
    at = np.arange(0, s[-1], 0.5)
    path = np.stack([np.interp(at, s, corners[:, k]) for k in range(2)], axis=1)
    path = path + 5.0 * np.stack([np.sin(path[:, 1] / 31.0), np.sin(path[:, 0] / 37.0 + 1.0)], axis=1)
    return _smoothed(path, 0.5, rounded)


def chainage(path: F64) -> F64:
    """(N,) metres from the path's start to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def smooth(path: F64) -> F64:
    """(M, 2) the path without its jitter (a Gaussian of 1.5 m), `STEP` metres a point."""
    s = chainage(path)
    moved = np.concatenate([[True], np.diff(np.floor(s / 0.2)) > 0])  # standing still is no path
    path, s = path[moved], s[moved]
    if len(path) < 2:
        raise DataError("path", "it goes nowhere", "Give one longer than a metre")
    at = np.arange(0, s[-1], STEP)
    path = _smoothed(np.stack([np.interp(at, s, path[:, k]) for k in range(2)], axis=1), STEP, 1.5)
    s = chainage(path)
    at = np.arange(0, s[-1], STEP)
    return np.stack([np.interp(at, s, path[:, k]) for k in range(2)], axis=1)


def _smoothed(path: F64, step: float, sigma: float) -> F64:
    from scipy.ndimage import gaussian_filter1d

    pad = int(4 * sigma / step) + 1  # the ends are mirrored through themselves: they stay where they are
    before, after = 2 * path[0] - path[pad:0:-1], 2 * path[-1] - path[-2 : -pad - 2 : -1]
    whole = gaussian_filter1d(np.concatenate([before, path, after]), sigma / step, axis=0)
    return whole[len(before) : len(before) + len(path)]


def extended(path: F64, length: float) -> F64:
    """(M, 2) a smooth path that goes straight on for `length` metres at both ends."""
    steps = np.arange(STEP, length + STEP / 2, STEP)[:, None]
    first, last = ((path[i] - path[j]) / np.linalg.norm(path[i] - path[j]) for i, j in ((1, 0), (-1, -2)))
    return np.concatenate([path[0] - steps[::-1] * first, path, path[-1] + steps * last])


def heading(path: F64) -> F64:
    """(N,) radians of a smooth path, counter-clockwise from x, continuous."""
    tangent = np.gradient(path, axis=0)
    return np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))


def drive(
    path: F64,
    speed: float = 12.0,
    fps: float = 15.0,
    *,
    seconds: float | None = None,
    still: float = 1.0,
    height: float = CAMERA_HEIGHT,
    sway: float = 1.0,
    seed: int = 0,
) -> Trajectory:
    """The camera's poses (camera axes x right, y down, z forward, to the world, z up) while a car drives a path.

    Args:
        path: (N, 2) metres.
        speed: m/s on straights; bends are taken with no more than 2.5 m/s2 sideways.
        fps: poses a second, the first at time 0.
        seconds: stop after so long; by default at the path's end.
        still: seconds that the car stands before it sets off.
        height: metres of the camera above the (flat) ground.
        sway: factor on the suspension's motion: 0.5 degrees of roll, 0.4 of pitch, 2 cm, below 2 Hz.
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
    roll, pitch, up = (share * SWAY[name] * _unrest(times, rng) for name in ("roll", "pitch", "height"))
    return Trajectory(times, np.column_stack([xy, height + up]), axes(angle, pitch, roll))


def _speeds(s: F64, yaw: F64, speed: float) -> tuple[F64, F64]:
    """(N,) m/s at each point, from standing, and (N,) seconds when it is reached."""
    from scipy.ndimage import gaussian_filter1d, minimum_filter1d

    bend = gaussian_filter1d(np.abs(np.gradient(yaw, s)), 1.0 / STEP)
    v = np.minimum(speed, np.sqrt(SIDEWAYS / np.maximum(bend, 1e-6)))
    v = gaussian_filter1d(minimum_filter1d(v, int(6 / STEP)), 2.0 / STEP, mode="nearest")
    v[0] = 0.0
    for i in range(1, len(v)):
        v[i] = min(v[i], np.sqrt(v[i - 1] ** 2 + 2 * FASTER * (s[i] - s[i - 1])))
    for i in range(len(v) - 2, 0, -1):
        v[i] = min(v[i], np.sqrt(v[i + 1] ** 2 + 2 * SLOWER * (s[i + 1] - s[i])))
    return v, np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[1:] + v[:-1]))])


def _unrest(times: F64, rng: np.random.Generator) -> F64:
    """(T,) smooth noise of standard deviation 1 within `BAND`."""
    frequency, phase = rng.uniform(*BAND, 12), rng.uniform(0, 2 * np.pi, 12)
    weight = 1 / frequency  # softer where faster
    weight /= np.sqrt((weight**2).sum() / 2)
    return np.sin(2 * np.pi * np.outer(times, frequency) + phase) @ weight


def axes(yaw: F64, pitch: F64, roll: F64) -> F64:
    """(T, 3, 3) camera axes to world: turned to `yaw`, nose up by `pitch`, right side down by `roll`."""
    from scipy.spatial.transform import Rotation

    c, s, none = np.cos(yaw), np.sin(yaw), 0 * yaw
    level = np.stack([np.stack([s, -c, none], 1), np.stack([none, none, none - 1], 1), np.stack([c, s, none], 1)], 2)
    return level @ Rotation.from_euler("XZ", np.column_stack([pitch, roll])).as_matrix()
