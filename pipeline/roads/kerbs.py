"""Where a road ends to either side: at a kerb, a step of the ground, or where points of another class begin."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools

ROW = 0.5
"""Metres along the road between places where its edges are looked for."""
BIN = 0.1
"""Metres across."""
STEP = (0.04, 0.30)
"""Metres that a kerb is high."""
LASTING, WITHIN = 3.0, 0.25
"""A kerb goes on: so many metres along the road, steps are no farther than this from each other."""
ON, OFF = 1.0, 0.5
"""Metres from the line within which nothing is an edge; of other ground that makes one."""
SEEN = 2
"""Points that a bin has at least."""


def edges(s: F64, t: F64, z: F64, road: Bools, length: float, reach: float, side: Literal[1, -1]) -> F64:
    """(E, 3) chainage, offset and height of the kerb (NaN: no kerb, but another class) of a road's edge.

    Args:
        s, t, z: (N,) chainage, offset and height of points of the ground.
        road: (N,) whether they are of a class to drive on.
        length: metres of the line.
        reach: metres to its side up to which is looked.
        side: 1 to the left, -1 to the right.
    """
    out = t * side
    held = (out > 0) & (out < reach) & (s >= 0) & (s <= length)
    s, out, z, road = s[held], out[held], z[held], road[held]
    rows, bins = max(1, int(length / ROW)), int(reach / BIN)
    row, column = np.minimum((s / ROW).astype(int), rows - 1), np.minimum((out / BIN).astype(int), bins - 1)

    def summed(weights: F64 | None) -> F64:
        """Over each row and those beside it."""
        grid = np.bincount(row * bins + column, weights, minlength=rows * bins).reshape(rows, bins).astype(float)
        padded = np.pad(grid, ((1, 1), (0, 0)))
        return padded[:-2] + padded[1:-1] + padded[2:]

    count = summed(None)
    known = count >= SEEN
    share, height = (np.where(known, summed(w) / np.maximum(count, 1), np.nan) for w in (road.astype(float), z))
    border = _borders(known, share > 0.5)
    kerb = _kerbs(height)
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], np.arange(rows + 2) - 1)
    found = []
    for i in range(rows):
        own = order[first[max(i, 0)] : first[min(i + 3, rows + 1)]]
        at = (i + 0.5) * ROW
        if np.isfinite(kerb[i]) and (np.isnan(border[i]) or kerb[i] < border[i] + 1.0):
            place, high = _exact(out[own], z[own], float(kerb[i]))
            found.append((at, side * place, high))
        elif np.isfinite(border[i]):
            found.append((at, side * float(border[i]), np.nan))
    return np.array(found).reshape(-1, 3)


def _borders(known: Bools, road: Bools) -> F64:
    """(R,) offsets where road ends and other ground begins; NaN where that is hidden, or out of reach."""
    after, before = round(OFF / BIN), 3
    out = np.full(len(known), np.nan)
    for i in range(round(ON / BIN), known.shape[1] - after):
        ahead = slice(i, i + after)
        seen, on = known[:, ahead].sum(axis=1), (known & road)[:, ahead].sum(axis=1)
        ends = np.isnan(out) & known[:, i] & ~road[:, i] & (seen >= after - 2) & (on <= 1)
        out[ends] = np.where((known & road)[ends, i - before : i].any(axis=1), i * BIN, -1.0)
    return np.where(out < 0, np.nan, out)


def _kerbs(height: F64) -> F64:
    """(R,) offsets of the first step upwards that goes on along the road; NaN where there is none."""
    low = np.stack([height[:, k : height.shape[1] - 5 + k] for k in (0, 1, 2)])
    high = np.stack([height[:, k : height.shape[1] - 5 + k] for k in (3, 4, 5)])
    whole = (np.isfinite(low).sum(axis=0) >= 2) & (np.isfinite(high).sum(axis=0) >= 2)
    step = np.where(whole, np.nansum(high, 0) / np.maximum(np.isfinite(high).sum(0), 1), 0)
    step -= np.where(whole, np.nansum(low, 0) / np.maximum(np.isfinite(low).sum(0), 1), 0)
    best = np.pad(step, ((0, 0), (3, 3)))
    best = np.max([best[:, k : k + step.shape[1]] for k in range(7)], axis=0)
    peak = (step >= STEP[0]) & (step <= STEP[1]) & (step == best)
    peak[:, : round(ON / BIN)] = False
    around, across = round(LASTING / ROW), round(WITHIN / BIN)
    total = np.zeros(step.shape)
    padded = np.pad(peak, ((around, around), (across, across)))
    for k in range(2 * around + 1):
        total += np.any([padded[k : k + len(step), j : j + step.shape[1]] for j in range(2 * across + 1)], axis=0)
    lasting = peak & (total >= around)
    first = lasting.argmax(axis=1)
    return np.where(lasting.any(axis=1), (first + 3) * BIN, np.nan)


def _exact(out: F64, z: F64, about: float) -> tuple[float, float]:
    """Offset and height of a step near `about`: where points (N,) part best into lower and upper ones."""
    near = np.abs(out - about) < 0.5
    out, z = out[near], z[near]
    inner, outer = z[out < about - 0.15], z[out > about + 0.15]
    if len(inner) < 3 or len(outer) < 3:
        return about, float("nan")
    low, high = float(np.median(inner)), float(np.median(outer))
    order = np.argsort(out)
    out, z = out[order], z[order]
    wrong_below, wrong_above = np.minimum(np.abs(z - low), high - low), np.minimum(np.abs(z - high), high - low)
    cost = np.concatenate([[0.0], np.cumsum(wrong_below)]) + np.concatenate([np.cumsum(wrong_above[::-1])[::-1], [0.0]])
    best = int(np.argmin(cost[1:-1])) + 1
    return float(out[best - 1] + out[best]) / 2, high - low
