"""Slow rendering of splats, one after the other over the whole image, in 64 bits: the formulas of the literature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64, Camera

LOW_PASS, MAX_ALPHA, MAX_DEVIATION, MIN_COS, HALF = 0.3, 0.99, 0.2, 0.01, 0.5


@dataclass(frozen=True)
class Drawn:
    """Images (H, W).

    Attributes:
        colour: (H, W, 3) times alpha.
        deviation: relative deviation of the inverse depth from the known one, times alpha; 0 where none is known.
        depth: metres to where half of the light is stopped, inf where more is left.
        transmittance: what is left.
    """

    colour: F64
    deviation: F64
    depth: F64
    transmittance: F64


def render(
    parameters: F64, camera: Camera, T_world_cam: F64, least: float = 0, base: F64 | None = None,
    known: F64 | None = None,
) -> Drawn:  # fmt: skip
    """Render splats (N, 14).

    A splat has no effect on pixels where its alpha is below `least`. `known` (H, W) are known depths, metres, or 0.
    With `base`, the parameters (N, 14) without a small change, these pixels, and the slope of the inverse depth within
    a splat, and its limits, are those of `base`: gradients don't contain their changes.
    """
    T = np.asarray(np.linalg.inv(T_world_cam), np.float64)
    shape = camera.height, camera.width
    colour, deviation, through = np.zeros((*shape, 3)), np.zeros(shape), np.ones(shape)
    depth = np.full(shape, np.inf)
    expected = np.zeros(shape) if known is None else known
    distance = (parameters[:, :3] @ T[:3, :3].T + T[:3, 3])[:, 2]
    for i in np.argsort(distance, kind="stable"):
        if distance[i] < 0.2:
            continue
        same = parameters[i] if base is None else base[i]
        alpha = np.where(_alpha(same, camera, T) < least, 0, _alpha(parameters[i], camera, T))
        inverse = _inverse_depth(parameters[i], same, camera, T)
        weight = alpha * through
        colour += weight[..., None] * parameters[i, 11:14]
        deviation += weight * np.minimum(np.abs(inverse * expected - 1), MAX_DEVIATION) * (expected > 0)
        crossed = (through > HALF) & (through - weight <= HALF)
        depth[crossed] = 1 / inverse[crossed]
        through = through - weight
    return Drawn(colour, deviation, depth, through)


def _offsets(parameters: F64, camera: Camera, T_cam_world: F64) -> F64:
    """(H, W, 2) pixels from a splat's centre in the image."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y, z = T_cam_world[:3, :3] @ parameters[:3] + T_cam_world[:3, 3]
    return np.stack([u - (camera.fx * x / z + camera.cx), v - (camera.fy * y / z + camera.cy)], axis=-1)


def _axes(parameters: F64, T_cam_world: F64) -> F64:
    """(3, 3) axes of a splat in columns, in camera axes."""
    return np.asarray(T_cam_world[:3, :3] @ Rotation.from_quat(parameters[[7, 8, 9, 6]]).as_matrix())


def _alpha(parameters: F64, camera: Camera, T_cam_world: F64) -> F64:
    """(H, W) alpha of a splat (14,)."""
    cx, cy, z = T_cam_world[:3, :3] @ parameters[:3] + T_cam_world[:3, 3]
    J = np.array([[camera.fx / z, 0, -camera.fx * cx / z**2], [0, camera.fy / z, -camera.fy * cy / z**2]])
    M = J @ (_axes(parameters, T_cam_world) * np.exp(parameters[3:6]))
    inverse = np.linalg.inv(M @ M.T + LOW_PASS * np.eye(2))
    d = _offsets(parameters, camera, T_cam_world)
    square = np.einsum("hwi,ij,hwj->hw", d, inverse, d)
    return np.asarray(np.minimum(np.exp(-square / 2) / (1 + np.exp(-parameters[10])), MAX_ALPHA))


def _inverse_depth(parameters: F64, base: F64, camera: Camera, T_cam_world: F64) -> F64:
    """(H, W) inverse depth of a splat (14,): that of the plane n r = n c through its centre c, where it is flat.

    n is its shortest axis; the ray through a pixel is r = (x / z, y / z, 1). Slope and limits are those of `base`.
    """
    centre = T_cam_world[:3, :3] @ base[:3] + T_cam_world[:3, 3]
    shortest, middle, _ = np.argsort(base[3:6])
    normal = _axes(base, T_cam_world)[:, shortest]
    roundness = np.exp(base[3 + shortest] - base[3 + middle]) ** 4
    along = normal @ centre
    factor = (1 - roundness) * along / (along**2 + MIN_COS**2 * (centre @ centre))
    slope = factor * normal[:2] / (camera.fx, camera.fy)
    z = (T_cam_world[:3, :3] @ parameters[:3] + T_cam_world[:3, 3])[2]
    here = 1 / z + _offsets(parameters, camera, T_cam_world) @ slope
    return np.clip(here, 0.5 / centre[2], 1.5 / centre[2])
