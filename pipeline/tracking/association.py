"""Association: clusters of points of each sweep to the objects of the sweeps before (Kuhn, 1955, on predictions)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.pipeline.tracking import kalman

ACCELERATION_MPS2 = 4.0
"""Standard deviation of accelerations between sweeps, with those that a change of the visible sides feigns."""
CENTROID_SIGMA_M = 0.4
"""Standard deviation of the centroid of a cluster, which moves as other sides come into view."""
GATE = 16.0
"""Largest squared Mahalanobis distance of a cluster from its prediction: four standard deviations."""
LOST_S = 0.55
"""Seconds without a cluster after which an object is lost: five sweeps."""


@dataclass(frozen=True)
class Cluster:
    """Points of an object in one sweep.

    Attributes:
        sweep: number of the sweep.
        index: (N,) its points.
        time: mean time of its points, seconds.
        centroid: (2,) mean of its occupied cells, local metres.
    """

    sweep: int
    index: I64
    time: float
    centroid: F64


@dataclass
class Hypothesis:
    """An object that is followed: its clusters, and the state at the time of the last one."""

    state: kalman.State
    clusters: list[Cluster] = field(default_factory=list)

    def predicted(self, time: float) -> kalman.State:
        """State at `time`."""
        return kalman.predict(self.state, time - self.clusters[-1].time, ACCELERATION_MPS2)


def associate(sweeps: Sequence[Sequence[Cluster]]) -> list[list[Cluster]]:
    """Clusters of each object in order of time; `sweeps`: the clusters of each sweep, in order of time."""
    noise = np.eye(2) * CENTROID_SIGMA_M**2
    alive: list[Hypothesis] = []
    lost: list[Hypothesis] = []
    for found in sweeps:
        if not found:
            continue
        now = min(cluster.time for cluster in found)
        lost += [one for one in alive if now - one.clusters[-1].time > LOST_S]
        alive = [one for one in alive if now - one.clusters[-1].time <= LOST_S]
        cost = np.array([[_cost(one, cluster) for cluster in found] for one in alive]).reshape(len(alive), len(found))
        rows, columns = linear_sum_assignment(np.minimum(cost, 1e6))
        taken = set()
        for row, column in zip(rows, columns, strict=True):
            if not np.isfinite(cost[row, column]):
                continue
            cluster = found[column]
            alive[row].state = kalman.update(alive[row].predicted(cluster.time), cluster.centroid, noise)
            alive[row].clusters.append(cluster)
            taken.add(column)
        for column, cluster in enumerate(found):
            if column not in taken:
                alive.append(Hypothesis(kalman.start(cluster.centroid, noise), [cluster]))
    return [one.clusters for one in lost + alive]


def _cost(one: Hypothesis, cluster: Cluster) -> float:
    """Negative log-likelihood of a cluster under an object's prediction; infinite outside the gate."""
    if cluster.time <= one.clusters[-1].time:
        return float("inf")
    predicted = one.predicted(cluster.time)
    covariance = predicted.covariance[:2, :2] + np.eye(2) * CENTROID_SIGMA_M**2
    offset = cluster.centroid - predicted.mean[:2]
    distance = float(offset @ np.linalg.solve(covariance, offset))
    return distance + float(np.log(np.linalg.det(covariance))) + 10 if distance < GATE else float("inf")
