"""Edges and normals of faces, and welding of vertices."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools


def normals(corners: F64) -> F64:
    """Normals (F, 3) of triangles with corners (F, 3, 3); their length is twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def directed_edges(faces: npt.NDArray[Any]) -> I64:
    """Directed edges (3 F, 2): those from the first corner of every face, then from the second, then from the third."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)


def weld_vertices(faces: I64, pairs: I64, n: int) -> tuple[I64, Bools, I64]:
    """Weld the `pairs` (P, 2) of vertices, of `n` in all.

    Returns:
        The remaining faces (K, 3), a mask (F,) of them, and the vertex (n,) that each vertex was welded to: the lowest
        index of its connected group. Degenerate faces, and faces that coincide after welding, are removed.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(pairs):
        return faces, np.ones(len(faces), bool), np.arange(n)
    _, group = connected_components(coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(n, n)), directed=False)
    _, first = np.unique(group, return_index=True)
    weld = first[group]
    touched = np.isin(weld, weld[pairs])[faces].any(axis=1)
    faces = weld[faces]
    left = np.all(faces != np.roll(faces, 1, axis=1), axis=1)
    candidates = np.flatnonzero(touched & left)
    _, index, count = np.unique(np.sort(faces[candidates], axis=1), axis=0, return_inverse=True, return_counts=True)
    left[candidates[count[index.ravel()] > 1]] = False
    return faces[left], left, weld
