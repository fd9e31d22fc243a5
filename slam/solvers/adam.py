"""The mission's optimiser (D3.2, section 4.1): torch's automatic differentiation and Adam, to compare with.

The error of an observation is the length of the cross product of seen and estimated direction, linear in it, so that
outliers weigh little; adjacent distances from GPS enter squared, with a very low weight. A camera is its position and
three rotation angles. 20 iterations place a camera, 180 move a window. Runs on a GPU where there is one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.mapping.factor_graph import Graph, Solution

NEEDS = ("torch",)
POSE_ITERATIONS, WINDOW_ITERATIONS = 20, 180
RATE = 0.02
"""Metres of a first step (D3.2 names none); radians are a tenth of it."""
GPS_WEIGHT = 1e-3
"""Of a squared distance in metres, against radians (D3.2: very low)."""


def solve(graph: Graph, *, iterations: int | None = None, points: bool = True) -> Solution:
    """See `slam.solvers.Solver`; shared parameters are left as they are."""
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"

    def tensor(values: Any, kind: Any = torch.float64) -> Any:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=kind, device=device)

    free = tensor(~graph.fixed, torch.float64)[:, None]
    R0, t0, X0 = tensor(graph.poses[:, :3, :3]), tensor(graph.poses[:, :3, 3]), tensor(graph.points)
    seen, camera = tensor(graph.bearing), tensor(graph.camera_of, torch.long)
    point = tensor(graph.point_of, torch.long)
    first, second = (tensor([getattr(c, end) for c in graph.chords], torch.long) for end in ("first", "second"))
    distance = tensor([c.distance for c in graph.chords])
    measured = [tensor(f.measured) for f in graph.factors]
    move = torch.zeros_like(t0, requires_grad=True)
    angles = torch.zeros_like(t0, requires_grad=True)
    shift = torch.zeros_like(X0, requires_grad=points)
    groups = [{"params": [move], "lr": RATE}, {"params": [angles], "lr": 0.1 * RATE}]
    if points:
        groups.append({"params": [shift], "lr": RATE})
    adam = torch.optim.Adam(groups)
    count = iterations or (WINDOW_ITERATIONS if points else POSE_ITERATIONS)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, count, eta_min=0.02 * RATE)
    for _ in range(count):
        adam.zero_grad()
        t, R, X = t0 + free * move, _rotations(free * angles) @ R0, X0 + shift
        direction = ((X[point] - t[camera])[:, :, None] * R[camera]).sum(dim=1)
        direction = direction / direction.norm(dim=1, keepdim=True).clamp(min=1e-9)
        loss = torch.linalg.cross(seen, direction).norm(dim=1).sum()
        lengths = (t[second] - t[first]).norm(dim=1)
        loss = loss + GPS_WEIGHT * ((lengths - distance) ** 2).sum()
        for factor, value in zip(graph.factors, measured, strict=True):
            mine = [_pose(R[c], t[c]) for c in factor.cameras]
            loss = loss + graph.sigma * (factor.residual(*mine, value) ** 2).sum()
        loss.backward()
        adam.step()
        schedule.step()
    turned = exp_so3((free * angles).detach().cpu().numpy())
    poses = graph.poses.copy()
    poses[:, :3, :3] = turned @ poses[:, :3, :3]
    poses[:, :3, 3] += (free * move).detach().cpu().numpy()
    return Solution(poses, graph.points + shift.detach().cpu().numpy(), graph.shared)


def _rotations(w: Any) -> Any:
    """(C, 3, 3) rotations of rotation vectors (C, 3): Rodrigues' formula."""
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
