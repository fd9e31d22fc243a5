"""Objects that move, followed through the sweeps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F64, I64, Bools, Trajectory
from scan2sim.pipeline.tracking.association import Cluster, associate
from scan2sim.pipeline.tracking.fit import Fit, Observation, fit

CELL_M, LINK_CELLS = 0.2, 2
"""Cells of the plan grid of clusters, and by how many of them points of one object may be apart on either side."""
MIN_POINTS = 3
"""Points of the smallest cluster: a car 60 m away has few."""
HEIGHT_M = (0.15, 4.3)
"""Heights above ground of points of road users: below is the noise of the road."""
MIN_SWEEPS = 8
"""Sweeps with returns of an object that is followed: fewer fit any motion."""
MOVED_MIN_M = 1.0
"""Length beyond that of its box over which the returns of an object extend in all sweeps together if it moves. Parked
cars appear to move while something hides parts of them, but only within their box."""
MIN_SPEED_MPS, MAX_SPEED_MPS = 0.5, 60.0
SEEN_SHARE = 0.5
"""Smallest share of the sweeps of a track in which the object was seen."""
MAX_RESIDUAL_M = 0.3
"""Largest median distance of measured centres from the smooth path: what is farther off are different objects."""
EGO_RADIUS_M, EGO_DRIFT_M = 3.5, 0.5
"""What stays within the first distance of the scanner, and moves less than the second relative to it, is a part of
the recording vehicle."""
EGO_HALF_M = (2.6, 1.1)
"""Half the length and width of the volume around the scanner whose returns are of the recording vehicle."""


@dataclass(frozen=True)
class Returns:
    """Returns that may be of road users: (N,) arrays, and the scanner's path.

    Attributes:
        xyz: (N, 3) local metres.
        height: metres above ground.
        time: seconds.
        sweep: number of the sweep.
        path: path of the scanner.
    """

    xyz: F64
    height: F64
    time: F64
    sweep: I64
    path: Trajectory

    def take(self, index: I64 | Bools) -> Returns:
        """The returns that `index` selects."""
        return Returns(self.xyz[index], self.height[index], self.time[index], self.sweep[index], self.path)


@dataclass(frozen=True)
class Followed:
    """An object: its boxes, and its returns (N,) in all sweeps."""

    fit: Fit
    index: I64


def follow(returns: Returns, sweep_times: F64) -> list[Followed]:
    """Objects that move, longest first.

    Args:
        returns: returns that may be of moving objects, without those of the ground.
        sweep_times: (S,) seconds, middle of each sweep.
    """
    usable = (returns.height > HEIGHT_M[0]) & (returns.height < HEIGHT_M[1]) & ~_of_ego(returns)
    index = np.flatnonzero(usable)
    order = index[np.argsort(returns.sweep[index], kind="stable")]
    sweeps = [
        list(_clusters(returns, part)) for part in np.split(order, np.flatnonzero(np.diff(returns.sweep[order])) + 1)
    ]
    chains = [chain for chain in associate(sweeps) if len(chain) >= MIN_SWEEPS]
    found = [one for chain in chains if (one := _followed(returns, chain, sweep_times)) is not None]
    return sorted(found, key=lambda one: -len(one.index))


def _of_ego(returns: Returns) -> Bools:
    """(N,) whether a return is of the recording vehicle."""
    at = returns.path.at(returns.time)
    step = returns.path.at(returns.time + 0.25)[:, :2] - returns.path.at(returns.time - 0.25)[:, :2]
    along = step / np.maximum(np.hypot(*step.T), 1e-6)[:, None]
    offset = returns.xyz[:, :2] - at[:, :2]
    u = np.abs((offset * along).sum(axis=1))
    v = np.abs(offset[:, 1] * along[:, 0] - offset[:, 0] * along[:, 1])
    return np.asarray((u < EGO_HALF_M[0]) & (v < EGO_HALF_M[1]))


def _clusters(returns: Returns, index: I64) -> Iterator[Cluster]:
    """Clusters of the returns of one sweep, connected in plan."""
    if not len(index):
        return
    xy = returns.xyz[index, :2]
    cell = np.floor((xy - xy.min(axis=0)) / CELL_M).astype(np.int64) + LINK_CELLS
    plan = np.zeros(cell.max(axis=0) + 1 + LINK_CELLS, bool)
    plan[tuple(cell.T)] = True
    grown = ndimage.binary_dilation(plan, np.ones((2 * LINK_CELLS + 1,) * 2))
    part = ndimage.label(grown, np.ones((3, 3)))[0][tuple(cell.T)]
    order = np.argsort(part, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        if len(own) >= MIN_POINTS:
            centroid = np.unique(cell[own], axis=0).mean(axis=0) * CELL_M + xy.min(axis=0) - LINK_CELLS * CELL_M
            member = index[own]
            yield Cluster(int(returns.sweep[member[0]]), member, float(returns.time[member].mean()), centroid)


def _followed(returns: Returns, chain: Sequence[Cluster], sweep_times: F64) -> Followed | None:
    """The moving object of a chain of clusters; None if it doesn't move, or if the chain is none."""
    index = np.concatenate([cluster.index for cluster in chain])
    observations = [_observation(returns, cluster.index) for cluster in chain]
    seen = {cluster.sweep for cluster in chain}
    between = [k for k in range(chain[0].sweep, chain[-1].sweep) if k not in seen]
    times = np.unique([*(one.time for one in observations), *(float(sweep_times[k]) for k in between)])
    found = fit(observations, times)
    speed = float(np.hypot(*(found.states[-1, :2] - found.states[0, :2]))) / float(times[-1] - times[0])
    if len(chain) < SEEN_SHARE * len(times) or not MIN_SPEED_MPS < speed < MAX_SPEED_MPS:
        return None
    if found.residual > MAX_RESIDUAL_M or _travels_with_scanner(observations) or not _moves(observations, found):
        return None
    return Followed(found, index)


def _moves(observations: Sequence[Observation], found: Fit) -> bool:
    """Whether the returns of all sweeps extend farther along the path than the box."""
    start, end = found.states[0, :2], found.states[-1, :2]
    along = (end - start) / max(float(np.hypot(*(end - start))), 1e-6)
    ends = [np.percentile(one.xyz[:, :2] @ along, (5, 95)) for one in observations]
    return float(max(high for _, high in ends) - min(low for low, _ in ends)) > found.size[0] + MOVED_MIN_M


def _travels_with_scanner(observations: Sequence[Observation]) -> bool:
    """Whether an object keeps its place beside the scanner."""
    offsets = np.array([np.median(one.xyz[:, :2], axis=0) - one.scanner for one in observations])
    near = float(np.median(np.hypot(*offsets.T))) < EGO_RADIUS_M
    return near and float(np.std(offsets, axis=0).max()) < EGO_DRIFT_M


def _observation(returns: Returns, index: I64) -> Observation:
    time = float(returns.time[index].mean())
    scanner = returns.path.at(np.array([time]))[0, :2]
    return Observation(returns.xyz[index], returns.height[index], returns.time[index], time, scanner)


def height_above(ground: F64, xyz: F64) -> F64:
    """Heights (N,) of points (N, 3) above the nearest cell of the ground (G, 3)."""
    if not len(ground):
        return np.full(len(xyz), np.nan)
    return np.asarray(xyz[:, 2] - ground[cKDTree(ground[:, :2]).query(xyz[:, :2])[1], 2])
