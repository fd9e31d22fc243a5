"""Optimizer of D3.2 (section 4.1), for comparison: automatic differentiation and Adam, by torch.

The error of an observation is the norm of the cross product of observed and predicted direction; it enters linearly
(L1), so that outliers have little influence. Adjacent distances from GPS enter squared, with a very low weight. A
camera is its position and three rotation angles. A camera's pose takes 20 iterations, a window 180. Uses a GPU if there
is one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.slam.factor_graph import Graph, Solution
from scan2sim.slam.geometry import exp_so3

NEEDS = ("torch",)
POSE_ITERATIONS, WINDOW_ITERATIONS = 20, 180
LEARNING_RATE_M = 0.02
"""Initial learning rate of positions, metres; of rotations a tenth of it, radians. D3.2 gives none."""
GPS_WEIGHT = 1e-3
"""Weight of a squared distance error in metres, relative to radians (D3.2: very low)."""


def solve(graph: Graph, *, iterations: int | None = None, points: bool = True) -> Solution:
    """See `slam.solvers.Solver`; shared parameters aren't optimized."""
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"

    def tensor(values: Any, kind: Any = torch.float64) -> Any:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=kind, device=device)

    free = tensor(~graph.fixed, torch.float64)[:, None]
    R0, t0, X0 = tensor(graph.poses[:, :3, :3]), tensor(graph.poses[:, :3, 3]), tensor(graph.points)
    seen, camera = tensor(graph.bearing), tensor(graph.camera_of, torch.long)
    point = tensor(graph.point_of, torch.long)
    first, second = (tensor([getattr(c, end) for c in graph.distances], torch.long) for end in ("first", "second"))
    distance = tensor([c.distance for c in graph.distances])
    measured = [tensor(f.measured) for f in graph.factors]
    move = torch.zeros_like(t0, requires_grad=True)
    angles = torch.zeros_like(t0, requires_grad=True)
    shift = torch.zeros_like(X0, requires_grad=points)
    groups = [{"params": [move], "lr": LEARNING_RATE_M}, {"params": [angles], "lr": 0.1 * LEARNING_RATE_M}]
    if points:
        groups.append({"params": [shift], "lr": LEARNING_RATE_M})
    adam = torch.optim.Adam(groups)
    count = iterations or (WINDOW_ITERATIONS if points else POSE_ITERATIONS)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, count, eta_min=0.02 * LEARNING_RATE_M)
    for _ in range(count):
        adam.zero_grad()
        t, R, X = t0 + free * move, _rotations(free * angles) @ R0, X0 + shift
        direction = ((X[point] - t[camera])[:, :, None] * R[camera]).sum(dim=1)
        direction = direction / direction.norm(dim=1, keepdim=True).clamp(min=1e-9)
        loss = torch.linalg.cross(seen, direction).norm(dim=1).sum()
        lengths = (t[second] - t[first]).norm(dim=1)
        loss = loss + GPS_WEIGHT * ((lengths - distance) ** 2).sum()
        for factor, value in zip(graph.factors, measured, strict=True):
            involved = [_pose(R[c], t[c]) for c in factor.cameras]
            loss = loss + graph.sigma * (factor.residual(*involved, value) ** 2).sum()
        loss.backward()
        adam.step()
        schedule.step()
    rotation = exp_so3((free * angles).detach().cpu().numpy())
    poses = graph.poses.copy()
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    poses[:, :3, 3] += (free * move).detach().cpu().numpy()
    return Solution(poses, graph.points + shift.detach().cpu().numpy(), graph.shared)


def _rotations(w: Any) -> Any:
    """(C, 3, 3) rotation matrices of rotation vectors (C, 3), by Rodrigues' formula."""
    import torch

    angle = w.square().sum(dim=1).clamp(min=1e-16).sqrt()[:, None, None]
    zero = torch.zeros_like(w[:, 0])
    x, y, z = w.unbind(1)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    return (
        torch.eye(3, dtype=w.dtype, device=w.device) + angle.sin() / angle * K + (1 - angle.cos()) / angle**2 * (K @ K)
    )


def _pose(R: Any, t: Any) -> Any:
    import torch

    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=R.dtype, device=R.device)
    return torch.cat([torch.cat([R, t[:, None]], dim=1), last])
