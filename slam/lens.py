"""Lens: whether the focal length that a camera is said to have fits what it sees, and which would fit better.

Where the car turns, a wrong focal length contradicts itself: what crosses the picture turns by more, or less, than the
picture says. A window's graph is solved again with the focal length as one number more. Straight ahead it is hardly
told apart from what Lucas-Kanade's own small errors do, so only windows that turn are asked.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2sim.slam.geometry import log_so3
from scan2sim.slam.graph import Graph
from scan2sim.slam.solvers import lm

TURN = np.radians(30)
"""Between the first and the last camera of a window that is asked."""
LIKELY = 0.1
"""Of the focal length, by which it may well be wrong."""
WORTH = 0.02
"""Of the focal length, from which on a user is told."""


def misfit(graph: Graph) -> float | None:
    """By which share the focal length of a graph's camera is too short; None where it turns too little to tell."""
    first, last = graph.poses[0, :3, :3], graph.poses[-1, :3, :3]
    if np.linalg.norm(log_so3(first.T @ last)) < TURN:
        return None
    R = graph.poses[graph.camera_of, :3, :3]
    bend = np.zeros((len(graph.bearing), 1, 6))
    towards = np.cross(graph.bearing, [0.0, 0.0, 1.0]) * graph.bearing[:, 2:]  # a longer one sees nearer the axis
    bend[:, 0, 3:] = np.einsum("oij,oj->oi", R, towards)
    free = replace(
        graph, bend=bend, shared=np.zeros(1), shared_sigma=np.array([LIKELY]), fixed=np.arange(len(graph.poses)) < 1
    )
    return float(lm.solve(free, iterations=15).shared[0])


def told(shares: list[float], focal: float) -> str | None:
    """What a user should read of the windows' misfits; nothing where the focal length (pixels) fits."""
    if not shares or abs(share := float(np.median(shares))) < WORTH:
        return None
    return (
        f"in turns, the pictures fit a focal length of {focal * (1 + share):.0f} pixels better than {focal:.0f}: "
        "check --focal, and whether the pictures were cropped or scaled"
    )
