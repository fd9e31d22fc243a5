"""Extrapolation of colour changes from a border into the texels of a tile, by a Barnes-Hut style tree code.

Import late: it loads numba.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.camera.image_sampling import page_taps
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools
from scan2sim.texturing.borders.correspondences import SOFTENING_M
from scan2sim.texturing.texel_map import box, frame

LEAF_POINTS_MAX = 8
"""Points in a leaf of the tree."""
STACK_SIZE = 128
"""Nodes on the stack of a tree traversal: more than twice the depth of the tree."""
OPENING_RATIO = 0.2
"""A node whose radius is less than this share of its distance counts as one point (Barnes-Hut criterion)."""
DISTANCE_RATIO_MAX = 8.0
"""Points farther away than this multiple of the nearest distance are left out: their relative weight is < 1 / 4000."""
MATCH_ITERATIONS = 4
"""Iterations of `match_samples`; more change almost nothing."""
MIN_TOTAL_WEIGHT = 0.01
"""Texels with a smaller total weight in the samples are hardly changed."""


class Changes(NamedTuple):
    """Border points with their colour changes, in a binary ball tree.

    Attributes:
        first, last: (N,) range of the points of each node; node 0 has all.
        child: (N,) first child of each node, the second one follows; -1: leaf.
        centre, radius: (N, 3) and (N,) ball around the points of each node, metres.
        length, mean: (N,) metres of border that the points represent, and (N, 3) mean of their changes.
        xyz, metres, change: (P, 3) points in metres, (P,) metres of border that each represents, and (P, 3) colour
            changes in grey levels.
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
    """Tree of border points (P, 3), P > 0, the metres of border (P,) they represent, and their changes (P, 3)."""
    order = np.arange(len(xyz))
    first, last = [0], [len(xyz)]
    child: list[int] = []
    while len(child) < len(first):  # nodes are split in the order in which they were created
        a, b = first[len(child)], last[len(child)]
        if b - a <= LEAF_POINTS_MAX:
            child.append(-1)
            continue
        points, middle = order[a:b], (a + b) // 2
        order[a:b] = points[np.argsort(xyz[points, np.ptp(xyz[points], axis=0).argmax()], kind="stable")]
        child.append(len(first))
        first += [a, middle]
        last += [middle, b]
    xyz, metres, value = xyz[order], metres[order], change[order].astype(np.float64)
    spans = [slice(a, b) for a, b in zip(first, last, strict=True)]
    length = np.array([metres[span].sum() for span in spans])
    centre = np.array([metres[span] @ xyz[span] for span in spans]) / length[:, None]
    mean = np.array([metres[span] @ value[span] for span in spans]) / length[:, None]
    radius = np.array([((xyz[span] - c) ** 2).sum(axis=1).max() ** 0.5 for span, c in zip(spans, centre, strict=True)])
    begin, end, below = np.array(first), np.array(last), np.array(child)
    return Changes(begin, end, below, centre, radius, length, mean, xyz, metres, value)


@njit(cache=True, inline="always")
def _distance2(a: F64, x: float, y: float, z: float) -> float:
    return (a[0] - x) ** 2 + (a[1] - y) ** 2 + (a[2] - z) ** 2


@njit(cache=True)
def _nearest(tree: Changes, x: float, y: float, z: float, limit: float, stack: I64) -> float:
    """Distance in metres to the nearest border point; `limit` if none is nearer."""
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
        else:  # the nearer child is pushed last
            swap = _distance2(tree.centre[child], x, y, z) < _distance2(tree.centre[child + 1], x, y, z)
            stack[top], stack[top + 1] = (child + 1, child) if swap else (child, child + 1)
            top += 2
    return math.sqrt(best)


@njit(cache=True)
def _change(tree: Changes, x: float, y: float, z: float, nearest: float, stack: I64) -> tuple[float, float, float]:
    """Colour change at a position: mean over the border points, weighted by metres / distance^4.

    It is reduced where the border appears short from here: a straight border has the total weight
    pi / 2 / nearest^3; the change is applied in full from half of that.
    """
    soft = SOFTENING_M * SOFTENING_M
    far = DISTANCE_RATIO_MAX * math.sqrt(nearest * nearest + soft)
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
        if tree.radius[node] < OPENING_RATIO * distance:
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
def within(tree: Changes, corners: F32, fade_distance: float) -> Bools:
    """(F,) faces, `corners` (F, 3, 3), of which a part may be within `fade_distance` metres of a border point."""
    out = np.zeros(len(corners), np.bool_)
    for f in prange(len(corners)):
        x = (corners[f, 0, 0] + corners[f, 1, 0] + corners[f, 2, 0]) / 3
        y = (corners[f, 0, 1] + corners[f, 1, 1] + corners[f, 2, 1]) / 3
        z = (corners[f, 0, 2] + corners[f, 1, 2] + corners[f, 2, 2]) / 3
        limit = fade_distance
        for k in range(3):
            limit = max(limit, fade_distance + math.sqrt(_distance2(corners[f, k], x, y, z)))
        out[f] = _nearest(tree, x, y, z, limit, np.empty(STACK_SIZE, np.int64)) < limit
    return out


@njit(cache=True, parallel=True)
def fade(rgb: U8, owner: I32, flat: F32, corners: F32, near: Bools, tree: Changes, fade_distance: float) -> None:
    """Add the extrapolated colour change to every texel of the faces that are `near`, faded out over `fade_distance`.

    Args:
        rgb: (H, W, 3) uint8, changed in place.
        owner: (H, W) face of each texel, index into the next three.
        flat, corners, near: (F, 3, 2) texels, (F, 3, 3) metres, (F,) bool.
        tree: colour changes of the border points.
        fade_distance: fading distance in metres.
    """
    height, width = owner.shape
    for f in prange(len(flat)):
        if not near[f]:
            continue
        origin, per_x, per_y, ok = frame(flat, corners, f)
        if not ok:
            continue
        stack = np.empty(STACK_SIZE, np.int64)
        x0, y0, x1, y1 = box(flat, f, width, height)
        for ty in range(y0, y1 + 1):
            for tx in range(x0, x1 + 1):
                if owner[ty, tx] != f:
                    continue
                x = origin[0] + tx * per_x[0] + ty * per_y[0]
                y = origin[1] + tx * per_x[1] + ty * per_y[1]
                z = origin[2] + tx * per_x[2] + ty * per_y[2]
                nearest = _nearest(tree, x, y, z, fade_distance, stack)
                if nearest >= fade_distance:
                    continue
                change = _change(tree, x, y, z, nearest, stack)
                s = 1 - nearest / fade_distance
                share = s * s * (3 - 2 * s)
                for k in range(3):
                    rgb[ty, tx, k] = min(255.0, max(0.0, rgb[ty, tx, k] + share * change[k] + 0.5))


def padding_sources(owner: I32) -> I32:
    """(H, W) flat index of the texel that each texel takes its colour from: itself, or the nearest texel of a face.

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


def match_samples(page: U8, source: I32, uv: F32, wanted: F32) -> None:
    """Change texels so that bilinear samples of the page have the wanted colours, in place.

    Removes the remaining difference, about a grey level, that is due to texels not being at the sample points. Least
    squares by a few iterations of SART, the simultaneous algebraic reconstruction technique (Andersen and Kak 1984).

    Args:
        page: (H, W, 3) page.
        source: (H, W) from `padding_sources`.
        uv: (L, 2) texture coordinates of the samples.
        wanted: (L, 3) wanted grey levels of the samples.
    """
    read, weight = page_taps(page, uv)
    texel, index = np.unique(source.ravel()[read], return_inverse=True)
    index = index.reshape(-1, 4)
    value = page.reshape(-1, 3)[texel].astype(np.float32)
    total = np.bincount(index.ravel(), weight.ravel())[:, None]
    for _ in range(MATCH_ITERATIONS):
        residual = wanted - np.einsum("lt,ltc->lc", weight, value[index])
        share = weight[..., None] * residual[:, None]
        sums = [np.bincount(index.ravel(), share[..., k].ravel()) for k in range(3)]
        value += (np.stack(sums, axis=1) / np.maximum(total, MIN_TOTAL_WEIGHT)).astype(np.float32)
    page.reshape(-1, 3)[texel] = np.clip(np.round(value), 0, 255)


@njit(cache=True, parallel=True)
def update_padding(before: U8, after: U8, owner: I32, source: I32) -> None:
    """Update the padding around charts: texels that had the colour of the nearest chart texel take its new colour.

    Args:
        before: (H, W, 3) uint8 page before the change.
        after: (H, W, 3) uint8 page with changed charts; its padding is changed in place.
        owner, source: (H, W) from `texel_map.owners` and `padding_sources`.
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
