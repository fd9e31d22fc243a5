"""View selection by a Markov random field over the faces: one photo for the detail of every face.

The energy is the sum of a data term (how much worse a photo is than the best one that sees the face) and a smoothness
term (a seam cost for every edge between faces of different photos, by its length; Waechter et al. 2014, "Let There Be
Color!"). It is minimised by sequential tree-reweighted message passing (TRW-S, Kolmogorov 2006), which also yields a
lower bound of the energy: iteration stops when the energy is close to it. Time and memory grow with faces times
candidates, not with the number of photos; results don't depend on the number of threads. Import late: it loads numba.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F32, I32, I64

MAX_ITERATIONS = 100
"""Each is a forward and a backward sweep."""
RELATIVE_GAP = 2e-3
"""Iteration stops when the gap between energy and lower bound is at most this share of the energy."""


def adjacent(faces: I32) -> tuple[I32, I32]:
    """Pairs of faces (E, 2) that share an edge, and the edge's vertices (E, 2); edges of more faces are left out."""
    start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
    key = np.minimum(start, end) << 32 | np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    pairs = first[np.diff(np.r_[first, len(key)]) == 2]
    a, b = order[pairs], order[pairs + 1]
    return np.stack([a // 3, b // 3], axis=1).astype(np.int32), np.stack([start[a], end[a]], axis=1).astype(np.int32)


def detail_views(view: I32, quality: F32, pairs: I32, seam_cost: F32) -> I32:
    """View (F,) selected for the detail of each face; -1 where none sees it.

    Args:
        view: (F, K) candidate views of each face, no view twice, -1 after the last.
        quality: (F, K) quality of each candidate; 0 after the last.
        pairs: (E, 2) neighbouring faces.
        seam_cost: (E,) cost of different views on both sides, relative to a cost of 1 for a useless view.
    """
    return solve(view, costs(view, quality), pairs, seam_cost).view


def costs(view: I32, quality: F32) -> F32:
    """(F, K) data cost of each candidate: 0 for the best view of a face, 1 for a useless one; infinite for none."""
    best = np.maximum(quality.max(axis=1, initial=0.0), 1e-30)[:, None]
    return np.where((view >= 0) & (quality > 0), 1 - np.sqrt(quality / best), np.inf).astype(np.float32)


@dataclass(frozen=True)
class Solution:
    """Selected views and their energy.

    Attributes:
        view: (F,) int32 views, -1 for faces without candidates.
        energy: sum of data costs and seam costs.
        bound: lower bound of the energy of any selection.
    """

    view: I32
    energy: float
    bound: float


def solve(view: I32, cost: F32, pairs: I32, seam_cost: F32) -> Solution:
    """Minimise the sum of the `cost` of the selected views and of `seam_cost` where they differ across `pairs`.

    Args:
        view: (F, K) candidate views of each face, no view twice.
        cost: (F, K) data costs, infinite after the last candidate.
        pairs: (E, 2) neighbouring faces.
        seam_cost: (E,) costs of different views on both sides.
    """
    count = np.isfinite(cost).sum(axis=1)
    seen = count > 0
    inner = seen[pairs].all(axis=1)
    pairs, seam_cost = pairs[inner], seam_cost[inner].astype(np.float32)
    if not seen.any():
        return Solution(np.full(len(view), -1, np.int32), 0.0, 0.0)
    ends = pairs.T.ravel()
    order = np.argsort(ends, kind="stable")
    graph = (
        count,
        np.searchsorted(ends[order], np.arange(len(view) + 1)),
        pairs[:, ::-1].T.ravel()[order],
        np.tile(np.arange(len(pairs)), 2)[order],
        seam_cost,
    )
    message = np.zeros((len(pairs), view.shape[1]), np.float32)
    pick = cost.argmin(axis=1)
    best, energy, bound = pick.copy(), _energy(view, cost, *graph, pick), 0.0
    for sweep in range(2 * MAX_ITERATIONS):
        if energy - bound <= RELATIVE_GAP * energy:
            break
        bound = max(bound, _sweep(view, cost, *graph, message, pick, sweep % 2 == 0))
        found = _energy(view, cost, *graph, pick)
        if found < energy:
            best, energy = pick.copy(), found
    return Solution(np.where(seen, view[np.arange(len(view)), best], -1).astype(np.int32), energy, bound)


@njit(cache=True)
def _energy(view: I32, cost: F32, count: I64, start: I64, other: I32, edge: I64, seam_cost: F32, pick: I64) -> float:
    """Energy of a selection: data costs and seam costs of the candidate picked for each face."""
    energy = 0.0
    for f in range(len(count)):
        if count[f] > 0:
            energy += cost[f, pick[f]]
        for k in range(start[f], start[f + 1]):
            if f < other[k] and view[f, pick[f]] != view[other[k], pick[other[k]]]:
                energy += seam_cost[edge[k]]
    return energy


@njit(cache=True)
def _sweep(
    view: I32,
    cost: F32,
    count: I64,
    start: I64,
    other: I32,
    edge: I64,
    seam_cost: F32,
    message: F32,
    pick: I64,
    forward: bool,
) -> float:
    """One sweep: each face in turn picks its candidate and passes messages to later faces; returns a lower bound.

    Args:
        start, other, edge: neighbours of face f, and the edges to them, are at start[f]:start[f + 1].
        message: (E, K) last message along each edge, over the candidates of the face that received it; in place.
        pick: (F,) index of the picked candidate; in place.
        forward: sweep through the faces in ascending order, else in descending order.
    """
    belief, conditional = np.empty(cost.shape[1]), np.empty(cost.shape[1])
    bound = 0.0
    for turn in range(len(count)):
        f = turn if forward else len(count) - 1 - turn
        if count[f] == 0:
            continue
        for i in range(count[f]):
            belief[i] = cost[f, i]  # cost of each candidate, with the messages of all neighbours
            conditional[i] = cost[f, i]  # the same, given the picks of the neighbours visited before
        before = after = 0
        for k in range(start[f], start[f + 1]):
            e, g = edge[k], other[k]
            for i in range(count[f]):
                belief[i] += message[e, i]
            if (g > f) == forward:
                after += 1
                for i in range(count[f]):
                    conditional[i] += message[e, i]
            else:
                before += 1
                taken = view[g, pick[g]]
                for i in range(count[f]):
                    conditional[i] += 0.0 if view[f, i] == taken else seam_cost[e]
        pick[f], least = 0, belief[0]
        for i in range(1, count[f]):
            least = min(least, belief[i])
            if conditional[i] < conditional[pick[f]]:
                pick[f] = i
        bound += least
        share = 1.0 / max(before, after, 1)
        for k in range(start[f], start[f + 1]):
            e, g = edge[k], other[k]
            if (g > f) == forward:
                seam_minimum = np.inf
                for i in range(count[f]):
                    conditional[i] = share * (belief[i] - least) - message[e, i]
                    seam_minimum = min(seam_minimum, conditional[i] + seam_cost[e])
                low = np.inf
                for j in range(count[g]):
                    there = seam_minimum
                    for i in range(count[f]):
                        if view[f, i] == view[g, j]:
                            there = min(there, conditional[i])
                    message[e, j] = there
                    low = min(low, there)
                for j in range(count[g]):
                    message[e, j] -= low
                bound += low
    return bound
