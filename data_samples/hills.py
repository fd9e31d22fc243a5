"""Hills: a smooth height of the ground, by which a flat town is sheared upwards; its walls stay upright."""

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
LENGTHS = (110.0, 150.0, 190.0, 240.0)
"""Metres of the waves that hills are made of; each is as steep as the others."""


def draw(path: F64, steepest: float, seed: int) -> F64:
    """(K, 4) waves: amplitude in metres, wave vector in radians a metre (x, y), phase.

    Args:
        path: (N, 2) metres, along which the ground is as steep as `steepest` at one place, and nowhere steeper.
        steepest: metres of climb a metre of way; 0: flat.
        seed: of where the hills are.
    """
    if not steepest:
        return FLAT
    rng, k = np.random.default_rng([seed, 51]), 2 * np.pi / np.array(LENGTHS)
    way = rng.uniform(0, 2 * np.pi) + np.pi / len(k) * np.arange(len(k))
    waves = np.column_stack([1 / k, k * np.cos(way), k * np.sin(way), rng.uniform(0, 2 * np.pi, len(k))])
    driven = smooth(path)
    slopes = np.diff(heights(driven, waves)) / np.diff(chainage(driven))
    waves[:, 0] *= steepest / np.abs(slopes).max()
    return waves


def heights(xy: npt.ArrayLike, waves: F64) -> F64:
    """(...) metres of the ground at (..., 2)."""
    return np.sin(np.asarray(xy) @ waves[:, 1:3].T + waves[:, 3]) @ waves[:, 0]


def slopes(xy: npt.ArrayLike, waves: F64) -> F64:
    """(..., 2) metres of climb a metre towards x, and y."""
    return (np.cos(np.asarray(xy) @ waves[:, 1:3].T + waves[:, 3]) * waves[:, 0]) @ waves[:, 1:3]


def seen_from(waves: F64, centre: F64) -> F64:
    """The waves in coordinates relative to `centre` (2,)."""
    local = waves.copy()
    local[:, 3] += waves[:, 1:3] @ centre
    return local


def lifted(flat: Trajectory, waves: F64) -> Trajectory:
    """A drive on flat ground, now on hills: raised, and tilted as the ground is."""
    from scipy.spatial.transform import Rotation

    assert flat.rotations is not None
    xy, places = flat.positions[:, :2], flat.positions.copy()
    places[:, 2] += heights(xy, waves)
    slope = slopes(xy, waves)
    steep = np.linalg.norm(slope, axis=1, keepdims=True)
    level = np.column_stack([slope[:, 1], -slope[:, 0], 0 * steep])  # about it, upwards turns to the ground's normal
    tilt = Rotation.from_rotvec(level * np.arctan(steep) / np.maximum(steep, 1e-12))
    return replace(flat, positions=places, rotations=tilt.as_matrix() @ flat.rotations)


@njit(cache=True, error_model="numpy")
def rise(x: float, y: float, waves: npt.NDArray[Any]) -> tuple[float, float, float]:
    """Height of the ground at a place, and its slopes towards x and y; compiled."""
    z, to_x, to_y = 0.0, 0.0, 0.0
    for k in range(len(waves)):
        angle = waves[k, 1] * x + waves[k, 2] * y + waves[k, 3]
        z += waves[k, 0] * math.sin(angle)
        c = waves[k, 0] * math.cos(angle)
        to_x += c * waves[k, 1]
        to_y += c * waves[k, 2]
    return z, to_x, to_y


@njit(cache=True, error_model="numpy")
def reach(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, far: float, waves: npt.NDArray[Any]
) -> tuple[float, float]:
    """Metres along a ray until it is at the ground's height, and by how much it nears it there, a metre.

    Steps are as long as the steepest ground allows; then one of Newton's. A ray that doesn't come there within `far`
    gets `far`.
    """
    steepest = 0.0
    for k in range(len(waves)):
        steepest += abs(waves[k, 0]) * math.sqrt(waves[k, 1] ** 2 + waves[k, 2] ** 2)
    fastest = steepest * math.sqrt(dx * dx + dy * dy) - dz
    if fastest <= 0:
        return far, 1.0
    s = 0.0
    for _ in range(STEPS):
        z, to_x, to_y = rise(ox + s * dx, oy + s * dy, waves)
        gap, nears = oz + s * dz - z, to_x * dx + to_y * dy - dz
        if gap < NEAR and nears > 0:
            return s + gap / nears, nears
        s += max(gap, NEAR / 2) / fastest
        if s >= far:
            return far, 1.0
    return far, 1.0


STEPS, NEAR = 96, 0.02
"""At most so many steps; metres above the ground from which Newton's does."""
