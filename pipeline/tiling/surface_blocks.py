"""Surfaces that are reconstructed in blocks: partition of the points, and one watertight mesh from the blocks' meshes.

Blocks are vertical columns whose walls are faces of octree cells. An iso-surface has its vertices on the edges of
these cells, and no triangle crosses a wall: cut at the walls, the meshes of adjacent blocks end in almost the same
curve.
"""

from __future__ import annotations

from collections import defaultdict
from heapq import heapify, heappop, heappush
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools
from scan2sim.pipeline.geometry.boundary_curve import curve
from scan2sim.pipeline.geometry.common_faces import directed_edges

MIN_WIDTH = 2  # of a block, in multiples of the grid's spacing
MIN_SHARE = 0.25  # of the points on either side of a cut
ON_WALL_M = 1e-3
COINCIDENT_CELLS = 0.25  # vertices nearer than this are one, whichever cell edges they lie on


class Block(NamedTuple):
    """A rectangle in plan; infinite at the outside.

    Attributes:
        low, high: (x, y) limits, local metres; `low` belongs to the block.
    """

    low: tuple[float, float] = (-np.inf, -np.inf)
    high: tuple[float, float] = (np.inf, np.inf)

    def inside(self, xy: F32 | F64, margin: float = 0.0) -> Bools:
        """Whether points (N, 2) are in the block, enlarged by a margin."""
        return np.asarray(((xy >= np.array(self.low) - margin) & (xy < np.array(self.high) + margin)).all(axis=1))


class Surface(NamedTuple):
    """A mesh: vertices (V, 3) in metres, faces (F, 3), and octree depth (V,) of the points near each vertex."""

    vertices: F32
    faces: I32
    density: F32


def partition(xy: F64, spacing: float, offset: F64, margin: float, max_points: int) -> list[Block]:
    """Blocks of at most `max_points` points, if they can be cut so; the same for the same points.

    Each cut is the one that has the fewest points within the margin, which both sides need.

    Args:
        xy: (N, 2) points, local metres.
        spacing: spacing of the walls' grid in metres.
        offset: (2,) a grid point, local metres.
        margin: metres by which a block's points extend beyond its walls.
        max_points: number of points up to which a block is not cut.
    """
    return _cut(Block(), xy, spacing, offset, margin, max_points)


def _cut(block: Block, xy: F64, spacing: float, offset: F64, margin: float, max_points: int) -> list[Block]:
    best: tuple[int, int, float] | None = None
    for axis in (0, 1) if len(xy) > max_points else ():
        values = np.sort(xy[:, axis])
        first, last = (np.array([values[0], values[-1]]) - offset[axis]) / spacing
        positions = offset[axis] + spacing * np.arange(np.ceil(first + MIN_WIDTH), np.floor(last - MIN_WIDTH) + 1)
        below, near_low, near_high = (np.searchsorted(values, positions + shift) for shift in (0, -margin, margin))
        balanced = np.abs(below / len(values) - 0.5) <= 0.5 - MIN_SHARE
        for position, shared in zip(positions[balanced], (near_high - near_low)[balanced], strict=True):
            best = min(best or (len(xy), 0, 0.0), (int(shared), axis, float(position)))
    if best is None or best[0] == len(xy):
        return [block]
    _, axis, position = best
    low, high = list(block.low), list(block.high)
    low[axis] = high[axis] = position
    sides = block._replace(high=(high[0], high[1])), block._replace(low=(low[0], low[1]))
    below = xy[:, axis] < position
    return [
        leaf
        for side, own in zip(sides, (below, ~below), strict=True)
        for leaf in _cut(side, xy[own], spacing, offset, margin, max_points)
    ]


def crop(surface: Surface, block: Block) -> Surface:
    """The part of a surface within its block."""
    centre = surface.vertices[:, :2][surface.faces].mean(axis=1)
    used, faces = np.unique(surface.faces[block.inside(centre)], return_inverse=True)
    return Surface(surface.vertices[used], faces.reshape(-1, 3).astype(np.int32), surface.density[used])


def stitch(surfaces: list[Surface], blocks: list[Block], cell: float) -> Surface:
    """One surface from those of adjacent blocks, cropped to them.

    Border vertices of two blocks that are each other's nearest, and nearer than a cell, become one. The remaining gaps,
    where the borders cross different cell edges, are closed curves, which are filled.

    Args:
        surfaces: surface of each block.
        blocks: the blocks.
        cell: finest cell in metres.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    first = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    vertices = np.concatenate([s.vertices for s in surfaces]).astype(np.float64)
    density = np.concatenate([s.density for s in surfaces]).astype(np.float64)
    faces = np.concatenate([s.faces + start for s, start in zip(surfaces, first[:-1], strict=True)]).astype(np.int64)
    borders = [start + _border(s, b) for s, b, start in zip(surfaces, blocks, first[:-1], strict=True)]
    trees = [cKDTree(vertices[border]) for border in borders]
    links = [np.empty((0, 2), np.int64)]
    for i, own in enumerate(borders):
        for j in range(i + 1, len(borders)):
            other = borders[j]
            if not _touch(blocks[i], blocks[j]) or not len(own) or not len(other):
                continue
            to_other, nearest = trees[j].query(vertices[own], distance_upper_bound=cell)
            to_own, back = trees[i].query(vertices[other], distance_upper_bound=cell)
            found = np.isfinite(to_other)
            mutual = found & (np.append(back, -1)[nearest] == np.arange(len(own)))
            keep = mutual | (to_other < COINCIDENT_CELLS * cell)
            also = to_own < COINCIDENT_CELLS * cell
            links.append(np.column_stack([own[keep], other[nearest[keep]]]))
            links.append(np.column_stack([own[back[also]], other[also]]))
    a, b = np.concatenate(links).T
    n = len(vertices)
    count, cluster = connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(n, n)), directed=False)
    weight = np.bincount(cluster, minlength=count)
    mean = [np.bincount(cluster, column, count) / weight for column in (*vertices.T, density)]
    faces = cluster[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    on_border = np.zeros(count, bool)
    on_border[cluster[np.concatenate(borders)]] = True
    vertices = np.column_stack(mean[:3])
    fillings = [_fill(loop, vertices) for loop in _loops(_boundary(faces, on_border))]
    faces = np.concatenate([faces, *fillings])
    return Surface(vertices.astype(np.float32), faces.astype(np.int32), mean[3].astype(np.float32))


def _border(surface: Surface, block: Block) -> I64:
    """Indices of vertices on open edges along the block's walls."""
    xy = surface.vertices[:, :2].astype(np.float64)
    to_wall = np.minimum(np.abs(xy - block.low), np.abs(xy - block.high)).min(axis=1)
    return np.unique(curve(surface.faces, to_wall < ON_WALL_M).edges).astype(np.int64)


def _boundary(faces: I64, on: Bools) -> I64:
    """Directed edges (E, 2) between vertices `on` a border that more faces have in this direction than in the other."""
    edges = directed_edges(faces[on[faces].sum(axis=1) > 1])
    edges = edges[on[edges].all(axis=1)]
    key, which = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    net = np.bincount(which.ravel(), np.where(edges[:, 0] < edges[:, 1], 1, -1), len(key)).astype(np.int64)
    return np.repeat(np.where(net[:, None] > 0, key, key[:, ::-1]), np.abs(net), axis=0)


def _touch(a: Block, b: Block) -> bool:
    return all(a.low[k] <= b.high[k] and b.low[k] <= a.high[k] for k in (0, 1))


def _loops(edges: I64) -> list[list[int]]:
    """Simple closed curves along open edges (E, 2), against their direction.

    Curves that end where the octree's cube does, far from all points, are closed from end to end.
    """
    after: dict[int, list[int]] = defaultdict(list)
    excess: dict[int, int] = defaultdict(int)
    for a, b in edges.tolist():
        after[b].append(a)
        excess[b] += 1
        excess[a] -= 1
    loops = []
    for start in sorted(excess, key=lambda vertex: (-excess[vertex], vertex)):
        path, position = [start], {start: 0}
        while after[path[-1]]:
            vertex = after[path[-1]].pop()
            if vertex in position:
                loop = path[position[vertex] :]
                loops.append(loop)
                for passed in loop[1:]:
                    del position[passed]
                del path[position[vertex] + 1 :]
            else:
                position[vertex] = len(path)
                path.append(vertex)
        loops.append(path)
    return [loop for loop in loops if len(loop) > 2]


def _fill(loop: list[int], vertices: F64) -> I64:
    """Triangles (K, 3) that close a loop; the shortest diagonal first, so that two curves side by side are zipped."""
    n = len(loop)
    before, after = [(i - 1) % n for i in range(n)], [(i + 1) % n for i in range(n)]
    xyz = vertices[loop]

    def diagonal(i: int) -> tuple[float, int, int, int]:
        return float(np.linalg.norm(xyz[before[i]] - xyz[after[i]])), i, before[i], after[i]

    queue = [diagonal(i) for i in range(n)]
    heapify(queue)
    triangles: list[tuple[int, int, int]] = []
    alive = [True] * n
    while len(triangles) < n - 2:
        _, i, a, b = heappop(queue)
        if not alive[i] or (before[i], after[i]) != (a, b):
            continue
        triangles.append((loop[a], loop[i], loop[b]))
        alive[i] = False
        after[a], before[b] = b, a
        heappush(queue, diagonal(a))
        heappush(queue, diagonal(b))
    return np.array(triangles, np.int64).reshape(-1, 3)
