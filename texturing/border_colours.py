"""Where neighbouring tiles meet, the colours they show there, and how a change of them fades inwards.

Import late: it loads numba.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.io import image
from scan2sim.pipeline.io.textured import Textured
from scan2sim.pipeline.types import F32, F64, I32, U8, Mesh
from scan2sim.texturing.blend import _box, frame

Index = npt.NDArray[np.int64]

GRID = 4096
"""Vertices on a border are the same multiples of 1 / GRID metres in all tiles."""
SPACING = 0.015
"""Metres between the places of an edge where colours are compared: texels span a centimetre or more."""
MEASURED = 0.01
"""As `SPACING`, where the step between finished tiles is measured: at other places."""
SOFT = SPACING / 2
"""Metres within which places count alike."""
BLUR = 0.1
"""Share of `reach` by which colours are averaged where more than two tiles meet (a Gaussian's sigma)."""
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


@dataclass(frozen=True)
class Rim:
    """Where a textured mesh ends: its edges of one face.

    Attributes:
        ends: (E, 2, 3) int64, world places of an edge's ends, in 1 / GRID metres.
        uv: (E, 2, 2) float32, their texture coordinates on the edge's face.
        page: (E,) the face's page.
    """

    ends: Index
    uv: F32
    page: npt.NDArray[np.int16]


@dataclass(frozen=True)
class Looks:
    """Where on its pages a mesh shows places; those at vertices are shown by several faces.

    Attributes:
        place: (L,) index of the place.
        page: (L,) of the face.
        uv: (L, 2) texture coordinates.
    """

    place: Index
    page: npt.NDArray[np.int16]
    uv: F32


@dataclass(frozen=True)
class Border:
    """Places that meshes share.

    Attributes:
        xyz: (P, 3) float64, world metres.
        metres: (P,) of the border that each place stands for.
        looks: of every mesh.
        length: metres of the first mesh's border edges that each other one shares, at their ends at least.
    """

    xyz: F64
    metres: F64
    looks: tuple[Looks, ...]
    length: tuple[float, ...]

    def __len__(self) -> int:
        return len(self.xyz)


def rim(mesh: Mesh) -> Rim:
    """The edges of one face of a mesh with uv and page."""
    assert mesh.uv is not None and mesh.page is not None
    a, b = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, axis=1).ravel().astype(np.int64)
    _, edge, count = np.unique(np.minimum(a, b) << 32 | np.maximum(a, b), return_index=True, return_counts=True)
    edge = np.sort(edge[count == 1])
    world = np.round((mesh.vertices.astype(np.float64) + np.asarray(mesh.frame.origin)) * GRID).astype(np.int64)
    face, corner = edge // 3, edge % 3
    uv = np.stack([mesh.uv[face, corner], mesh.uv[face, (corner + 1) % 3]], axis=1)
    return Rim(world[np.stack([a[edge], b[edge]], axis=1)], uv, mesh.page[face])


def meet(rims: Sequence[Rim], spacing: float = SPACING) -> Border:
    """Places where any two meshes meet: shared vertices, and along shared edges every `spacing` metres.

    All tiles that share a place find the same one: an edge is walked from its lesser end.
    """
    everywhere = np.concatenate([rim.ends.reshape(-1, 3) for rim in rims])
    vertex, number = np.unique(everywhere, axis=0, return_inverse=True)
    numbers = np.split(number.reshape(-1, 2), np.cumsum([len(rim.ends) for rim in rims])[:-1])
    codes = [ends.min(axis=1) * len(vertex) + ends.max(axis=1) for ends in numbers]
    corners, edges = _shared(numbers), _shared(codes)
    start, end = vertex[edges // len(vertex)] / GRID, vertex[edges % len(vertex)] / GRID
    parts = np.maximum(1, np.ceil(np.linalg.norm(end - start, axis=1) / spacing)).astype(np.int64)
    which, part = _along(parts)
    share = (part + 0.5) / parts[which]
    xyz = np.concatenate([vertex[corners] / GRID, start[which] + share[:, None] * (end - start)[which]])
    looks = tuple(_looks(*of, corners, edges, parts) for of in zip(rims, numbers, codes, strict=True))
    long = np.linalg.norm(np.diff(rims[0].ends, axis=1)[:, 0] / GRID, axis=1)
    length = tuple(float(long[np.isin(numbers[0], other).all(axis=1)].sum()) for other in numbers[1:])
    # what is shared at its ends alone is stood for by these
    half = np.where(np.isin(numbers[0], corners).all(axis=1) & ~np.isin(codes[0], edges), long / 2, 0)
    at_ends = np.bincount(numbers[0].ravel(), np.repeat(half, 2), len(vertex))[corners]
    along = (np.linalg.norm(end - start, axis=1) / parts)[which]
    return Border(xyz, np.concatenate([np.maximum(at_ends, SPACING / 2), along]), looks, length)


def _shared(names: Sequence[Index]) -> Index:
    """What at least two of the arrays contain, ascending."""
    name, count = np.unique(np.concatenate([np.unique(array) for array in names]), return_counts=True)
    return name[count > 1]


def _along(parts: Index) -> tuple[Index, Index]:
    """The parts of all edges one after another, `parts` (N,) of each: which edge, which part of it."""
    which = np.repeat(np.arange(len(parts)), parts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)


def _looks(rim: Rim, number: Index, code: Index, corners: Index, edges: Index, parts: Index) -> Looks:
    """Where a mesh shows the places of `meet`: `corners` come first, then each of `edges` in `parts` (N,)."""
    at = np.flatnonzero(np.isin(number, corners))
    rows = np.flatnonzero(np.isin(code, edges))
    edge = np.searchsorted(edges, code[rows])
    which, part = _along(parts[edge])
    place = (len(corners) + np.cumsum(parts) - parts)[edge][which] + part
    row, share = rows[which], ((part + 0.5) / parts[edge][which]).astype(np.float32)
    share = np.where(number[row, 0] <= number[row, 1], share, 1 - share)[:, None]
    return Looks(
        np.concatenate([np.searchsorted(corners, number.ravel()[at]), place]),
        np.concatenate([rim.page[at // 2], rim.page[row]]),
        np.concatenate([rim.uv.reshape(-1, 2)[at], (1 - share) * rim.uv[row, 0] + share * rim.uv[row, 1]]),
    )


def colours(looks: Looks, pages: Sequence[Path], places: int) -> F32:
    """(P, 3) grey levels that a mesh shows at the places, as a renderer looks them up; NaN where it has no such place.

    Args:
        looks: of the mesh.
        pages: image file of every page; one is in memory at a time.
        places: P.

    Raises:
        InputError: a page can't be read.
    """
    shown = np.empty((len(looks.place), 3), np.float32)
    for k in np.unique(looks.page).tolist():
        here = looks.page == k
        shown[here] = looked_up(read_page(pages[k]), looks.uv[here])
    return by_place(looks.place, shown, places)


def by_place(place: Index, shown: F32, places: int) -> F32:
    """(P, 3) means of what the looks (L, 3) at a place show; NaN where there is none."""
    total = np.stack([np.bincount(place, shown[:, k], places) for k in range(3)], axis=1)
    count = np.bincount(place, minlength=places)[:, None]
    return np.divide(total, count, out=np.full((places, 3), np.nan), where=count > 0).astype(np.float32)


def read_page(path: Path) -> U8:
    """(H, W, 3) of a texture page.

    Raises:
        InputError: it can't be read.
    """
    page = image.read_rgb(path)
    if page is None:
        raise InputError(path, "can't be read as an image", "Texture the mesh again")
    return page


def looked_up(page: U8, uv: F32) -> F32:
    """(L, 3) bilinear grey levels of a page at uv (L, 2)."""
    texel, weight = taps(uv, page.shape[1], page.shape[0])
    return np.einsum("lt,ltc->lc", weight, page.reshape(-1, 3)[texel].astype(np.float32))


def taps(uv: F32, width: int, height: int) -> tuple[Index, F32]:
    """(L, 4) texels of a bilinear lookup, counted along the rows of a page, and (L, 4) their weights."""
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
    columns = np.clip(x0.astype(np.int64)[:, None] + [0, 1, 0, 1], 0, width - 1)
    rows = np.clip(y0.astype(np.int64)[:, None] + [0, 0, 1, 1], 0, height - 1)
    weight = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)
    return rows * width + columns, weight


def border_step(a: Textured, b: Textured) -> tuple[float, float, float]:
    """The colour step between two textured meshes where they meet: (mean, 95th percentile, metres of border).

    Grey levels, absolute, over places (other ones than `level` works with) and channels; zero where they don't meet.

    Raises:
        InputError: a page can't be read.
    """
    border = meet([rim(a.mesh), rim(b.mesh)], MEASURED)
    if not len(border):
        return 0.0, 0.0, 0.0
    one, two = (colours(looks, t.pages, len(border)) for looks, t in zip(border.looks, (a, b), strict=True))
    step = np.abs(one - two)
    return float(step.mean()), float(np.percentile(step, 95)), border.length[0]


def targets(xyz: F64, shown: F32, reach: float) -> F32:
    """(P, 3) the colours that all meshes are to show at places: the mean of those that show them now.

    Where more than two meet, say A, B and C, the mean of A and B along their border leads, over `reach` metres, to
    that of all three: by how much C differs from A and B along its borders with them, close to the corner.

    Args:
        xyz: (P, 3) metres.
        shown: (T, P, 3) grey levels that the meshes show, NaN where they don't have a place.
        reach: metres.
    """
    target, has = np.nanmean(shown, axis=0), np.isfinite(shown[..., 0])
    total, bent = np.zeros(len(xyz)), np.zeros_like(target)
    nearest = np.full(len(xyz), np.inf)
    for corner in np.flatnonzero(has.sum(axis=0) > 2):
        here = has[:, corner]
        distance = np.linalg.norm(xyz - xyz[corner], axis=1)
        mine = (distance < reach) & ~has[~here].any(axis=0)  # all tiles there know all tiles of the corner
        away = _away(shown[here][:, mine], np.exp(-0.5 * (distance[mine] / (reach * BLUR)) ** 2))
        weight = 1 / (distance[mine] ** 2 + SOFT**2) ** 2
        among = has[here][:, mine]
        bent[mine] -= weight[:, None] * ((among / among.sum(axis=0)).T @ away)
        total[mine] += weight
        nearest[mine] = np.minimum(nearest[mine], distance[mine])
    near = np.maximum(0, 1 - nearest / reach)
    share = near**2 * (3 - 2 * near) / np.maximum(total, 1e-12)
    return (target + share[:, None] * bent).astype(np.float32)


def _away(shown: F32, weight: F64) -> F64:
    """(K, 3) how far each of K meshes is from their mean, by the places (K, P, 3) that they share two by two."""
    apart = shown[:, None] - shown[None]
    w = np.where(np.isfinite(apart), weight[:, None], 0)
    return ((w * np.nan_to_num(apart)).sum(axis=2) / np.maximum(w.sum(axis=2), 1e-12)).mean(axis=1)


class Changes(NamedTuple):
    """Places and the change of colour at each, in a binary tree of balls.

    Attributes:
        first, last: (N,) the places of a node; node 0 holds all.
        child: (N,) its first child, the other one follows; -1: none.
        centre, radius: (N, 3) and (N,) metres, of the ball around its places.
        length, mean: (N,) metres of border that they stand for, and (N, 3) the mean of their changes.
        xyz, metres, change: (P, 3) metres, (P,) metres of border, and (P, 3) grey levels of the places.
    """

    first: Index
    last: Index
    child: Index
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
def _distance2(a, x, y, z):  # type: ignore[no-untyped-def]
    return (a[0] - x) ** 2 + (a[1] - y) ** 2 + (a[2] - z) ** 2


@njit(cache=True)
def _nearest(tree, x, y, z, limit, stack):  # type: ignore[no-untyped-def]
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
def _change(tree, x, y, z, nearest, stack):  # type: ignore[no-untyped-def]
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
def within(tree, corners, reach):  # type: ignore[no-untyped-def]
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
def fade(rgb, owner, flat, corners, near, tree, reach):  # type: ignore[no-untyped-def]
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
        x0, y0, x1, y1 = _box(flat, f, width, height)
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
    _, label = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    texel = np.zeros(label.max() + 1, np.int32)
    painted = np.flatnonzero(empty == 0)
    texel[label.ravel()[painted]] = painted
    return texel[label]


def settle(page: U8, source: I32, uv: F32, wanted: F32) -> None:
    """Change the texels that lookups read until these give what is wanted: what texels' own places left over. In place.

    Least squares by a few rounds of simultaneous reconstruction (Andersen and Kak, 1984); a grey level or so.

    Args:
        page: (H, W, 3).
        source: (H, W) of `sources`.
        uv, wanted: (L, 2) and (L, 3) grey levels, of the lookups.
    """
    read, weight = taps(uv, page.shape[1], page.shape[0])
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
def follow(before, after, owner, source):  # type: ignore[no-untyped-def]
    """Let texels around charts that showed the colour of the nearest one in a chart (`fill.pad`) do so again.

    Args:
        before: (H, W, 3) uint8 as it was.
        after: (H, W, 3) uint8 with charts changed; changed in place.
        owner, source: (H, W) of `blend.owners` and `sources`.
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
