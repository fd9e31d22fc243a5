"""Cross-validation: which of two paths fits held-out observations better.

A path fits the features that it was estimated from; only held-out features show whether it is the better one (Stone,
"Cross-validatory choice and assessment of statistical predictions", 1974). With `keep`, odometry holds out one feature
in `HELD_OUT_EVERY`: it never becomes a map point. Each held-out feature is triangulated by a path's cameras; its
remaining reprojection error is that path's cost.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.slam import solvers
from scan2sim.slam.factor_graph import Graph, errors
from scan2sim.slam.geometry import triangulate
from scan2sim.slam.mapping.local_map import HELD_OUT_EVERY, LocalMap

OBSERVATIONS_MIN = 3
"""Keyframes that must observe a held-out feature."""


class Comparison(NamedTuple):
    """Result of a cross-validation.

    Attributes:
        held_out: number of held-out features compared.
        gain: share by which their Cauchy cost is lower for the second path; negative: higher.
    """

    held_out: int
    gain: float

    @property
    def second_is_better(self) -> bool:
        """Whether the second path fits the held-out features better."""
        return self.gain > 0


def compare_paths(local_map: LocalMap, first: F64, second: F64) -> Comparison:
    """Compare two paths (C, 4, 4) of a map's keyframes by the held-out features; the map was built with `keep`."""
    which = list(range(len(local_map.keyframes)))
    seen = local_map.observations(which)
    seen = seen.keep(seen.ids % HELD_OUT_EVERY == 0)
    ids, rows, counts = np.unique(seen.ids, return_inverse=True, return_counts=True)
    seen, ids = seen.keep(counts[rows] >= OBSERVATIONS_MIN), ids[counts >= OBSERVATIONS_MIN]
    if not len(ids):
        return Comparison(0, 0.0)
    graph = local_map.graph(which, seen, ids, np.zeros((len(ids), 3)), np.ones(len(which), bool))
    before, after = (_errors(replace(graph, poses=poses)) for poses in (first, second))
    valid = np.isfinite(before) & np.isfinite(after)
    valid = np.bincount(graph.point_of, ~valid, minlength=len(ids))[graph.point_of] == 0
    before, after = before[valid], after[valid]
    if not len(before):
        return Comparison(0, 0.0)
    sigma = max(float(np.median(np.minimum(before, after))), 1e-3 * local_map.sigma)
    costs = [float(np.log1p((error / sigma) ** 2).sum()) for error in (before, after)]
    return Comparison(len(np.unique(graph.point_of[valid])), 1 - costs[1] / costs[0])


def _errors(graph: Graph) -> F64:
    """(O,) reprojection errors, radians, of points triangulated by a graph's fixed cameras; NaN: no intersection."""
    return errors(graph, graph.poses, points_by_fixed_cameras(graph), graph.shared)


def points_by_fixed_cameras(graph: Graph) -> F64:
    """(P, 3) points with the least reprojection error in a graph's cameras, which stay fixed; NaN: no intersection."""
    graph = replace(graph, fixed=np.ones(len(graph.poses), bool), shared_sigma=np.full(len(graph.shared), 1e-9))
    starts = np.searchsorted(graph.point_of, np.arange(len(graph.points) + 1))
    xyz, _ = triangulate(graph.poses, starts, graph.camera_of, graph.bearing)
    known = np.isfinite(xyz[:, :1])
    solved = solvers.named("lm").solve(replace(graph, points=np.where(known, xyz, 1e3)))
    return np.where(known, solved.points, np.nan)
