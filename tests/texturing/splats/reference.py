"""Slow rendering of splats, one after the other over the whole image, in 64 bits: the formulas of the literature."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64, Camera

LOW_PASS, MAX_ALPHA, MAX_DEVIATION = 0.3, 0.99, 0.2


def render(
    parameters: F64, camera: Camera, T_world_cam: F64, least: float = 0, base: F64 | None = None,
    known: F64 | None = None,
) -> tuple[F64, F64, F64]:  # fmt: skip
    """Colour times alpha (H, W, 3), depth times alpha (H, W) and transmittance (H, W) of splats (N, 14).

    A splat has no effect on pixels where its alpha is below `least`. Where `known` (H, W) is more than 0, the depth is
    its relative deviation from that. With `base`, the parameters (N, 14) without a small change, these pixels, and how
    the depth changes within a splat, are those of `base`: gradients don't contain their changes.
    """
    T = np.asarray(np.linalg.inv(T_world_cam), np.float64)
    shape = camera.height, camera.width
    colour, depth, through = np.zeros((*shape, 3)), np.zeros(shape), np.ones(shape)
    expected = np.zeros(shape) if known is None else known
    distance = (parameters[:, :3] @ T[:3, :3].T + T[:3, 3])[:, 2]
    for i in np.argsort(distance, kind="stable"):
        if distance[i] < 0.2:
            continue
        alpha, before = _alpha(parameters[i], camera, T)
        same, nearer = (alpha, before) if base is None else _alpha(base[i], camera, T)
        alpha = np.where(same < least, 0, alpha)
        z = distance[i] + nearer
        deviation = np.minimum(np.abs(z - expected) / np.maximum(expected, 0.2), MAX_DEVIATION)
        weight = alpha * through
        colour += weight[..., None] * parameters[i, 11:14]
        depth += weight * np.where(expected > 0, deviation, z)
        through = through - weight
    return colour, depth, through


def _alpha(parameters: F64, camera: Camera, T_cam_world: F64) -> tuple[F64, F64]:
    """(H, W) alpha of a splat (14,), and by how much its depth there is more than in its centre, metres.

    The latter is the mean of the splat's depth along the pixel's ray: a Gaussian's conditional expectation.
    """
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    cx, cy, z = T_cam_world[:3, :3] @ parameters[:3] + T_cam_world[:3, 3]
    axes = T_cam_world[:3, :3] @ Rotation.from_quat(parameters[[7, 8, 9, 6]]).as_matrix() * np.exp(parameters[3:6])
    J = np.array([[camera.fx / z, 0, -camera.fx * cx / z**2], [0, camera.fy / z, -camera.fy * cy / z**2]])
    M = J @ axes
    inverse = np.linalg.inv(M @ M.T + LOW_PASS * np.eye(2))
    d = np.stack([x - (camera.fx * cx / z + camera.cx), y - (camera.fy * cy / z + camera.cy)], axis=-1)
    square = np.einsum("hwi,ij,hwj->hw", d, inverse, d)
    alpha = np.asarray(np.minimum(np.exp(-square / 2) / (1 + np.exp(-parameters[10])), MAX_ALPHA))
    return alpha, np.asarray(d @ (inverse @ M @ axes[2]))
