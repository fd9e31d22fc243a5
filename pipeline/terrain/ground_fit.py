"""Ground fit: adjusts the heights of a simplified ground mesh's vertices to the cloud.

Robust least squares over all points near the mesh: the height of a point is interpolated linearly from the corners of
its triangle. Changes of slope between neighbouring triangles are penalized, so that the slope continues where there
are no points.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, Bools, Mesh
from scan2sim.pipeline.geometry.common_faces import directed_edges

POINT_SIGMA_M = 0.02
"""Standard deviation of points, and threshold of the Huber loss (Huber 1964)."""
SLOPE_CHANGE_SIGMA = 0.15
"""Standard deviation of changes of slope; that of a kerb is 1, but it is supported by many points."""
HEIGHT_PRIOR_SIGMA_M = 0.1
"""Standard deviation of vertices from their old height; decisive only where there are no other constraints."""
MAX_POINT_DISTANCE_M = 0.15
"""Points farther from the mesh are not ground."""
MIN_NORMAL_Z = 0.5
"""Smallest |nz| of triangles whose heights are fitted."""
REWEIGHTING_ROUNDS = 4


def fit_heights(mesh: Mesh, points: F32, fixed: Bools) -> Mesh:
    """Fit the heights of a ground mesh to `points`; horizontal positions and triangles are not changed.

    Args:
        mesh: ground mesh.
        points: (N, 3) ground points, local metres.
        fixed: (V,) bool, True for vertices that must not move.
    """
    from scipy.sparse import csr_matrix, diags, vstack
    from scipy.sparse.linalg import spsolve

    free = np.flatnonzero(~fixed)
    if not len(points) or not len(free):
        return mesh
    start = mesh.vertices[:, 2].astype(np.float64)
    face, barycentric, above = heights_above_ground(mesh, points)
    count = len(face)
    data = csr_matrix(
        (barycentric.ravel(), (np.repeat(np.arange(count), 3), mesh.faces[face].ravel())), (count, len(start))
    )
    target = data @ start + above
    rows = vstack(
        [
            data / POINT_SIGMA_M,
            _slope_changes(mesh) / SLOPE_CHANGE_SIGMA,
            diags(np.full(len(start), 1 / HEIGHT_PRIOR_SIGMA_M)),
        ]
    ).tocsc()
    rhs = np.concatenate(
        [target / POINT_SIGMA_M, np.zeros(rows.shape[0] - len(target) - len(start)), start / HEIGHT_PRIOR_SIGMA_M]
    )
    own, rest = rows[:, free], rhs - rows[:, np.flatnonzero(fixed)] @ start[fixed]
    z, weight = start.copy(), np.ones(len(rhs))
    for _ in range(REWEIGHTING_ROUNDS):
        weighted = own.T @ diags(weight)
        z[free] = spsolve((weighted @ own).tocsc(), weighted @ rest)
        off = np.abs(target / POINT_SIGMA_M - (data / POINT_SIGMA_M) @ z)
        weight[: len(target)] = 1 / np.maximum(1, off)
    vertices = mesh.vertices.copy()
    vertices[free, 2] = z[free]
    return Mesh(mesh.frame, vertices, mesh.faces)


def heights_above_ground(mesh: Mesh, points: F32) -> tuple[I64, F64, F64]:
    """Triangles above or below points near a ground mesh, with barycentric coordinates and height differences.

    Args:
        mesh: ground mesh.
        points: (N, 3) local metres.

    Returns:
        For the M points within `MAX_POINT_DISTANCE_M` of a triangle: triangles (M,), barycentric coordinates (M, 3),
        and heights (M,) of the points above them in metres.
    """
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices, mesh.faces.astype(np.uint32))
    closest = scene.compute_closest_points(points.astype(np.float32))
    face = closest["primitive_ids"].numpy().astype(np.int64)
    corners = mesh.corners.astype(np.float64)
    barycentric = _barycentric(corners[face], points[:, :2].astype(np.float64))
    above = points[:, 2] - np.einsum("nk,nk->n", barycentric, corners[face][..., 2])
    inside = (
        (barycentric > -1e-3).all(axis=1)
        & (np.abs(mesh.face_normal[face, 2]) > MIN_NORMAL_Z)
        & (np.abs(above) < MAX_POINT_DISTANCE_M)
    )
    return face[inside], barycentric[inside], above[inside]


def _barycentric(corners: F64, xy: F64) -> F64:
    """Barycentric coordinates (N, 3), in plan view, of points (N, 2) in triangles (N, 3, 3)."""
    a, b, c = np.moveaxis(corners[..., :2], 1, 0)
    area = np.maximum(np.abs(_cross(b - a, c - a)), 1e-12) * np.sign(_cross(b - a, c - a) + 1e-30)
    first, second = _cross(b - xy, c - xy) / area, _cross(c - xy, a - xy) / area
    return np.stack([first, second, 1 - first - second], axis=1)


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _slope_changes(mesh: Mesh) -> Any:
    """Matrix (E, V) from heights to changes of slope across inner edges between triangles that are not steep."""
    from scipy.sparse import csr_matrix

    edges = np.sort(directed_edges(mesh.faces), axis=1)
    face = np.tile(np.arange(len(mesh)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, face = edges[order], face[order]
    same = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    first, second, edge = face[same], face[same + 1], edges[same]
    flat = np.abs(mesh.face_normal[:, 2]) > MIN_NORMAL_Z
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
    """Derivatives (N, 3) of triangles' slopes in directions (N, 2) by the heights of their corners (N, 3, 2)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    area = _cross(b - a, c - a)
    opposite = np.stack([c - b, a - c, b - a], axis=1)
    gradient = np.stack([-opposite[..., 1], opposite[..., 0]], axis=2) / area[:, None, None]
    return np.einsum("nkd,nd->nk", gradient, direction)
