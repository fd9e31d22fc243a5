"""Plane snapping: moves mesh vertices onto detected planes, and adds sharp edges where planes intersect.

Poisson reconstruction rounds edges. Vertices are projected onto their planes; a mesh edge between two planes gets a
vertex on their intersection, a triangle that touches three planes gets their corner (Attene et al., "Edge-Sharpener",
SGP 2003). Other parts of the mesh are not changed. Import lazily: it loads numba.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools, Mesh
from scan2sim.pipeline.geometry.planes import Planes
from scan2sim.pipeline.geometry.sorting import first_of_each, stable_argsort

NEAR_POINTS = 16
"""Number of points around a vertex whose planes are candidates."""
POINT_RADIUS_VOXELS = 2.5
"""Search radius for these points."""
ROUNDING_VOXELS = 1.5
"""Distance from an edge within which Poisson rounds it: its kernel spans three cells of half a voxel."""
MIN_FACING_COS = float(np.cos(np.radians(40.0)))
"""Smallest cosine between the normals of a vertex and of its plane."""
PLANE_MAJORITY = 0.75
"""If this part of the points around a vertex belongs to one plane, its normal deviates by noise, and the limit is:"""
MIN_NOISY_FACING_COS = float(np.cos(np.radians(75.0)))
MAX_SNAP_TOLERANCES = 1.5
"""Vertices up to one tolerance from a plane are projected onto it; up to this many tolerances, partly."""
MAX_EDGE_COS = float(np.cos(np.radians(20.0)))
"""Planes with a smaller angle have no edge."""
VERTEX_NOISE_M = 0.0005
"""Noise added to vertices: on an exact plane, quadric error metrics don't constrain decimation."""
SLIVER_VOXELS2 = 0.01
"""Faces smaller than this area (square voxels) may flip."""
UNFLIP_ROUNDS = 8
"""Maximum number of passes that move the vertices of flipped faces back."""


Edges = tuple[I64, I64]
"""Edges of a mesh, from `edges_of`."""


@dataclass(frozen=True)
class SnappedMesh:
    """A mesh snapped to planes.

    Attributes:
        mesh: the mesh, without density.
        which: (V,) plane of each vertex, -1 for none or several.
        edge: (V,) bool, True for vertices added on intersections of planes.
    """

    mesh: Mesh
    which: I32
    edge: Bools


def snap_to_planes(
    mesh: Mesh,
    edges: Edges,
    planes: Planes,
    own: I32,
    near_edge: Bools,
    weight: F64,
    ends: int,
    voxel: float,
    tolerance: float,
) -> SnappedMesh:
    """Snap a mesh to planes.

    Args:
        mesh: the mesh.
        edges: its `edges_of`.
        planes: planes of its vertices; the last ones are boundaries of others.
        own: (V,) plane of each vertex, -1 for none.
        near_edge: (V,) bool, True for vertices near a rounded edge, which are projected from any distance. Others are
            moved less beyond one `tolerance`, so that a relief of that depth blends into its plane.
        weight: (V,) blend weight of the projection.
        ends: number of the first boundary plane: the faces of its vertices are removed.
        voxel: voxel size, metres.
        tolerance: largest distance of points from their plane, metres.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    moved = vertices.copy()
    on = np.flatnonzero((own >= 0) & (own < ends))
    distance = planes.signed_distance(vertices[on], own[on])
    step = weight[on] * np.where(
        near_edge[on],
        1.0,
        np.clip((MAX_SNAP_TOLERANCES - np.abs(distance) / tolerance) / (MAX_SNAP_TOLERANCES - 1), 0, 1),
    )
    moved[on] -= (step * distance)[:, None] * planes.normal[own[on]]
    pairs, of_face = edges
    a, b = own[pairs[:, 0]], own[pairs[:, 1]]
    middle = vertices[pairs].mean(axis=1)
    crossing = np.flatnonzero((a >= 0) & (b >= 0) & (a != b))
    place, far = intersect(middle[crossing], planes, np.stack([a, b], axis=1)[crossing])
    sharp = far <= ROUNDING_VOXELS * voxel
    crossing, place = crossing[sharp], place[sharp]
    new = np.full(len(pairs), -1)
    new[crossing] = len(vertices) + np.arange(len(crossing))
    split, parent, corner = _split(faces, new[of_face], len(vertices) + len(crossing))
    three = own[faces[corner]]
    place3, far3 = intersect(vertices[faces[corner]].mean(axis=1), planes, three)
    around = np.concatenate([moved, place])[new[of_face[corner]]].mean(axis=1) if len(corner) else place3
    place3 = np.where((far3 <= ROUNDING_VOXELS * voxel)[:, None], place3, around)
    first = np.concatenate([vertices, middle[crossing], vertices[faces[corner]].mean(axis=1)])
    last = np.concatenate([moved, place, place3])
    which_of = np.concatenate([own, np.full(len(last) - len(own), -1, np.int32)]).astype(np.int32)
    kept = np.flatnonzero(~(which_of[split] >= ends).any(axis=1))
    last, _ = prevent_flips(first, last, split[kept], _cross(vertices[faces])[parent[kept]], SLIVER_VOXELS2 * voxel**2)
    left = np.zeros(len(last), bool)
    left[split[kept]] = True
    used, again = np.flatnonzero(left), (np.cumsum(left) - 1)[split[kept]]
    edge = used >= len(own)
    last[used] += np.random.default_rng(0).normal(0, VERTEX_NOISE_M, (len(used), 3))
    small = Mesh(mesh.frame, last[used].astype(np.float32), again.astype(np.int32))
    return SnappedMesh(small, which_of[used], edge)


def assign_vertices(
    mesh: Mesh, planes: Planes, xyz: F32, which: I32, voxel: float, tolerance: float
) -> tuple[I32, Bools]:
    """Plane (V,) of each vertex, -1 for none; and (V,) bool, True for vertices near an edge.

    The plane of a vertex is that of the nearest point, if the vertex lies on it and has a similar normal; near an edge
    that Poisson has rounded, it is the nearer of the two planes that meet there.
    """
    own = np.full(len(mesh.vertices), -1, np.int32)
    near_edge = np.zeros(len(own), bool)
    if not len(xyz) or not len(mesh):
        return own, near_edge
    tree = cKDTree(xyz)
    _, at = tree.query(mesh.vertices, NEAR_POINTS, distance_upper_bound=POINT_RADIUS_VOXELS * voxel, workers=-1)
    near = np.append(which, np.int32(-1))[at].astype(np.int32)
    normal = vertex_normals(mesh)
    axis, offset = np.ascontiguousarray(planes.normal), planes.offset
    vertices = mesh.vertices.astype(np.float64)
    _assign(vertices, normal, near, axis, offset, tolerance, ROUNDING_VOXELS * voxel, own, near_edge)
    return own, near_edge


def vertex_normals(mesh: Mesh) -> F64:
    """Unit normals (V, 3): area-weighted means of the face normals."""
    cross = _cross(mesh.vertices.astype(np.float64)[mesh.faces])
    total = np.stack(
        [sum(np.bincount(mesh.faces[:, k], cross[:, axis], len(mesh.vertices)) for k in range(3)) for axis in range(3)],
        axis=1,
    )
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20)


def intersect(points: F64, planes: Planes, which: npt.NDArray[np.integer]) -> tuple[F64, F64]:
    """Points (N, 3) on the intersection of planes `which` (N, K), K = 2 or 3, nearest to `points`; and distances (N,).

    Distances are infinite where the planes are almost parallel.
    """
    if not len(points):
        return points.reshape(-1, 3), np.zeros(0)
    normal = planes.normal[which]
    miss = planes.offset[which] - np.einsum("nkj,nj->nk", normal, points)
    gram = normal @ normal.transpose(0, 2, 1)
    min_area = np.linalg.eigvalsh(gram)[:, 0]
    good = min_area > 1 - MAX_EDGE_COS  # the smallest eigenvalue for two planes is 1 - |cos|
    gram[~good] = np.eye(which.shape[1])
    shift = np.einsum("nkj,nk->nj", normal, np.linalg.solve(gram, miss[:, :, None])[:, :, 0])
    return points + shift, np.where(good, np.linalg.norm(shift, axis=1), np.inf)


def prevent_flips(
    first: F64, last: F64, faces: npt.NDArray[np.integer], old_normal: F64, min_area: float
) -> tuple[F64, Bools]:
    """Vertices at `last` (V, 3), but at `first` where a face would flip; and (V,) bool, True for the latter.

    Old normals `old_normal` (F, 3) have twice the area as length; faces below `min_area` m2 may flip, as their normal
    is not meaningful.
    """
    heavy = np.linalg.norm(old_normal, axis=1) > 2 * min_area
    faces, old_normal = faces[heavy], old_normal[heavy]
    last = last.copy()
    stayed = np.zeros(len(first), bool)
    changed = np.arange(len(faces))
    for _ in range(UNFLIP_ROUNDS):
        now = _cross(last[faces[changed]])
        size = np.linalg.norm(now, axis=1)
        over = ((now * old_normal[changed]).sum(axis=1) < 0) & (size > 2 * min_area)
        back = np.unique(faces[changed[over]])
        back = back[~stayed[back]]
        if not len(back):
            break
        last[back], stayed[back] = first[back], True
        put = np.zeros(len(first), bool)
        put[back] = True
        changed = np.flatnonzero(put[faces].any(axis=1))  # only these faces changed
    return last, stayed


def border_vertices(edges: Edges) -> I64:
    """Indices of the vertices on the border of a mesh."""
    pairs, of_face = edges
    return np.unique(pairs[np.bincount(of_face.ravel(), minlength=len(pairs)) == 1])


@njit(cache=True, parallel=True)
def _assign(
    xyz: F64,
    normal: F64,
    near: I32,
    axis: F64,
    offset: F64,
    tolerance: float,
    rounded: float,
    own: I32,
    near_edge: Bools,
) -> None:
    for i in prange(len(xyz)):
        seen = np.empty(4, np.int32)
        count = 0
        for p in near[i]:
            known = p < 0
            for k in range(count):
                known = known or seen[k] == p
            if not known and count < 4:
                seen[count] = p
                count += 1
        away = np.empty(4)
        for k in range(count):
            away[k] = -offset[seen[k]]
            for m in range(3):
                away[k] += axis[seen[k], m] * xyz[i, m]
        # near an edge
        best = rounded
        for k in range(count):
            for m in range(k + 1, count):
                c = 0.0
                for q in range(3):
                    c += axis[seen[k], q] * axis[seen[m], q]
                if abs(c) < MAX_EDGE_COS:
                    a, b = away[k], away[m]
                    far = np.sqrt(max(0.0, (a * a + b * b - 2 * a * b * c) / (1 - c * c)))
                    if far < best:
                        best = far
                        own[i] = seen[k] if abs(a) <= abs(b) else seen[m]
                        near_edge[i] = True
        if own[i] >= 0:
            continue
        for k in range(count):
            if abs(away[k]) <= MAX_SNAP_TOLERANCES * tolerance:
                most = 0
                for p in near[i]:
                    most += p == seen[k]
                amid = abs(away[k]) <= tolerance and most >= PLANE_MAJORITY * len(near[i])
                facing = 0.0
                for q in range(3):
                    facing += axis[seen[k], q] * normal[i, q]
                if facing > (MIN_NOISY_FACING_COS if amid else MIN_FACING_COS):
                    own[i] = seen[k]
                    break


def edges_of(mesh: Mesh) -> Edges:
    """Edges (E, 2), and the edges (F, 3) of each face: from its first, second and third corner."""
    faces = mesh.faces.astype(np.int64)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    side = int(faces.max(initial=0)) + 1
    order, code = stable_argsort(ends.min(axis=1) * side + ends.max(axis=1))
    first = first_of_each(code)
    of_face = np.empty(len(ends), np.int64)
    of_face[order] = np.cumsum(first) - 1
    return np.stack([code[first] // side, code[first] % side], axis=1), of_face.reshape(-1, 3)


def _split(faces: I64, new: I64, count: int) -> tuple[I64, I64, I64]:
    """Split faces (F, 3) at the new vertices of their edges (F, 3), -1 for none.

    A face with three new vertices also gets one in its middle, numbered from `count` on.

    Returns:
        Faces; the original face of each; and the faces with a middle vertex, in order of its number.
    """
    cuts = (new >= 0).sum(axis=1)
    parts, parents = [faces[cuts == 0]], [np.flatnonzero(cuts == 0)]

    def add(of: I64, *corners: I64) -> None:
        parts.append(np.stack(corners, axis=1))
        parents.append(of)

    def rotated(of: I64, by: I64) -> tuple[I64, ...]:
        """Corners and new vertices, starting with corner `by`."""
        order = (by[:, None] + np.arange(3)) % 3
        v, e = np.take_along_axis(faces[of], order, 1), np.take_along_axis(new[of], order, 1)
        return (*v.T, *e.T)

    one = np.flatnonzero(cuts == 1)
    a, b, c, ab, _, _ = rotated(one, np.argmax(new[one] >= 0, axis=1))
    add(one, a, ab, c)
    add(one, ab, b, c)
    two = np.flatnonzero(cuts == 2)
    a, b, c, ab, _, ca = rotated(two, (np.argmax(new[two] < 0, axis=1) + 2) % 3)  # both cuts meet at corner a
    add(two, a, ab, ca)
    add(two, ab, b, ca)
    add(two, b, c, ca)
    three = np.flatnonzero(cuts == 3)
    a, b, c, ab, bc, ca = rotated(three, np.zeros(len(three), np.int64))
    m = count + np.arange(len(three))
    for p, q in ((a, ab), (ab, b), (b, bc), (bc, c), (c, ca), (ca, a)):
        add(three, p, q, m)
    return np.concatenate(parts), np.concatenate(parents), three


def _cross(corners: F64) -> F64:
    """Normals (F, 3) of triangles (F, 3, 3), with twice the area as length."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    out = np.empty_like(a)
    for k in range(3):  # np.cross takes three times as long
        i, j = (k + 1) % 3, (k + 2) % 3
        out[:, k] = a[:, i] * b[:, j] - a[:, j] * b[:, i]
    return out
