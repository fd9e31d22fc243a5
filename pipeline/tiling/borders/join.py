"""Join: a mesh's border fitted to those of the neighbours that own theirs, and the surface behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.tiling.borders.clip import Clipped, stacked
from scan2sim.pipeline.tiling.borders.common_faces import directed_edges, normals, welded
from scan2sim.pipeline.tiling.borders.grid import local, world
from scan2sim.pipeline.tiling.borders.match_edges import follow

ROUNDS = 30
"""Tries at turning back the faces that moving the border has turned over."""


@dataclass(frozen=True)
class Joined:
    """A mesh that meets its neighbours.

    Attributes:
        mesh: the result.
        facts: for every neighbour that was given and owns its border: see `join`.
        turned: faces that the move has turned by more than a right angle, for good.
    """

    mesh: Mesh
    facts: dict[str, dict[str, float]]
    turned: int


def join(name: str, clips: Mapping[str, Clipped], tolerance: float, reach: float) -> Joined:
    """Fit the border of tile `name` to those of its neighbours that own theirs: whose names sort before it.

    Every vertex on a border is moved to its counterpart there, and edges follow the owner's, vertex for vertex.
    In a corner all tiles go to where the first of them (by name) that has a vertex there has it. The surface behind
    the border goes with it, ever less up to `reach`: a ramp, no step.

    Args:
        name: of the tile.
        clips: of the tile and of those neighbours that there are, by name.
        tolerance: metres that a vertex may be moved.
        reach: metres from the border at which the surface stays as it was.

    Returns:
        With facts for each neighbour: vertices `matched` and `unmatched`, `mean_m` and `max_m` that matched ones
        moved, and the `edges` that were `followed` of the neighbour's `edges`.
    """
    own = clips[name]
    start, places = world(own.mesh), _cornered(name, clips, tolerance)
    owners = [other for other in sorted(own.on) if other < name and other in clips]
    follows = {
        other: follow(name, own, places, other, clips[other], _cornered(other, clips, tolerance), tolerance)
        for other in owners
    }
    for way in follows.values():
        places[way.vertices] = way.places
    free = ~stacked(own.on, len(start)).any(axis=1)
    moved = np.flatnonzero((places != start).any(axis=1))
    places[free] += _ramp(start[free], start[moved], (places - start)[moved], reach)

    faces, parent, added = _split(own.mesh.faces, [i for f in follows.values() for i in f.inserts], len(start))
    xyz, free = np.concatenate([places, added]), np.concatenate([free, np.zeros(len(added), bool)])
    welds = np.concatenate([np.empty((0, 2), np.int64), *(f.welds for f in follows.values())])
    faces, left, _ = welded(faces, welds, len(xyz))
    before = normals(start[own.mesh.faces[parent[left]]])
    xyz, turned = _turned_back(xyz, faces, before, free)
    mesh = local(own.mesh.frame, xyz, faces).keep(np.ones(len(faces), bool))
    return Joined(mesh, {other: way.facts for other, way in follows.items()}, turned)


def _cornered(name: str, clips: Mapping[str, Clipped], tolerance: float) -> F64:
    """(V, 3) world places of a clip's vertices, those in corners where the first tile has them."""
    from scipy.spatial import cKDTree

    clip = clips[name]
    xyz, names = world(clip.mesh), list(clip.on)
    on = stacked(clip.on, len(xyz))
    corner = np.flatnonzero(on.sum(axis=1) > 1)
    for flags in np.unique(on[corner], axis=0):
        left = corner[(on[corner] == flags).all(axis=1)]
        tiles = {name, *(names[k] for k in np.flatnonzero(flags))}
        for tile in sorted(tiles):
            if tile == name:  # the others go to where this one has it
                break
            if tile not in clips or not tiles - {tile} <= set(clips[tile].on):
                continue
            theirs = np.logical_and.reduce([clips[tile].on[other] for other in tiles - {tile}])
            places = world(clips[tile].mesh)[theirs]
            if len(places) and len(left):
                distance, nearest = cKDTree(places).query(xyz[left])
                close = distance <= tolerance
                xyz[left[close]] = places[nearest[close]]
                left = left[~close]
    return xyz


def _ramp(xyz: F64, moved: F64, shift: F64, reach: float) -> F64:
    """(N, 3) by which the places `xyz` (N, 3) behind a border go with its vertices `moved` (M, 3): less and less."""
    from scipy.spatial import cKDTree

    out = np.zeros_like(xyz)
    if not len(moved):
        return out
    tree = cKDTree(moved)
    nearest, _ = tree.query(xyz, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(nearest))
    k = min(8, len(moved))  # the mean of a few: single ones also move along the border, from vertex to vertex
    _, index = tree.query(xyz[near], k=k)
    share = 1 - nearest[near] / reach
    out[near] = shift[index.reshape(len(near), k)].mean(axis=1) * (share**2 * (3 - 2 * share))[:, None]
    return out


def _split(faces: npt.NDArray[Any], inserts: list[tuple[int, int, int, F64]], n: int) -> tuple[I64, I64, F64]:
    """Faces with vertices inserted into their edges, as fans; the face each comes from; the new vertices' places.

    Args:
        faces: (F, 3).
        inserts: see `Follow`.
        n: vertices so far; the new ones are numbered on.
    """
    parts: dict[int, list[tuple[int, ...]]] = {}
    for face, a, b, places in inserts:
        row = [a, *range(n, n + len(places)), b]
        n += len(places)
        fan = []
        for part in parts.get(face, [tuple(faces[face].tolist())]):
            at = next((i for i in range(3) if (part[i], part[(i + 1) % 3]) == (a, b)), None)
            fan += [part] if at is None else [(p, q, part[(at + 2) % 3]) for p, q in pairwise(row)]
        parts[face] = fan
    whole = np.setdiff1d(np.arange(len(faces)), list(parts))
    parent = np.array([face for face, fan in parts.items() for _ in fan], np.int64)
    split = np.array([part for fan in parts.values() for part in fan], np.int64).reshape(-1, 3)
    added = np.concatenate([np.empty((0, 3)), *(places for *_, places in inserts)])
    return np.concatenate([faces[whole].astype(np.int64), split]), np.concatenate([whole, parent]), added


def _turned_back(xyz: F64, faces: I64, before: F64, free: Bools) -> tuple[F64, int]:
    """Turn back faces that don't look as `before` (F, 3): their free vertices go to the middle of their neighbours.

    Returns:
        Places (V, 3), and how many faces stayed turned.
    """

    def turned(near: I64) -> I64:
        return near[np.einsum("ij,ij->i", normals(xyz[faces[near]]), before[near]) < 0]

    xyz = xyz.copy()
    near = np.arange(len(faces))
    for _ in range(ROUNDS):
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
