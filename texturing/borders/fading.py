"""How a change of colours at a border fades inwards, and lands in texels.

Import late: it loads numba.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.image_sampling import page_taps
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools
from scan2sim.texturing.bake.texel_map import box, frame
from scan2sim.texturing.borders.correspondences import SOFT

LEAF = 8
"""Places of a tree's leaf, at most."""
DEPTH = 128
"""Nodes that wait while a tree is walked, at most: twice its levels and more."""
OPEN = 0.2
"""A node whose radius is less than this share of its distance counts as one place."""
FAR = 8.0
"""Places so many times further away than the nearest one are left out: their weight is below 1 / 4000 of its."""
ROUNDS = 4
"""Of `settle`; later ones change next to nothing."""
LIGHT = 0.01
"""Texels that lookups read with less weight than this in all are left nearly as they are."""


class Changes(NamedTuple):
    """Places and the change of colour at each, in a binary tree of balls.

    Attributes:
        first, last: (N,) the places of a node; node 0 holds all.
        child: (N,) its first child, the other one follows; -1: none.
        centre, radius: (N, 3) and (N,) metres, of the ball around its places.
        length, mean: (N,) metres of border that they stand for, and (N, 3) the mean of their changes.
        xyz, metres, change: (P, 3) metres, (P,) metres of border, and (P, 3) grey levels of the places.
    """

    first: I64
    last: I64
    child: I64
    centre: F64
    radius: F64
    length: F64
    mean: F64
    xyz: F64
    metres: F64
    change: F64


def changes(xyz: F64, metres: F64, change: F32) -> Changes:
    """Arrange places (P, 3), P > 0, the metres of border that they stand for, and their changes (P, 3), in a tree."""
    order = np.arange(len(xyz))
    first, last = [0], [len(xyz)]
    child: list[int] = []
    while len(child) < len(first):  # nodes are split in the order in which they were made
        a, b = first[len(child)], last[len(child)]
        if b - a <= LEAF:
            child.append(-1)
            continue
        here, middle = order[a:b], (a + b) // 2
        order[a:b] = here[np.argsort(xyz[here, np.ptp(xyz[here], axis=0).argmax()], kind="stable")]
        child.append(len(first))
        first += [a, middle]
        last += [middle, b]
    xyz, metres, value = xyz[order], metres[order], change[order].astype(np.float64)
    spans = [slice(a, b) for a, b in zip(first, last, strict=True)]
    length = np.array([metres[of].sum() for of in spans])
    centre = np.array([metres[of] @ xyz[of] for of in spans]) / length[:, None]
    mean = np.array([metres[of] @ value[of] for of in spans]) / length[:, None]
    radius = np.array([((xyz[of] - c) ** 2).sum(axis=1).max() ** 0.5 for of, c in zip(spans, centre, strict=True)])
    begin, end, below = np.array(first), np.array(last), np.array(child)
    return Changes(begin, end, below, centre, radius, length, mean, xyz, metres, value)


@njit(cache=True, inline="always")
def _distance2(a: F64, x: float, y: float, z: float) -> float:
    return (a[0] - x) ** 2 + (a[1] - y) ** 2 + (a[2] - z) ** 2


@njit(cache=True)
def _nearest(tree: Changes, x: float, y: float, z: float, limit: float, stack: I64) -> float:
    """Metres to the nearest place; `limit` where none is nearer."""
    best = limit * limit
    stack[0] = 0
    top = 1
    while top > 0:
        top -= 1
        node = stack[top]
        rest = math.sqrt(_distance2(tree.centre[node], x, y, z)) - tree.radius[node]
        if rest > 0 and rest * rest >= best:
            continue
        child = tree.child[node]
        if child < 0:
            for i in range(tree.first[node], tree.last[node]):
                best = min(best, _distance2(tree.xyz[i], x, y, z))
        else:  # the nearer child is looked at first
            swap = _distance2(tree.centre[child], x, y, z) < _distance2(tree.centre[child + 1], x, y, z)
            stack[top], stack[top + 1] = (child + 1, child) if swap else (child, child + 1)
            top += 2
    return math.sqrt(best)


@njit(cache=True)
def _change(tree: Changes, x: float, y: float, z: float, nearest: float, stack: I64) -> tuple[float, float, float]:
    """The mean change of all places, weighted by metres / distance^4, less where the border is short as seen from here.

    A straight border weighs pi / 2 / nearest^3; what has at least half of that counts in full.
    """
    soft = SOFT * SOFT
    far = FAR * math.sqrt(nearest * nearest + soft)
    r = g = b = total = 0.0
    stack[0] = 0
    top = 1
    while top > 0:
        top -= 1
        node = stack[top]
        distance2 = _distance2(tree.centre[node], x, y, z)
        distance, child = math.sqrt(distance2), tree.child[node]
        if distance - tree.radius[node] > far:
            continue
        if tree.radius[node] < OPEN * distance:
            w = tree.length[node] / (distance2 + soft) ** 2
            total += w
            r += w * tree.mean[node, 0]
            g += w * tree.mean[node, 1]
            b += w * tree.mean[node, 2]
        elif child >= 0:
            stack[top], stack[top + 1] = child, child + 1
            top += 2
        else:
            for i in range(tree.first[node], tree.last[node]):
                w = tree.metres[i] / (_distance2(tree.xyz[i], x, y, z) + soft) ** 2
                total += w
                r += w * tree.change[i, 0]
                g += w * tree.change[i, 1]
                b += w * tree.change[i, 2]
    share = min(1.0, total * (nearest * nearest + soft) ** 1.5 * 4 / math.pi) / total
    return r * share, g * share, b * share


@njit(cache=True, parallel=True)
def within(tree: Changes, corners: F32, reach: float) -> Bools:
    """(F,) whether a face, `corners` (F, 3, 3), may have a part within `reach` metres of a place."""
    out = np.zeros(len(corners), np.bool_)
    for f in prange(len(corners)):
        x = (corners[f, 0, 0] + corners[f, 1, 0] + corners[f, 2, 0]) / 3
        y = (corners[f, 0, 1] + corners[f, 1, 1] + corners[f, 2, 1]) / 3
        z = (corners[f, 0, 2] + corners[f, 1, 2] + corners[f, 2, 2]) / 3
        limit = reach
        for k in range(3):
            limit = max(limit, reach + math.sqrt(_distance2(corners[f, k], x, y, z)))
        out[f] = _nearest(tree, x, y, z, limit, np.empty(DEPTH, np.int64)) < limit
    return out


@njit(cache=True, parallel=True)
def fade(rgb: U8, owner: I32, flat: F32, corners: F32, near: Bools, tree: Changes, reach: float) -> None:
    """Add to every texel of the faces that are `near` the change of the places around, faded out over `reach`.

    Args:
        rgb: (H, W, 3) uint8, changed in place.
        owner: (H, W) face of each texel, index into the next three.
        flat, corners, near: (F, 3, 2) texels, (F, 3, 3) metres, (F,) bool.
        tree: `Changes`.
        reach: metres.
    """
    height, width = owner.shape
    for f in prange(len(flat)):
        if not near[f]:
            continue
        origin, per_x, per_y, ok = frame(flat, corners, f)
        if not ok:
            continue
        stack = np.empty(DEPTH, np.int64)
        x0, y0, x1, y1 = box(flat, f, width, height)
        for ty in range(y0, y1 + 1):
            for tx in range(x0, x1 + 1):
                if owner[ty, tx] != f:
                    continue
                x = origin[0] + tx * per_x[0] + ty * per_y[0]
                y = origin[1] + tx * per_x[1] + ty * per_y[1]
                z = origin[2] + tx * per_x[2] + ty * per_y[2]
                nearest = _nearest(tree, x, y, z, reach, stack)
                if nearest >= reach:
                    continue
                change = _change(tree, x, y, z, nearest, stack)
                s = 1 - nearest / reach
                share = s * s * (3 - 2 * s)
                for k in range(3):
                    rgb[ty, tx, k] = min(255.0, max(0.0, rgb[ty, tx, k] + share * change[k] + 0.5))


def sources(owner: I32) -> I32:
    """(H, W) the texel, counted along the rows, that each takes its colour from: itself, or the nearest of a face.

    Args:
        owner: (H, W) face of each texel, -1 where none.
    """
    import cv2

    empty = (owner < 0).astype(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    texel = np.zeros(nearest.max() + 1, np.int32)
    owned = np.flatnonzero(empty == 0)
    texel[nearest.ravel()[owned]] = owned
    return texel[nearest]


def settle(page: U8, source: I32, uv: F32, wanted: F32) -> None:
    """Change the texels that lookups read until these give what is wanted: what texels' own places left over. In place.

    Least squares by a few rounds of simultaneous reconstruction (Andersen and Kak, 1984); a grey level or so.

    Args:
        page: (H, W, 3).
        source: (H, W) of `sources`.
        uv, wanted: (L, 2) and (L, 3) grey levels, of the lookups.
    """
    read, weight = page_taps(page, uv)
    texel, index = np.unique(source.ravel()[read], return_inverse=True)
    index = index.reshape(-1, 4)
    value = page.reshape(-1, 3)[texel].astype(np.float32)
    total = np.bincount(index.ravel(), weight.ravel())[:, None]
    for _ in range(ROUNDS):
        lacking = wanted - np.einsum("lt,ltc->lc", weight, value[index])
        share = weight[..., None] * lacking[:, None]
        sums = [np.bincount(index.ravel(), share[..., k].ravel()) for k in range(3)]
        value += (np.stack(sums, axis=1) / np.maximum(total, LIGHT)).astype(np.float32)
    page.reshape(-1, 3)[texel] = np.clip(np.round(value), 0, 255)


@njit(cache=True, parallel=True)
def follow(before: U8, after: U8, owner: I32, source: I32) -> None:
    """Let texels around charts that showed the colour of the nearest one in a chart (`fill.pad`) do so again.

    Args:
        before: (H, W, 3) uint8 as it was.
        after: (H, W, 3) uint8 with charts changed; changed in place.
        owner, source: (H, W) of `texels.owners` and `sources`.
    """
    height, width = owner.shape
    for y in prange(height):
        for x in range(width):
            if owner[y, x] >= 0:
                continue
            j, i = source[y, x] // width, source[y, x] % width
            if (
                before[y, x, 0] == before[j, i, 0]
                and before[y, x, 1] == before[j, i, 1]
                and before[y, x, 2] == before[j, i, 2]
            ):
                for k in range(3):
                    after[y, x, k] = after[j, i, k]
