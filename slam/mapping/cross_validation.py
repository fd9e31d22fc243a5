"""Witness: which of two paths features fit better that had no say in either.

A path fits the features that it was made of; whether it is the better one, others tell (Stone, "Cross-validatory
choice and assessment of statistical predictions", 1974). Where odometry keeps all, it lets one feature in `WITNESSES`
become no point. Each is laid where a path's cameras see it best; what is left of its errors speaks against that path.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.slam import solvers
from scan2sim.slam.geometry import triangulate
from scan2sim.slam.mapping.factor_graph import Graph, errors
from scan2sim.slam.mapping.local_map import WITNESSES, LocalMap

VIEWS = 3
"""Keyframes that must see a witness."""


class Verdict(NamedTuple):
    """What witnesses say: how many they are; by which share their cost (Cauchy's) is lower for the second path."""

    witnesses: int
    gain: float

    @property
    def better(self) -> bool:
        """Whether the second path fits better."""
        return self.gain > 0


def judge(found: LocalMap, first: F64, second: F64) -> Verdict:
    """What the witnesses of an odometry that was told to `keep` say of two paths (C, 4, 4) of its keyframes."""
    which = list(range(len(found.keyframes)))
    seen = found.observations(which)
    seen = seen.keep(seen.ids % WITNESSES == 0)
    names, rows, counts = np.unique(seen.ids, return_inverse=True, return_counts=True)
    seen, names = seen.keep(counts[rows] >= VIEWS), names[counts >= VIEWS]
    if not len(names):
        return Verdict(0, 0.0)
    still = found.graph(which, seen, names, np.zeros((len(names), 3)), np.ones(len(which), bool))
    before, after = (_errors(replace(still, poses=poses)) for poses in (first, second))
    sure = np.isfinite(before) & np.isfinite(after)
    sure = np.bincount(still.point_of, ~sure, minlength=len(names))[still.point_of] == 0
    before, after = before[sure], after[sure]
    if not len(before):
        return Verdict(0, 0.0)
    sigma = max(float(np.median(np.minimum(before, after))), 1e-3 * found.sigma)
    costs = [float(np.log1p((error / sigma) ** 2).sum()) for error in (before, after)]
    return Verdict(len(np.unique(still.point_of[sure])), 1 - costs[1] / costs[0])


def _errors(graph: Graph) -> F64:
    """(O,) radians of observations of points that lie where a graph's cameras see them best; NaN: nowhere."""
    return errors(graph, graph.poses, laid(graph), graph.shared)


def laid(graph: Graph) -> F64:
    """(P, 3) points where a graph's cameras, which stay, see them best; NaN: nowhere."""
    graph = replace(graph, fixed=np.ones(len(graph.poses), bool), shared_sigma=np.full(len(graph.shared), 1e-9))
    starts = np.searchsorted(graph.point_of, np.arange(len(graph.points) + 1))
    xyz, _ = triangulate(graph.poses, starts, graph.camera_of, graph.bearing)
    known = np.isfinite(xyz[:, :1])
    solved = solvers.named("lm").solve(replace(graph, points=np.where(known, xyz, 1e3)))
    return np.where(known, solved.points, np.nan)
