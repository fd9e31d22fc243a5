"""Hills: a smooth height field by which a flat town is sheared vertically, so that walls stay upright."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.data_samples.paths import chainage, smooth
from scan2sim.pipeline.core.types import F64, Trajectory

FLAT: F64 = np.zeros((0, 4))
WAVELENGTHS_M = (110.0, 150.0, 190.0, 240.0)
"""Wavelengths of the waves that hills consist of; all have the same slope."""


def draw(path: F64, steepest: float, seed: int) -> F64:
    """Random hills: (K, 4) waves with amplitude in metres, wave vector in radians per metre (x, y), and phase.

    Args:
        path: (N, 2) metres, along which the maximum slope is `steepest`.
        steepest: maximum slope, metres per metre; 0: flat.
        seed: seed of the random numbers.
    """
    if not steepest:
        return FLAT
    rng, k = np.random.default_rng([seed, 51]), 2 * np.pi / np.array(WAVELENGTHS_M)
    way = rng.uniform(0, 2 * np.pi) + np.pi / len(k) * np.arange(len(k))
    waves = np.column_stack([1 / k, k * np.cos(way), k * np.sin(way), rng.uniform(0, 2 * np.pi, len(k))])
    driven = smooth(path)
    slopes = np.diff(heights(driven, waves)) / np.diff(chainage(driven))
    waves[:, 0] *= steepest / np.abs(slopes).max()
    return waves


def heights(xy: npt.ArrayLike, waves: F64) -> F64:
    """(...) height of the ground at positions (..., 2), metres."""
    return np.sin(np.asarray(xy) @ waves[:, 1:3].T + waves[:, 3]) @ waves[:, 0]


def slopes(xy: npt.ArrayLike, waves: F64) -> F64:
    """(..., 2) slope of the ground towards x and y, metres per metre."""
    return (np.cos(np.asarray(xy) @ waves[:, 1:3].T + waves[:, 3]) * waves[:, 0]) @ waves[:, 1:3]


def relative_waves(waves: F64, centre: F64) -> F64:
    """Waves in coordinates relative to `centre` (2,)."""
    local = waves.copy()
    local[:, 3] += waves[:, 1:3] @ centre
    return local


def lifted(flat: Trajectory, waves: F64) -> Trajectory:
    """Trajectory on flat ground moved onto hills: raised, and tilted like the ground."""
    from scipy.spatial.transform import Rotation

    assert flat.rotations is not None
    xy, raised = flat.positions[:, :2], flat.positions.copy()
    raised[:, 2] += heights(xy, waves)
    slope = slopes(xy, waves)
    steep = np.linalg.norm(slope, axis=1, keepdims=True)
    level = np.column_stack([slope[:, 1], -slope[:, 0], 0 * steep])  # rotation axis from up to the ground's normal
    tilt = Rotation.from_rotvec(level * np.arctan(steep) / np.maximum(steep, 1e-12))
    return replace(flat, positions=raised, rotations=tilt.as_matrix() @ flat.rotations)


@njit(cache=True, error_model="numpy")
def ground_height(x: float, y: float, waves: npt.NDArray[Any]) -> tuple[float, float, float]:
    """Height of the ground at a position, and its slopes towards x and y; compiled."""
    z, to_x, to_y = 0.0, 0.0, 0.0
    for k in range(len(waves)):
        angle = waves[k, 1] * x + waves[k, 2] * y + waves[k, 3]
        z += waves[k, 0] * math.sin(angle)
        c = waves[k, 0] * math.cos(angle)
        to_x += c * waves[k, 1]
        to_y += c * waves[k, 2]
    return z, to_x, to_y


@njit(cache=True, error_model="numpy")
def ground_intersection(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, far: float, waves: npt.NDArray[Any]
) -> tuple[float, float]:
    """Distance along a ray to the ground, and the speed of approach there (metres per metre), by ray marching.

    Steps are as long as the maximum slope allows; the last one is a Newton step. Returns `far` if the ray doesn't reach
    the ground before.
    """
    steepest = 0.0
    for k in range(len(waves)):
        steepest += abs(waves[k, 0]) * math.sqrt(waves[k, 1] ** 2 + waves[k, 2] ** 2)
    fastest = steepest * math.sqrt(dx * dx + dy * dy) - dz
    if fastest <= 0:
        return far, 1.0
    s = 0.0
    for _ in range(MARCH_STEPS_MAX):
        z, to_x, to_y = ground_height(ox + s * dx, oy + s * dy, waves)
        gap, nears = oz + s * dz - z, to_x * dx + to_y * dy - dz
        if gap < NEWTON_GAP_M and nears > 0:
            return s + gap / nears, nears
        s += max(gap, NEWTON_GAP_M / 2) / fastest
        if s >= far:
            return far, 1.0
    return far, 1.0


MARCH_STEPS_MAX, NEWTON_GAP_M = 96, 0.02
"""Maximum number of steps; height above the ground below which a Newton step finishes."""
