"""Faces at a border: their edges and normals, and vertices that become one."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools


def normals(corners: F64) -> F64:
    """(F, 3) normals of corners (F, 3, 3), as long as twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def directed_edges(faces: npt.NDArray[Any]) -> I64:
    """(3 F, 2) directed edges: those from every face's first corner, then those from its second, then its third."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)


def welded(faces: I64, pairs: I64, n: int) -> tuple[I64, Bools, I64]:
    """Make vertices one that `pairs` (P, 2) say are; of `n` in all.

    Returns:
        The faces that are left (K, 3), which they are (F,), and (n,) what each vertex has become: the lowest of all
        that hang together. Faces go that have lost an edge, and those that have come to lie on each other.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(pairs):
        return faces, np.ones(len(faces), bool), np.arange(n)
    _, piece = connected_components(coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(n, n)), directed=False)
    _, first = np.unique(piece, return_index=True)
    weld = first[piece]
    touched = np.isin(weld, weld[pairs])[faces].any(axis=1)
    faces = weld[faces]
    left = np.all(faces != np.roll(faces, 1, axis=1), axis=1)
    here = np.flatnonzero(touched & left)
    _, index, count = np.unique(np.sort(faces[here], axis=1), axis=0, return_inverse=True, return_counts=True)
    left[here[count[index.ravel()] > 1]] = False
    return faces[left], left, weld
