"""Slow rendering of splats, one after the other over the whole image, in 64 bits: the formulas of the literature."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64, Camera

LOW_PASS, MAX_ALPHA = 0.3, 0.99


def render(
    parameters: F64, camera: Camera, T_world_cam: F64, least: float = 0, cut_by: F64 | None = None
) -> tuple[F64, F64, F64]:
    """Colour times alpha (H, W, 3), depth times alpha (H, W) and transmittance (H, W) of splats (N, 14).

    A splat has no effect on pixels where its alpha is below `least`, with the parameters `cut_by`, if given.
    """
    T = np.asarray(np.linalg.inv(T_world_cam), np.float64)
    shape = camera.height, camera.width
    colour, depth, through = np.zeros((*shape, 3)), np.zeros(shape), np.ones(shape)
    distance = (parameters[:, :3] @ T[:3, :3].T + T[:3, 3])[:, 2]
    for i in np.argsort(distance, kind="stable"):
        if distance[i] < 0.2:
            continue
        alpha = _alpha(parameters[i], camera, T)
        alpha[(alpha if cut_by is None else _alpha(cut_by[i], camera, T)) < least] = 0
        weight = alpha * through
        colour += weight[..., None] * parameters[i, 11:14]
        depth += weight * distance[i]
        through = through - weight
    return colour, depth, through


def _alpha(parameters: F64, camera: Camera, T_cam_world: F64) -> F64:
    """(H, W) alpha of a splat (14,)."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    cx, cy, z = T_cam_world[:3, :3] @ parameters[:3] + T_cam_world[:3, 3]
    axes = Rotation.from_quat(parameters[[7, 8, 9, 6]]).as_matrix() * np.exp(parameters[3:6])
    J = np.array([[camera.fx / z, 0, -camera.fx * cx / z**2], [0, camera.fy / z, -camera.fy * cy / z**2]])
    M = J @ T_cam_world[:3, :3] @ axes
    inverse = np.linalg.inv(M @ M.T + LOW_PASS * np.eye(2))
    d = np.stack([x - (camera.fx * cx / z + camera.cx), y - (camera.fy * cy / z + camera.cy)], axis=-1)
    square = np.einsum("hwi,ij,hwj->hw", d, inverse, d)
    return np.asarray(np.minimum(np.exp(-square / 2) / (1 + np.exp(-parameters[10])), MAX_ALPHA))
