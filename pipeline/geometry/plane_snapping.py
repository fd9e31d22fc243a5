"""A mesh brought to the planes that its points lie on, with the edges in which planes intersect.

Poisson rounds what is sharp. Vertices are laid onto their planes; an edge of the mesh that goes from one plane to
another gets a vertex where both intersect, a triangle that touches three gets their corner (Attene et al.,
"Edge-Sharpener", SGP 2003). What no plane explains stays as it is. Import late: it loads numba.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools, Mesh
from scan2sim.pipeline.geometry.planes import Planes
from scan2sim.pipeline.geometry.sorting import first_of_each, ordered

NEAR = 16
"""Points around a vertex whose planes it may lie on."""
REACH = 2.5
"""Voxels within which they are searched for."""
ROUNDED = 1.5
"""Voxels from an edge within which Poisson rounds it: its kernel reaches over three cells of half a voxel."""
FACING = float(np.cos(np.radians(40.0)))
"""Turn by which a vertex that lies on a plane may face away from it."""
AMID = 0.75
"""Share of the points around that are one plane's, from which on a vertex amid them is turned by noise, so far:"""
TURNED = float(np.cos(np.radians(75.0)))
FADES = 1.5
"""Tolerances from a plane up to which vertices are laid onto it in part; up to one they are wholly."""
CREASE = float(np.cos(np.radians(20.0)))
"""Planes that turn by less have no edge."""
GRAIN = 0.0005
"""Metres of noise that vertices get: in a plane to the bit, quadrics tell decimation no place."""
SLIVER = 0.01
"""Square voxels of a face that may turn over."""
ROUNDS = 8
"""Times that vertices are given back, whose faces have turned over."""


Edges = tuple[I64, I64]
"""Of a mesh, as `edges_of` gives them."""


@dataclass(frozen=True)
class Sharpened:
    """A mesh on planes.

    Attributes:
        mesh: without density.
        which: (V,) plane of each vertex, -1 for none or several.
        edge: (V,) bool, put where planes intersect.
    """

    mesh: Mesh
    which: I32
    edge: Bools


def sharpen(
    mesh: Mesh,
    edges: Edges,
    planes: Planes,
    own: I32,
    beside: Bools,
    share: F64,
    ends: int,
    voxel: float,
    tolerance: float,
) -> Sharpened:
    """The mesh on its planes.

    Args:
        mesh: to be sharpened.
        edges: its `edges_of`.
        planes: that its vertices lie on; the last of them are the ends of others.
        own: (V,) which of them, -1 for none.
        beside: (V,) bool, rounded beside an edge: laid on its plane from wherever it is. Others are the less moved, the
            nearer to `tolerance` they lie, so that a relief as deep fades into its plane.
        share: (V,) of the way onto their planes that vertices go.
        ends: number of the first plane beyond which nothing is: the faces of its vertices go.
        voxel: metres.
        tolerance: metres by which what lies on a plane may miss it.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    moved = vertices.copy()
    on = np.flatnonzero((own >= 0) & (own < ends))
    off = planes.beyond(vertices[on], own[on])
    part = share[on] * np.where(beside[on], 1.0, np.clip((FADES - np.abs(off) / tolerance) / (FADES - 1), 0, 1))
    moved[on] -= (part * off)[:, None] * planes.normal[own[on]]
    pairs, of_face = edges
    a, b = own[pairs[:, 0]], own[pairs[:, 1]]
    middle = vertices[pairs].mean(axis=1)
    crossing = np.flatnonzero((a >= 0) & (b >= 0) & (a != b))
    place, far = intersect(middle[crossing], planes, np.stack([a, b], axis=1)[crossing])
    sharp = far <= ROUNDED * voxel
    crossing, place = crossing[sharp], place[sharp]
    new = np.full(len(pairs), -1)
    new[crossing] = len(vertices) + np.arange(len(crossing))
    split, parent, corner = _split(faces, new[of_face], len(vertices) + len(crossing))
    three = own[faces[corner]]
    place3, far3 = intersect(vertices[faces[corner]].mean(axis=1), planes, three)
    around = np.concatenate([moved, place])[new[of_face[corner]]].mean(axis=1) if len(corner) else place3
    place3 = np.where((far3 <= ROUNDED * voxel)[:, None], place3, around)
    first = np.concatenate([vertices, middle[crossing], vertices[faces[corner]].mean(axis=1)])
    last = np.concatenate([moved, place, place3])
    which_of = np.concatenate([own, np.full(len(last) - len(own), -1, np.int32)]).astype(np.int32)
    kept = np.flatnonzero(~(which_of[split] >= ends).any(axis=1))
    last, _ = upright(first, last, split[kept], _cross(vertices[faces])[parent[kept]], SLIVER * voxel**2)
    left = np.zeros(len(last), bool)
    left[split[kept]] = True
    used, again = np.flatnonzero(left), (np.cumsum(left) - 1)[split[kept]]
    edge = used >= len(own)
    last[used] += np.random.default_rng(0).normal(0, GRAIN, (len(used), 3))
    small = Mesh(mesh.frame, last[used].astype(np.float32), again.astype(np.int32))
    return Sharpened(small, which_of[used], edge)


def plane_of(mesh: Mesh, planes: Planes, xyz: F32, which: I32, voxel: float, tolerance: float) -> tuple[I32, Bools]:
    """(V,) each vertex's plane, -1 for none; and whether it lies beside an edge.

    A vertex's is the nearest point's, where it lies on it and faces as it does; beside an edge, which Poisson has
    rounded, the nearer of the two that meet there.
    """
    own = np.full(len(mesh.vertices), -1, np.int32)
    beside = np.zeros(len(own), bool)
    if not len(xyz) or not len(mesh):
        return own, beside
    tree = cKDTree(xyz)
    _, at = tree.query(mesh.vertices, NEAR, distance_upper_bound=REACH * voxel, workers=-1)
    near = np.append(which, np.int32(-1))[at].astype(np.int32)
    normal = vertex_normals(mesh)
    axis, offset = np.ascontiguousarray(planes.normal), planes.offset
    vertices = mesh.vertices.astype(np.float64)
    _assign(vertices, normal, near, axis, offset, tolerance, ROUNDED * voxel, own, beside)
    return own, beside


def vertex_normals(mesh: Mesh) -> F64:
    """(V, 3) unit normals, the faces' means by area."""
    cross = _cross(mesh.vertices.astype(np.float64)[mesh.faces])
    total = np.stack(
        [sum(np.bincount(mesh.faces[:, k], cross[:, axis], len(mesh.vertices)) for k in range(3)) for axis in range(3)],
        axis=1,
    )
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20)


def intersect(places: F64, planes: Planes, which: npt.NDArray[np.integer]) -> tuple[F64, F64]:
    """The places (N, 3) on all of the planes `which` (N, K), K = 2 or 3, that are nearest to `places`.

    And metres (N,) to them, infinite where planes hardly intersect.
    """
    if not len(places):
        return places.reshape(-1, 3), np.zeros(0)
    normal = planes.normal[which]
    miss = planes.offset[which] - np.einsum("nkj,nj->nk", normal, places)
    gram = normal @ normal.transpose(0, 2, 1)
    least = np.linalg.eigvalsh(gram)[:, 0]
    good = least > 1 - CREASE  # of two planes the least eigenvalue is 1 - |cos|
    gram[~good] = np.eye(which.shape[1])
    shift = np.einsum("nkj,nk->nj", normal, np.linalg.solve(gram, miss[:, :, None])[:, :, 0])
    return places + shift, np.where(good, np.linalg.norm(shift, axis=1), np.inf)


def upright(first: F64, last: F64, faces: npt.NDArray[np.integer], was: F64, least: float) -> tuple[F64, Bools]:
    """Vertices at `last` (V, 3), but at `first` where a face would turn against its old normal; and which stayed.

    Old normals `was` (F, 3) are as long as twice the area; faces below `least` m2 may turn: they have no direction to
    speak of.
    """
    heavy = np.linalg.norm(was, axis=1) > 2 * least
    faces, was = faces[heavy], was[heavy]
    last = last.copy()
    stayed = np.zeros(len(first), bool)
    changed = np.arange(len(faces))
    for _ in range(ROUNDS):
        now = _cross(last[faces[changed]])
        size = np.linalg.norm(now, axis=1)
        over = ((now * was[changed]).sum(axis=1) < 0) & (size > 2 * least)
        back = np.unique(faces[changed[over]])
        back = back[~stayed[back]]
        if not len(back):
            break
        last[back], stayed[back] = first[back], True
        put = np.zeros(len(first), bool)
        put[back] = True
        changed = np.flatnonzero(put[faces].any(axis=1))  # the others are as they were
    return last, stayed


def border_of(edges: Edges) -> I64:
    """The vertices on a mesh's border."""
    pairs, of_face = edges
    return np.unique(pairs[np.bincount(of_face.ravel(), minlength=len(pairs)) == 1])


@njit(cache=True, parallel=True)
def _assign(
    xyz: F64, normal: F64, near: I32, axis: F64, offset: F64, tolerance: float, rounded: float, own: I32, beside: Bools
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
        # beside an edge
        best = rounded
        for k in range(count):
            for m in range(k + 1, count):
                c = 0.0
                for q in range(3):
                    c += axis[seen[k], q] * axis[seen[m], q]
                if abs(c) < CREASE:
                    a, b = away[k], away[m]
                    far = np.sqrt(max(0.0, (a * a + b * b - 2 * a * b * c) / (1 - c * c)))
                    if far < best:
                        best = far
                        own[i] = seen[k] if abs(a) <= abs(b) else seen[m]
                        beside[i] = True
        if own[i] >= 0:
            continue
        for k in range(count):
            if abs(away[k]) <= FADES * tolerance:
                most = 0
                for p in near[i]:
                    most += p == seen[k]
                amid = abs(away[k]) <= tolerance and most >= AMID * len(near[i])
                facing = 0.0
                for q in range(3):
                    facing += axis[seen[k], q] * normal[i, q]
                if facing > (TURNED if amid else FACING):
                    own[i] = seen[k]
                    break


def edges_of(mesh: Mesh) -> Edges:
    """Edges (E, 2), and which of them each face has (F, 3): from its first corner, its second, its third."""
    faces = mesh.faces.astype(np.int64)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    side = int(faces.max(initial=0)) + 1
    order, code = ordered(ends.min(axis=1) * side + ends.max(axis=1))
    first = first_of_each(code)
    of_face = np.empty(len(ends), np.int64)
    of_face[order] = np.cumsum(first) - 1
    return np.stack([code[first] // side, code[first] % side], axis=1), of_face.reshape(-1, 3)


def _split(faces: I64, new: I64, count: int) -> tuple[I64, I64, I64]:
    """Faces (F, 3) split at the new vertices of their edges (F, 3), -1 for none.

    One that has three gets a vertex in its middle as well, numbered from `count` on.

    Returns:
        Faces; whose part each is; and the faces that got a middle, in the order of their numbers.
    """
    cuts = (new >= 0).sum(axis=1)
    parts, parents = [faces[cuts == 0]], [np.flatnonzero(cuts == 0)]

    def add(of: I64, *corners: I64) -> None:
        parts.append(np.stack(corners, axis=1))
        parents.append(of)

    def turned(of: I64, by: I64) -> tuple[I64, ...]:
        """Corners and new vertices, from corner `by` on."""
        order = (by[:, None] + np.arange(3)) % 3
        v, e = np.take_along_axis(faces[of], order, 1), np.take_along_axis(new[of], order, 1)
        return (*v.T, *e.T)

    one = np.flatnonzero(cuts == 1)
    a, b, c, ab, _, _ = turned(one, np.argmax(new[one] >= 0, axis=1))
    add(one, a, ab, c)
    add(one, ab, b, c)
    two = np.flatnonzero(cuts == 2)
    a, b, c, ab, _, ca = turned(two, (np.argmax(new[two] < 0, axis=1) + 2) % 3)  # both cuts meet at corner a
    add(two, a, ab, ca)
    add(two, ab, b, ca)
    add(two, b, c, ca)
    three = np.flatnonzero(cuts == 3)
    a, b, c, ab, bc, ca = turned(three, np.zeros(len(three), np.int64))
    m = count + np.arange(len(three))
    for p, q in ((a, ab), (ab, b), (b, bc), (bc, c), (c, ca), (ca, a)):
        add(three, p, q, m)
    return np.concatenate(parts), np.concatenate(parents), three


def _cross(corners: F64) -> F64:
    """(F, 3) normals of corners (F, 3, 3), as long as twice the area."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    out = np.empty_like(a)
    for k in range(3):  # np.cross takes three times as long
        i, j = (k + 1) % 3, (k + 2) % 3
        out[:, k] = a[:, i] * b[:, j] - a[:, j] * b[:, i]
    return out
