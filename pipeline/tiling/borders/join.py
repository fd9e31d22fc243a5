"""Joining of a mesh to its neighbours: fits its border to those of the neighbours that own them, with a smooth ramp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.geometry.common_faces import directed_edges, normals, weld_vertices
from scan2sim.pipeline.geometry.coordinate_grid import local, world
from scan2sim.pipeline.tiling.borders.clip import Clipped, stacked
from scan2sim.pipeline.tiling.borders.match_edges import match_border

MAX_UNFLIP_ROUNDS = 30
"""Iterations of smoothing that undo the flipping of faces by the displacement of the border."""


@dataclass(frozen=True)
class Joined:
    """A mesh that is joined to its neighbours.

    Attributes:
        mesh: the result.
        metrics: for every given neighbour that owns its border, see `join`.
        turned: number of faces that remain turned by more than 90 degrees.
    """

    mesh: Mesh
    metrics: dict[str, dict[str, float]]
    turned: int


def join(name: str, clips: Mapping[str, Clipped], tolerance: float, reach: float) -> Joined:
    """Fit the border of tile `name` to those of the neighbours that own theirs (whose names sort before it).

    Every vertex on a border moves to its counterpart, and edges follow the owner's curve vertex by vertex. In a
    corner all tiles use the position of the first tile (by name) that has a vertex there. The surface behind the
    border moves along with a displacement that decreases to 0 at `reach`.

    Args:
        name: name of the tile.
        clips: clipped meshes of the tile and of its existing neighbours, by name.
        tolerance: maximum displacement of a vertex, metres.
        reach: distance from the border at which the surface stays unchanged, metres.

    Returns:
        The joined mesh. Metrics for each neighbour: vertices `matched` and `unmatched`, displacement `mean_m` and
        `max_m` of matched ones, the neighbour's `edges` and how many were `followed`.
    """
    own = clips[name]
    start, positions = world(own.mesh), _with_corners(name, clips, tolerance)
    owners = [other for other in sorted(own.on) if other < name and other in clips]
    matches = {
        other: match_border(
            name, own, positions, other, clips[other], _with_corners(other, clips, tolerance), tolerance
        )
        for other in owners
    }
    for match in matches.values():
        positions[match.vertices] = match.positions
    free = ~stacked(own.on, len(start)).any(axis=1)
    moved = np.flatnonzero((positions != start).any(axis=1))
    positions[free] += _ramp(start[free], start[moved], (positions - start)[moved], reach)

    inserts = [insert for match in matches.values() for insert in match.inserts]
    faces, parent, added = _split(own.mesh.faces, inserts, len(start))
    xyz, free = np.concatenate([positions, added]), np.concatenate([free, np.zeros(len(added), bool)])
    welds = np.concatenate([np.empty((0, 2), np.int64), *(match.welds for match in matches.values())])
    faces, left, _ = weld_vertices(faces, welds, len(xyz))
    before = normals(start[own.mesh.faces[parent[left]]])
    xyz, turned = _unflip(xyz, faces, before, free)
    mesh = local(own.mesh.frame, xyz, faces).keep(np.ones(len(faces), bool))
    return Joined(mesh, {other: match.metrics for other, match in matches.items()}, turned)


def _with_corners(name: str, clips: Mapping[str, Clipped], tolerance: float) -> F64:
    """World positions (V, 3) of a mesh's vertices, with corners moved to the positions of the first tile."""
    from scipy.spatial import cKDTree

    clip = clips[name]
    xyz, names = world(clip.mesh), list(clip.on)
    on = stacked(clip.on, len(xyz))
    corner = np.flatnonzero(on.sum(axis=1) > 1)
    for flags in np.unique(on[corner], axis=0):
        left = corner[(on[corner] == flags).all(axis=1)]
        tiles = {name, *(names[k] for k in np.flatnonzero(flags))}
        for tile in sorted(tiles):
            if tile == name:  # the remaining tiles use this one's position
                break
            if tile not in clips or not tiles - {tile} <= set(clips[tile].on):
                continue
            theirs = np.logical_and.reduce([clips[tile].on[other] for other in tiles - {tile}])
            positions = world(clips[tile].mesh)[theirs]
            if len(positions) and len(left):
                distance, nearest = cKDTree(positions).query(xyz[left])
                close = distance <= tolerance
                xyz[left[close]] = positions[nearest[close]]
                left = left[~close]
    return xyz


def _ramp(xyz: F64, moved: F64, shift: F64, reach: float) -> F64:
    """Displacement (N, 3) of points `xyz` (N, 3) behind a border that fades out; border vertices `moved` (M, 3)."""
    from scipy.spatial import cKDTree

    out = np.zeros_like(xyz)
    if not len(moved):
        return out
    tree = cKDTree(moved)
    nearest, _ = tree.query(xyz, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(nearest))
    k = min(8, len(moved))  # mean of several: single vertices also move along the border, which must not propagate
    _, index = tree.query(xyz[near], k=k)
    share = 1 - nearest[near] / reach
    out[near] = shift[index.reshape(len(near), k)].mean(axis=1) * (share**2 * (3 - 2 * share))[:, None]
    return out


def _split(faces: npt.NDArray[Any], inserts: list[tuple[int, int, int, F64]], n: int) -> tuple[I64, I64, F64]:
    """Insert vertices into edges and split their faces into fans; returns faces, parent faces, new positions.

    Args:
        faces: (F, 3).
        inserts: see `BorderMatch`.
        n: number of existing vertices; new ones are numbered from there.
    """
    parts: dict[int, list[tuple[int, ...]]] = {}
    for face, a, b, positions in inserts:
        row = [a, *range(n, n + len(positions)), b]
        n += len(positions)
        fan = []
        for part in parts.get(face, [tuple(faces[face].tolist())]):
            at = next((i for i in range(3) if (part[i], part[(i + 1) % 3]) == (a, b)), None)
            fan += [part] if at is None else [(p, q, part[(at + 2) % 3]) for p, q in pairwise(row)]
        parts[face] = fan
    unsplit = np.setdiff1d(np.arange(len(faces)), list(parts))
    parent = np.array([face for face, fan in parts.items() for _ in fan], np.int64)
    split = np.array([part for fan in parts.values() for part in fan], np.int64).reshape(-1, 3)
    added = np.concatenate([np.empty((0, 3)), *(positions for *_, positions in inserts)])
    return np.concatenate([faces[unsplit].astype(np.int64), split]), np.concatenate([unsplit, parent]), added


def _unflip(xyz: F64, faces: I64, before: F64, free: Bools) -> tuple[F64, int]:
    """Unflip faces whose normals are opposite to `before` (F, 3), by Laplacian smoothing of their free vertices.

    Returns:
        Positions (V, 3), and the number of faces that remain flipped.
    """

    def turned(near: I64) -> I64:
        return near[np.einsum("ij,ij->i", normals(xyz[faces[near]]), before[near]) < 0]

    xyz = xyz.copy()
    near = np.arange(len(faces))
    for _ in range(MAX_UNFLIP_ROUNDS):
        bad = turned(near)
        at = np.zeros(len(xyz), bool)
        at[faces[bad]] = True
        at &= free
        if not at.any():
            break
        around = np.flatnonzero(at[faces].any(axis=1))
        near = np.union1d(bad, around)
        edges = directed_edges(faces[around])
        total, count = np.zeros_like(xyz), np.zeros(len(xyz))
        np.add.at(total, edges[:, 0], xyz[edges[:, 1]])
        np.add.at(count, edges[:, 0], 1)
        xyz[at] = total[at] / count[at, None]
    return xyz, len(turned(np.arange(len(faces))))
