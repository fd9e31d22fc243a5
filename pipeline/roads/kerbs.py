"""Road edges: kerbs (height steps) and boundaries between road and other ground classes."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools

ROW_M = 0.5
"""Spacing along the road at which edges are detected."""
BIN_M = 0.1
"""Width of bins across the road."""
KERB_HEIGHT_M = (0.04, 0.30)
"""Minimum and maximum height of a kerb."""
KERB_CONTINUITY_M, KERB_SIDE_TOLERANCE_M = 3.0, 0.25
"""A kerb continues along the road: window in which steps are counted, and their largest offset from each other."""
MIN_HALF_WIDTH_M, BORDER_WIDTH_M = 1.0, 0.5
"""Smallest distance of an edge from the line, and width of other ground that forms an edge."""
MIN_BIN_POINTS = 2


def edges(s: F64, t: F64, z: F64, road: Bools, length: float, max_offset: float, side: Literal[1, -1]) -> F64:
    """Edge of a road (E, 3): chainage, offset, and kerb height (NaN: a class boundary without a kerb).

    Args:
        s, t, z: (N,) chainage, offset and height of ground points.
        road: (N,) bool, True for road classes.
        length: length of the line, metres.
        max_offset: largest distance of an edge from the line, metres.
        side: 1 is left, -1 right.
    """
    out = t * side
    held = (out > 0) & (out < max_offset) & (s >= 0) & (s <= length)
    s, out, z, road = s[held], out[held], z[held], road[held]
    rows, bins = max(1, int(length / ROW_M)), int(max_offset / BIN_M)
    row, column = np.minimum((s / ROW_M).astype(int), rows - 1), np.minimum((out / BIN_M).astype(int), bins - 1)

    def summed(weights: F64 | None) -> F64:
        """Sums over each row and its two neighbours."""
        grid = np.bincount(row * bins + column, weights, minlength=rows * bins).reshape(rows, bins).astype(float)
        padded = np.pad(grid, ((1, 1), (0, 0)))
        return padded[:-2] + padded[1:-1] + padded[2:]

    count = summed(None)
    known = count >= MIN_BIN_POINTS
    road_fraction, height = (np.where(known, summed(w) / np.maximum(count, 1), np.nan) for w in (road.astype(float), z))
    border = _class_borders(known, road_fraction > 0.5)
    kerb = _kerb_offsets(height)
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], np.arange(rows + 2) - 1)
    found = []
    for i in range(rows):
        own = order[first[max(i, 0)] : first[min(i + 3, rows + 1)]]
        at = (i + 0.5) * ROW_M
        if np.isfinite(kerb[i]) and (np.isnan(border[i]) or kerb[i] < border[i] + 1.0):
            place, high = _refine_step(out[own], z[own], float(kerb[i]))
            found.append((at, side * place, high))
        elif np.isfinite(border[i]):
            found.append((at, side * float(border[i]), np.nan))
    return np.array(found).reshape(-1, 3)


def _class_borders(known: Bools, road: Bools) -> F64:
    """Offsets (R,) at which the road ends and other ground begins; NaN if occluded or too far away."""
    after, before = round(BORDER_WIDTH_M / BIN_M), 3
    out = np.full(len(known), np.nan)
    for i in range(round(MIN_HALF_WIDTH_M / BIN_M), known.shape[1] - after):
        ahead = slice(i, i + after)
        seen, on = known[:, ahead].sum(axis=1), (known & road)[:, ahead].sum(axis=1)
        ends = np.isnan(out) & known[:, i] & ~road[:, i] & (seen >= after - 2) & (on <= 1)
        out[ends] = np.where((known & road)[ends, i - before : i].any(axis=1), i * BIN_M, -1.0)
    return np.where(out < 0, np.nan, out)


def _kerb_offsets(height: F64) -> F64:
    """Offsets (R,) of the first upward step that continues along the road; NaN if there is none."""
    low = np.stack([height[:, k : height.shape[1] - 5 + k] for k in (0, 1, 2)])
    high = np.stack([height[:, k : height.shape[1] - 5 + k] for k in (3, 4, 5)])
    enough_points = (np.isfinite(low).sum(axis=0) >= 2) & (np.isfinite(high).sum(axis=0) >= 2)
    step = np.where(enough_points, np.nansum(high, 0) / np.maximum(np.isfinite(high).sum(0), 1), 0)
    step -= np.where(enough_points, np.nansum(low, 0) / np.maximum(np.isfinite(low).sum(0), 1), 0)
    best = np.pad(step, ((0, 0), (3, 3)))
    best = np.max([best[:, k : k + step.shape[1]] for k in range(7)], axis=0)
    peak = (step >= KERB_HEIGHT_M[0]) & (step <= KERB_HEIGHT_M[1]) & (step == best)
    peak[:, : round(MIN_HALF_WIDTH_M / BIN_M)] = False
    around, across = round(KERB_CONTINUITY_M / ROW_M), round(KERB_SIDE_TOLERANCE_M / BIN_M)
    total = np.zeros(step.shape)
    padded = np.pad(peak, ((around, around), (across, across)))
    for k in range(2 * around + 1):
        total += np.any([padded[k : k + len(step), j : j + step.shape[1]] for j in range(2 * across + 1)], axis=0)
    continuous = peak & (total >= around)
    first = continuous.argmax(axis=1)
    return np.where(continuous.any(axis=1), (first + 3) * BIN_M, np.nan)


def _refine_step(out: F64, z: F64, about: float) -> tuple[float, float]:
    """Offset and height of a step near `about`: the best split of the points (N,) into lower and upper ones."""
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
