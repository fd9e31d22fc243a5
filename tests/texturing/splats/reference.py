"""Slow rendering of splats, one after the other over the whole image, in 64 bits: the formulas of the literature."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64, Camera

LOW_PASS, MAX_ALPHA = 0.3, 0.99


def render(parameters: F64, camera: Camera, T_world_cam: F64) -> tuple[F64, F64, F64]:
    """Colour times alpha (H, W, 3), depth times alpha (H, W) and transmittance (H, W) of splats (N, 14)."""
    T = np.linalg.inv(T_world_cam)
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    colour, depth, through = np.zeros((*x.shape, 3)), np.zeros(x.shape), np.ones(x.shape)
    centres = parameters[:, :3] @ T[:3, :3].T + T[:3, 3]
    for i in np.argsort(centres[:, 2], kind="stable"):
        cx, cy, z = centres[i]
        if z < 0.2:
            continue
        w = parameters[i, 6:10]
        axes = Rotation.from_quat(w[[1, 2, 3, 0]]).as_matrix() * np.exp(parameters[i, 3:6])
        J = np.array([[camera.fx / z, 0, -camera.fx * cx / z**2], [0, camera.fy / z, -camera.fy * cy / z**2]])
        M = J @ T[:3, :3] @ axes
        inverse = np.linalg.inv(M @ M.T + LOW_PASS * np.eye(2))
        d = np.stack([x - (camera.fx * cx / z + camera.cx), y - (camera.fy * cy / z + camera.cy)], axis=-1)
        square = np.einsum("hwi,ij,hwj->hw", d, inverse, d)
        alpha = np.minimum(np.exp(-square / 2) / (1 + np.exp(-parameters[i, 10])), MAX_ALPHA)
        weight = alpha * through
        colour += weight[..., None] * parameters[i, 11:14]
        depth += weight * z
        through = through - weight
    return colour, depth, through
