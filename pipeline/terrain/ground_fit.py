"""Ground's heights: the vertices of a light mesh moved up or down to where its triangles fit the cloud best.

Least squares over all points near the mesh: each one's height is that of its triangle there, linear in the heights of
the corners. Where there are no points the slope goes on: changes of slope between neighbouring triangles cost, too.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools, Mesh
from scan2sim.pipeline.tiling.borders.common_faces import directed_edges

NOISE = 0.02
"""Metres: points' noise, from which on (Huber 1964) they count less."""
BEND = 0.15
"""Change of slope that weighs as much as `NOISE` does: a kerb's is 1, but many points hold it."""
HELD = 0.1
"""Metres that a vertex may lie off its old height for as much: only where nothing else holds it."""
NEAR = 0.15
"""Metres between a point and the mesh beyond which it is no ground's."""
UPRIGHT = 0.5
"""|nz| from which on a triangle has heights that points tell."""
ROUNDS = 4


def fitted(mesh: Mesh, points: F32, fixed: Bools) -> Mesh:
    """A ground's mesh with its heights fitted to `points`; its plan and its triangles stay.

    Args:
        mesh: of the ground.
        points: (N, 3) of the ground, local metres.
        fixed: (V,) vertices that stay where they are.
    """
    from scipy.sparse import csr_matrix, diags, vstack
    from scipy.sparse.linalg import spsolve

    free = np.flatnonzero(~fixed)
    if not len(points) or not len(free):
        return mesh
    start = mesh.vertices[:, 2].astype(np.float64)
    face, shares, above = off_ground(mesh, points)
    count = len(face)
    data = csr_matrix((shares.ravel(), (np.repeat(np.arange(count), 3), mesh.faces[face].ravel())), (count, len(start)))
    target = data @ start + above
    rows = vstack([data / NOISE, _bends(mesh) / BEND, diags(np.full(len(start), 1 / HELD))]).tocsc()
    wanted = np.concatenate([target / NOISE, np.zeros(rows.shape[0] - len(target) - len(start)), start / HELD])
    own, rest = rows[:, free], wanted - rows[:, np.flatnonzero(fixed)] @ start[fixed]
    z, weight = start.copy(), np.ones(len(wanted))
    for _ in range(ROUNDS):
        weighted = own.T @ diags(weight)
        z[free] = spsolve((weighted @ own).tocsc(), weighted @ rest)
        off = np.abs(target / NOISE - (data / NOISE) @ z)
        weight[: len(target)] = 1 / np.maximum(1, off)
    vertices = mesh.vertices.copy()
    vertices[free, 2] = z[free]
    return Mesh(mesh.frame, vertices, mesh.faces)


def off_ground(mesh: Mesh, points: F32) -> tuple[I64, F64, F64]:
    """Which triangles points near a ground's mesh lie over or under, where in them, and how far off.

    Args:
        mesh: of the ground.
        points: (N, 3) local metres.

    Returns:
        Of the M points that have one within `NEAR`: triangles (M,), shares of their three corners (M, 3), and heights
        (M,) of the points above them in metres.
    """
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices, mesh.faces.astype(np.uint32))
    closest = scene.compute_closest_points(points.astype(np.float32))
    face = closest["primitive_ids"].numpy().astype(np.int64)
    corners = mesh.corners.astype(np.float64)
    shares = _shares(corners[face], points[:, :2].astype(np.float64))
    above = points[:, 2] - np.einsum("nk,nk->n", shares, corners[face][..., 2])
    inside = (shares > -1e-3).all(axis=1) & (np.abs(mesh.face_normal[face, 2]) > UPRIGHT) & (np.abs(above) < NEAR)
    return face[inside], shares[inside], above[inside]


def _shares(corners: F64, xy: F64) -> F64:
    """(N, 3) barycentric coordinates on the plan of places (N, 2) in triangles (N, 3, 3)."""
    a, b, c = np.moveaxis(corners[..., :2], 1, 0)
    area = np.maximum(np.abs(_cross(b - a, c - a)), 1e-12) * np.sign(_cross(b - a, c - a) + 1e-30)
    first, second = _cross(b - xy, c - xy) / area, _cross(c - xy, a - xy) / area
    return np.stack([first, second, 1 - first - second], axis=1)


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _bends(mesh: Mesh) -> Any:
    """Rows (E, V) that give the change of slope across inner edges, where neither triangle is steep."""
    from scipy.sparse import csr_matrix

    edges = np.sort(directed_edges(mesh.faces), axis=1)
    face = np.tile(np.arange(len(mesh)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, face = edges[order], face[order]
    same = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    first, second, edge = face[same], face[same + 1], edges[same]
    flat = np.abs(mesh.face_normal[:, 2]) > UPRIGHT
    keep = flat[first] & flat[second]
    first, second, edge = first[keep], second[keep], edge[keep]
    corners = mesh.corners[..., :2].astype(np.float64)
    along = mesh.vertices[edge[:, 1], :2].astype(np.float64) - mesh.vertices[edge[:, 0], :2]
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    parts = [sign * _slopes(corners[f], across) for f, sign in ((first, 1.0), (second, -1.0))]
    row = np.repeat(np.arange(len(first)), 3)
    column = np.concatenate([mesh.faces[f].ravel() for f in (first, second)])
    values = np.concatenate([part.ravel() for part in parts])
    return csr_matrix((values, (np.tile(row, 2), column)), shape=(len(first), len(mesh.vertices)))


def _slopes(corners: F64, direction: F64) -> F64:
    """(N, 3) what heights of the corners (N, 3, 2) add to triangles' slopes in directions (N, 2)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    area = _cross(b - a, c - a)
    opposite = np.stack([c - b, a - c, b - a], axis=1)
    gradient = np.stack([-opposite[..., 1], opposite[..., 0]], axis=2) / area[:, None, None]
    return np.einsum("nkd,nd->nk", gradient, direction)
