"""Plane snapping: a house of known planes whose mesh is rounded and noisy, as Poisson reconstruction leaves it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.types import F32, F64, I32, Bools, Frame, Mesh
from scan2sim.pipeline.geometry.plane_snapping import (
    VERTEX_NOISE_M,
    SnappedMesh,
    assign_vertices,
    border_vertices,
    edges_of,
    intersect,
    prevent_flips,
    snap_to_planes,
)
from scan2sim.pipeline.geometry.planes import Planes

VOXEL, TOLERANCE = 0.1, 0.03
SPACING = 0.05
"""Of mesh vertices: half a voxel, as Poisson's cells."""
NOISE = 0.008
EXACT = 5 * VERTEX_NOISE_M
"""Largest distance from a plane of a vertex that was moved onto it: five sigmas of the noise that is added."""
SIZE, EAVES, RIDGE = 4.0, 2.0, 3.5
TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
SHIFT = np.array([12.0, -30.0, 4.0])
CORNERS = np.array([[x, y, z] for x in (0, 4) for y in (0, 4) for z in (0, 2)] + [[2, y, 3.5] for y in (0, 4)], float)
RIMS = [(0, 2), (0, 4), (4, 6), (2, 6), (0, 1), (2, 3), (4, 5), (6, 7), (1, 3), (5, 7), (1, 8), (8, 5), (3, 9), (9, 7),
        (8, 9)]  # fmt: skip
"""Edges between the house's planes, as indices of `CORNERS`."""


def placed(xyz: F64) -> F64:
    """Positions in the axes of the house, rotated and shifted to the world."""
    return xyz @ TURN.T + SHIFT


def house_planes() -> Planes:
    """Floor, four walls, two roofs."""
    slope = np.array([EAVES - RIDGE, 0, SIZE / 2]) / np.hypot(RIDGE - EAVES, SIZE / 2)
    normal = np.array([[0, 0, -1], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], slope, slope * (-1, 1, 1)], float)
    on = np.array([[0, 0, 0], [0, 0, 0], [4, 0, 0], [0, 0, 0], [0, 4, 0], [2, 0, 3.5], [2, 0, 3.5]], float)
    turned = normal @ TURN.T
    return Planes(turned, (turned * placed(on)).sum(axis=1))


def house_grid() -> tuple[F64, I32]:
    """Exact mesh in the axes of the house: welded grids on its faces."""
    count = np.rint(np.array([SIZE, SIZE, RIDGE]) / SPACING).astype(int)
    corners = []
    for axis in range(3):
        n, m = np.delete(count, axis)
        i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(m)))
        quads = np.stack([np.column_stack([i + a, j + b]) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], axis=1)
        for side in (0, count[axis]):
            face = np.insert(quads, axis, side, axis=2)
            corners.append(face if (side > 0) == (axis != 1) else face[:, ::-1])
    unique, index = np.unique(np.concatenate(corners).reshape(-1, 3), axis=0, return_inverse=True)
    xyz = unique / count * (SIZE, SIZE, 1.0)
    xyz[:, 2] *= EAVES + (RIDGE - EAVES) * (1 - np.abs(xyz[:, 0] / (SIZE / 2) - 1))
    quad = index.reshape(-1, 4)
    return xyz, np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int32)


def smoothed(xyz: F64, faces: I32, rounds: int = 2) -> F64:
    """Vertices moved to the mean of themselves and their neighbours: edges become round."""
    pairs = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    both = np.concatenate([pairs, pairs[:, ::-1], np.repeat(np.arange(len(xyz)), 2).reshape(-1, 2)])
    count = np.bincount(both[:, 0])
    for _ in range(rounds):
        xyz = np.stack([np.bincount(both[:, 0], xyz[both[:, 1], k]) / count for k in range(3)], axis=1)
    return xyz


@dataclass(frozen=True)
class House:
    """Rounded mesh, exact planes, and thinned points on them with their planes."""

    mesh: Mesh
    planes: Planes
    xyz: F32
    which: I32


@pytest.fixture(scope="module")
def house() -> House:
    """The house with noise; the normal noise of vertices and points is `NOISE`."""
    random = np.random.default_rng(0)
    exact, faces = house_grid()
    rough = placed(smoothed(exact + random.normal(0, 3 * NOISE, exact.shape), faces))  # smoothing leaves a third of it
    planes = house_planes()
    middle = placed(exact[faces].mean(axis=1))
    off = np.abs(middle @ planes.normal.T - planes.offset)
    chosen = random.permutation(len(middle))[: len(middle) // 8]  # one of eight faces: about one point per voxel
    points = middle[chosen] + random.normal(0, NOISE, (len(chosen), 3))
    which = off[chosen].argmin(axis=1).astype(np.int32)
    assert off.min(axis=1).max() < 1e-9
    mesh = Mesh(Frame(), rough.astype(np.float32), faces)
    return House(mesh, planes, points.astype(np.float32), which)


def snapped_house(house: House, weight: F64 | None = None) -> tuple[SnappedMesh, I32, Bools]:
    """The snapped mesh, and plane and nearness to an edge of each vertex before."""
    mesh = house.mesh
    own, near_edge = assign_vertices(mesh, house.planes, house.xyz, house.which, VOXEL, TOLERANCE)
    if weight is None:
        weight = np.ones(len(mesh.vertices))
    own[weight == 0] = -1
    ends = len(house.planes)
    snapped = snap_to_planes(mesh, edges_of(mesh), house.planes, own, near_edge, weight, ends, VOXEL, TOLERANCE)
    return snapped, own, near_edge


def off(xyz: F32, planes: Planes) -> F64:
    """Distances (N, P) of points from planes, nearest first."""
    return np.sort(np.abs(xyz.astype(np.float64) @ planes.normal.T - planes.offset), axis=1)


def test_vertices_lie_on_their_planes_and_edges_are_straight(house: House) -> None:
    before = off(house.mesh.vertices, house.planes)[:, 0]
    snapped, own, _ = snapped_house(house)
    after = off(snapped.mesh.vertices, house.planes)
    assert before.max() > 0.02 and before.mean() > 0.003
    assert (own >= 0).all() and (after[:, 0] < EXACT).mean() > 0.99  # vertices whose faces would flip stay in place
    assert (after[snapped.edge, 1] < EXACT).mean() > 0.9
    assert not len(border_vertices(edges_of(snapped.mesh))), "the surface has holes"


def test_edges_of_a_smooth_mesh_are_complete_and_at_the_true_intersections(house: House) -> None:
    """Rounded, with little noise: every edge gets vertices all along, at most two cells apart; few stray."""
    exact, faces = house_grid()
    rough = placed(smoothed(exact + np.random.default_rng(3).normal(0, NOISE, exact.shape), faces))
    snapped, _, _ = snapped_house(House(Mesh(Frame(), rough.astype(np.float32), faces), house.planes, *points(house)))
    after = off(snapped.mesh.vertices, house.planes)
    assert (after[:, 0] < EXACT).mean() > 0.99 and (after[snapped.edge, 1] < EXACT).mean() > 0.9
    corners, tree = placed(CORNERS), cKDTree(snapped.mesh.vertices[snapped.edge])
    for a, b in RIMS:
        along = corners[a] + np.linspace(0, 1, 200)[:, None] * (corners[b] - corners[a])
        assert tree.query(along)[0].max() < SPACING + EXACT
    assert cKDTree(snapped.mesh.vertices).query(corners)[0].max() < EXACT


def points(house: House) -> tuple[F32, I32]:
    """Points of the house and their planes."""
    return house.xyz, house.which


def test_vertices_without_a_plane_and_fixed_vertices_are_kept(house: House) -> None:
    """A dome, which has no plane, and the border to another tile: moved by at most the noise added for decimation."""
    a, b = (k.ravel() for k in np.meshgrid(np.linspace(0, 1.4, 20), np.linspace(0, 6.2, 60)))
    dome = np.column_stack([np.cos(b) * np.cos(a), np.sin(b) * np.cos(a), np.sin(a)]) * 0.8 + SHIFT + [1.5, 1.5, 5.0]
    i = np.array([r * 20 + c for r in range(59) for c in range(19)])
    extra = np.concatenate([np.column_stack([i, i + 20, i + 21]), np.column_stack([i, i + 21, i + 1])])
    count = len(house.mesh.vertices)
    vertices = np.concatenate([house.mesh.vertices, dome.astype(np.float32)])
    mesh = Mesh(Frame(), vertices, np.concatenate([house.mesh.faces, extra + count]).astype(np.int32))
    weight = np.clip((vertices[:, 0] - vertices[:count, 0].min() - 1.0) / 0.5, 0, 1).astype(np.float64)
    weight[count:] = 1
    snapped, own, _ = snapped_house(replace(house, mesh=mesh), weight)
    moved = np.linalg.norm(snapped.mesh.vertices[: len(vertices)] - vertices, axis=1)
    assert (own[count:] == -1).all() and moved[count:].max() < EXACT * np.sqrt(3)
    assert (weight == 0).sum() > 500 and moved[weight == 0].max() < EXACT * np.sqrt(3)
    assert not (own[weight == 0] >= 0).any()


def test_relief_blends_into_its_plane() -> None:
    """Flat up to the tolerance, unchanged beyond 1.5 tolerances, blended in between; always flat near an edge."""
    x, y = (k.ravel() for k in np.meshgrid(np.arange(5.0), np.arange(5.0)))
    height = TOLERANCE * np.array([0.5, 1.0, 1.25, 1.5, 2.0])[x.astype(int)]
    i = np.array([r * 5 + c for r in range(4) for c in range(4)])
    faces = np.concatenate([np.column_stack([i, i + 1, i + 6]), np.column_stack([i, i + 6, i + 5])]).astype(np.int32)
    mesh = Mesh(Frame(), np.column_stack([x, y, height]).astype(np.float32), faces)
    plane = Planes(np.array([[0.0, 0, 1]]), np.zeros(1))
    for near, left in ((False, [0, 0, 0.625, 1.5, 2.0]), (True, [0] * 5)):
        own, near_edge = np.zeros(25, np.int32), np.full(25, near)
        args = (mesh, edges_of(mesh), plane, own, near_edge, np.ones(25), 1, VOXEL, TOLERANCE)
        z = snap_to_planes(*args).mesh.vertices[:, 2]
        assert z == pytest.approx(TOLERANCE * np.array(left)[x.astype(int)], abs=EXACT)


def test_surface_ends_in_a_straight_line_at_a_boundary_plane() -> None:
    """Vertices of the last planes are beyond an end: their faces are removed up to it."""
    x, y = (k.ravel() for k in np.meshgrid(np.arange(0, 1.01, SPACING), np.arange(0, 1.01, SPACING)))
    n = round(len(x) ** 0.5)
    i = np.array([r * n + c for r in range(n - 1) for c in range(n - 1)])
    faces = np.concatenate([np.column_stack([i, i + 1, i + n + 1]), np.column_stack([i, i + n + 1, i + n])])
    mesh = Mesh(Frame(), np.column_stack([x, y, np.zeros(len(x))]).astype(np.float32), faces.astype(np.int32))
    planes = Planes(np.array([[0.0, 0, 1], [0.96, 0.28, 0]]), np.array([0, 0.72]))
    own = (x * 0.96 + y * 0.28 > 0.72).astype(np.int32)
    args = (mesh, edges_of(mesh), planes, own, own > 0, np.ones(len(x)), 1, VOXEL, TOLERANCE)
    snapped = snap_to_planes(*args)
    beyond = snapped.mesh.vertices[:, :2] @ (0.96, 0.28) - 0.72
    assert beyond.max() < EXACT and np.abs(beyond[snapped.edge]).max() < EXACT and snapped.edge.sum() >= n
    assert snapped.mesh.face_area.sum() == pytest.approx((0.75 + (0.72 - 0.28) / 0.96) / 2, abs=0.01)


def test_faces_do_not_flip() -> None:
    """A vertex that would cross the opposite side is moved back, others keep their new positions."""
    first = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    last = first + [[0, 0, 0.1]]
    last[0] = 1.2, 1.2, 0.1
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    kept, stayed = prevent_flips(first, last, faces[:1], np.array([[0, 0, 1.0]]), 1e-4)
    assert stayed.tolist() == [True, True, True, False] and np.array_equal(kept[:3], first[:3])
    assert np.array_equal(prevent_flips(first, first + 0.1, faces, np.array([[0, 0, 1.0]] * 2), 1e-4)[0], first + 0.1)


def test_nearest_points_on_intersections() -> None:
    planes = Planes(
        np.array([[1.0, 0, 0], [0, 0.6, 0.8], [0, 0, 1], [np.sin(0.1), 0, np.cos(0.1)]]), np.array([1.0, 2, 3, 3])
    )
    place, far = intersect(np.array([[2.0, 0, 0], [0, 0, 0]]), planes, np.array([[0, 1], [2, 3]]))
    assert place[0] == pytest.approx([1, 1.2, 1.6]) and far[0] == pytest.approx(np.sqrt(5))
    assert np.isinf(far[1]), "almost parallel planes have no edge"
    place, far = intersect(np.zeros((1, 3)), planes, np.array([[0, 1, 2]]))
    assert place[0] == pytest.approx([1, -2 / 3, 3])
