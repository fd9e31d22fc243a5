"""Plane boundaries: sides of walls with a known outline, openings, corners, steps and open ends.

Positions are checked to the precision that the points allow: in a strip of one bin along a side, points are
1 / (density * bin length) apart, and the median over the bins of a side averages this error out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, F64, I32, Frame, PointCloud
from scan2sim.pipeline.geometry.plane_boundaries import (
    LIMITS,
    Sides,
    assign_points,
    cut_at_boundaries,
    open_boundaries,
    sides,
    step_faces,
)
from scan2sim.pipeline.geometry.planes import Planes
from scan2sim.pipeline.geometry.voxel_grid import sample

VOXEL = 0.1
DENSITY = 900.0  # points per m2, nine per voxel
TOLERANCE = 0.03
CORNERS = ((0, 0), (6, 0), (6, 3), (3, 5), (0, 3))  # of a gable wall, metres
WINDOW = ((1.5, 1.0), (3.0, 1.0), (3.0, 2.5), (1.5, 2.5))
NONE = np.zeros((0, 3), np.float32)


@dataclass(frozen=True)
class Surface:
    """A plane patch: where its (0, 0) is, and its axes; the normal is their cross product."""

    origin: tuple[float, float, float]
    along: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def normal(self) -> F64:
        return np.cross(self.along, self.up)

    def at(self, flat: F64) -> F64:
        """Positions (N, 3) of flat coordinates (N, 2)."""
        return np.array(self.origin) + np.asarray(flat, float) @ np.array([self.along, self.up])

    def flat(self, xyz: F64) -> F64:
        """Flat coordinates (..., 2) of positions (..., 3)."""
        return (xyz - np.array(self.origin)) @ np.array([self.along, self.up]).T


FRONT = Surface((20.0, -10.0, 1.0), (0.8, 0.6, 0.0))  # faces (0.6, -0.8, 0)


def scan(
    corners: tuple[tuple[float, float], ...] = CORNERS,
    opening: tuple[tuple[float, float], ...] | None = None,
    density: float = DENSITY,
    gradient: float = 1.0,
    noise: float = 0.0,
    seed: int = 0,
) -> F64:
    """Flat points (N, 2) in a polygon; the density at its right end is `gradient` times that at its left end."""
    random, low, high = np.random.default_rng(seed), np.min(corners, axis=0), np.max(corners, axis=0)
    count = int(density * max(gradient, 1) * np.prod(high - low))
    flat = random.uniform(low, high, (count, 2))
    share = 1 + (gradient - 1) * (flat[:, 0] - low[0]) / (high[0] - low[0])
    keep = random.uniform(0, max(gradient, 1), count) < share
    keep &= inside(flat, corners)
    if opening is not None:
        keep &= ~inside(flat, opening)
    return flat[keep] + random.normal(0, noise, (int(keep.sum()), 2))


def inside(flat: F64, corners: tuple[tuple[float, float], ...]) -> np.ndarray:
    """(N,) bool, True for points (N, 2) inside a convex polygon with corners counterclockwise."""
    ring = np.array(corners, float)
    edge = np.roll(ring, -1, axis=0) - ring
    apart = flat[:, None] - ring
    return np.asarray((edge[:, 0] * apart[..., 1] - edge[:, 1] * apart[..., 0] > 0).all(axis=1))


def scene(*parts: tuple[Surface, F64]) -> tuple[F32, I32, Planes]:
    """Points (N, 3) of surfaces, the plane (N,) of each, and the planes."""
    xyz = np.concatenate([surface.at(flat) for surface, flat in parts]).astype(np.float32)
    own = np.repeat(np.arange(len(parts)), [len(flat) for _, flat in parts]).astype(np.int32)
    normal = np.array([surface.normal for surface, _ in parts])
    return xyz, own, Planes(normal, np.array([n @ s.origin for n, (s, _) in zip(normal, parts, strict=True)]))


def thinned(xyz: F32, own: I32) -> tuple[F32, I32]:
    """One point per voxel, and the plane of one of its members."""
    thin = sample(PointCloud(Frame(), xyz, classification=(own + 1).astype(np.uint8)), VOXEL)
    assert thin.classification is not None
    return thin.xyz, (thin.classification.astype(np.int32) - 1).astype(np.int32)


def nearest_side(found: Sides, start: F64, end: F64) -> int:
    """The side nearest to a true edge."""
    return int(np.argmin(np.linalg.norm(found.start - start, axis=1) + np.linalg.norm(found.end - end, axis=1)))


def precision(length: float, density: float = DENSITY, noise: float = 0.0) -> float:
    """Four standard deviations of the position of a side's end, metres.

    The gap between the outermost point of a bin and the edge is exponential, of mean 1 / (density * bin length); a
    median over n bins deviates by 1.25 / sqrt(n) of that, at the ends of a fitted slope by twice as much. Noise moves
    the outermost points outwards, by about its sigma.
    """
    bins = length / (LIMITS.bin_length * VOXEL)
    return 4 * 2 * 1.25 / np.sqrt(bins) / (density * LIMITS.bin_length * VOXEL) + 1.5 * noise


@pytest.mark.parametrize(
    ("density", "gradient", "noise"), [(900.0, 1.0, 0.0), (900.0, 1.0, 0.01), (1600.0, 1.0, 0.0), (900.0, 4.0, 0.005)]
)
def test_sides_of_outline_and_opening_are_at_their_true_positions(
    density: float, gradient: float, noise: float
) -> None:
    xyz, own, planes = scene((FRONT, scan(opening=WINDOW, density=density, gradient=gradient, noise=noise)))
    found = sides(xyz, own, planes, VOXEL)
    assert len(found) == len(CORNERS) + len(WINDOW) and found.fitted.all() and found.hole.sum() == len(WINDOW)
    for ring, hole in ((np.array(CORNERS, float), False), (np.array(WINDOW)[::-1], True)):  # inside to the left
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            start, end = FRONT.at(np.array([a, b]))
            side = nearest_side(found, start, end)
            limit = precision(float(np.linalg.norm(b - a)), density, noise)
            assert np.linalg.norm(found.start[side] - start) < limit
            assert np.linalg.norm(found.end[side] - end) < limit
            outward = np.cross(end - start, FRONT.normal) / np.linalg.norm(b - a)
            assert np.linalg.norm(found.outward[side] - outward) < 2 * limit / np.linalg.norm(b - a)
            assert bool(found.hole[side]) == hole


def test_obtuse_corner_is_kept() -> None:
    """The eaves of a wall turn by 12 degrees in the middle: the corner is 26 cm above the line through their ends."""
    bent = ((0, 0), (5, 0), (5, 2.5), (2.5, 2.5 + 2.5 * np.tan(np.radians(12))), (0, 2.5 + 2.5 * np.tan(np.radians(6))))
    xyz, own, planes = scene((FRONT, scan(bent)))
    found = sides(xyz, own, planes, VOXEL)
    assert len(found) == 5
    for corner in FRONT.at(np.array(bent)):
        assert np.linalg.norm(found.start - corner, axis=1).min() < 0.04


def test_gaps_narrower_than_the_closing_width_are_not_openings() -> None:
    """The closing width is twice the closing radius; the mesh closes narrower gaps, too."""
    width = 2 * LIMITS.closing_radius * VOXEL
    for factor, holes in ((0.8, 0), (1.4, 4)):
        gap = ((2, 1), (2 + factor * width, 1), (2 + factor * width, 2.5), (2, 2.5))
        xyz, own, planes = scene((FRONT, scan(opening=gap)))
        assert sides(xyz, own, planes, VOXEL).hole.sum() == holes


def test_ragged_side_is_not_fitted() -> None:
    """Points that end anywhere within 30 cm do not determine a straight boundary."""
    flat, random = scan(((0, 0), (6, 0), (6, 3), (0, 3))), np.random.default_rng(1)
    ragged = random.uniform(-0.3, 0, 60)[np.clip((flat[:, 0] / 0.1).astype(int), 0, 59)]
    xyz, own, planes = scene((FRONT, flat[flat[:, 1] < 3 + ragged]))
    found = sides(xyz, own, planes, VOXEL)
    top = FRONT.flat((found.start + found.end) / 2)[:, 1] > 2.5
    length = np.linalg.norm(found.end - found.start, axis=1)
    assert length[top & found.fitted].sum() < 0.1 * 6.0
    assert found.fitted[~top].all() and length[~top].sum() > 6 + 2 * 2.5


def test_points_are_assigned_to_their_plane() -> None:
    """Two walls that meet in a corner (within the tolerance of both, either is correct), and a box 20 cm in front."""
    other = Surface(FRONT.origin, (-0.6, 0.8, 0.0), (0.0, 0.0, -1.0))  # backwards from the front's left end
    noise, flat = 0.01, scan(((0, 0), (4, 0), (4, 3), (0, 3)))
    xyz, true, planes = scene((FRONT, flat), (other, flat * (1, -1)))
    xyz += np.random.default_rng(2).normal(0, noise, xyz.shape).astype(np.float32)
    box = (FRONT.at(scan(((1, 1), (2, 1), (2, 2), (1, 2)))) + 0.2 * FRONT.normal).astype(np.float32)
    whole = np.concatenate([xyz, box])
    thin, which = thinned(whole, np.append(true, np.full(len(box), -1, np.int32)))
    own = assign_points(whole, planes, thin, which, VOXEL, TOLERANCE)
    assert (own[len(xyz) :] == -1).all()
    assert (own[: len(xyz)] >= 0).mean() > 0.99
    near = np.abs(planes.signed_distance(xyz, (1 - true).astype(np.int32))) < LIMITS.point_tolerance * VOXEL
    assert (own[: len(xyz)] == true)[~near].mean() > 0.99
    assert (assign_points(whole, planes, thin, np.full_like(which, -1), VOXEL, TOLERANCE) == -1).all()


@pytest.mark.parametrize(("depth", "steps"), [(0.02, 0), (0.15, 4), (0.3, 4), (0.6, 0)])
def test_steps_join_a_window_to_the_wall_around_it(depth: float, steps: int) -> None:
    """Reveals have the pane's depth; there are none if it is within twice the tolerance, or far behind the wall."""
    pane = Surface(tuple(np.array(FRONT.origin) - depth * FRONT.normal), FRONT.along)
    xyz, own, planes = scene((FRONT, scan(((0, 0), (5, 0), (5, 4), (0, 4)), WINDOW)), (pane, scan(WINDOW, seed=1)))
    thin, which = thinned(xyz, own)
    faces, points, of = step_faces(sides(xyz, own, planes, VOXEL), planes, thin, which, VOXEL, TOLERANCE)
    assert len(faces) == steps
    for k in range(steps):
        on = points[of == k]
        assert np.abs(faces.normal[k] @ FRONT.normal) < 0.01
        assert np.abs(on @ faces.normal[k] - faces.offset[k]).max() < 1e-6
        flat, deep = FRONT.flat(on), -(on - FRONT.origin) @ FRONT.normal
        low, high = np.min(WINDOW, axis=0), np.max(WINDOW, axis=0)
        off = np.minimum(np.abs(flat - low), np.abs(flat - high)).min(axis=1)
        assert off.max() < precision(1.5), "the face isn't at the window's edge"
        assert deep.min() > 0 and deep.max() < depth
        spacing = depth / max(1, round(depth / VOXEL / LIMITS.step_point_spacing))
        assert deep.min() + depth - deep.max() == pytest.approx(spacing, abs=0.005)  # half a spacing from either plane


def ends_of(
    parts: list[tuple[Surface, F64]], others: F32 = NONE, bordered: bool = True
) -> tuple[Sides, F64, I32, Planes, F32]:
    """Sides, open boundary points and their sides, planes and thinned points of a scene without noise."""
    xyz, own, planes = scene(*parts)
    thin, which = thinned(xyz, own)
    found = sides(xyz, own, planes, VOXEL)
    border = found.along(VOXEL)[0] + 0.25 * found.outward[found.along(VOXEL)[1]]  # surface after `trim`
    ends: F32 = border.astype(np.float32) if bordered else np.full((1, 3), 1e3, np.float32)
    places, of = open_boundaries(found, planes, thin, which, others, ends, VOXEL)
    return found, places, of, planes, thin


def test_walls_are_open_at_their_ends_but_not_at_corner_and_ground() -> None:
    other = Surface(FRONT.origin, (-0.6, 0.8, 0.0), (0.0, 0.0, -1.0))
    flat = scan(((0, 0), (4, 0), (4, 3), (0, 3)))
    x, y = np.meshgrid(np.arange(-6, 6, 0.1), np.arange(-6, 6, 0.1))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + FRONT.origin
    found, places, of, _, _ = ends_of([(FRONT, flat), (other, flat * (1, -1))], ground.astype(np.float32))
    local = np.column_stack([FRONT.flat(places), (places - FRONT.origin) @ FRONT.normal])  # along, up, in front
    for along, before in ((4.0, 0.0), (0.0, -4.0)):  # the free ends, over most of their height
        near = (np.abs(local[:, 0] - along) < 0.02) & (np.abs(local[:, 2] - before) < 0.02)
        assert np.ptp(local[near, 1]) > 2.3 and local[near, 1].min() > 1.5 * VOXEL
    assert np.linalg.norm(local[:, [0, 2]], axis=1).min() > VOXEL, "the corner of the walls is open"
    assert local[:, 1].min() > VOXEL, "the walls end above the ground"
    assert (np.abs(local[:, 1] - 3) < 0.02).sum() > 60  # eaves: 8 m in all, one point per voxel
    assert found.fitted[of].all()


def test_only_points_at_the_border_of_the_mesh_are_open() -> None:
    _, places, _, _, _ = ends_of([(FRONT, scan())], bordered=False)
    assert not len(places)


def test_round_surfaces_have_no_open_boundary() -> None:
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    disc = tuple((float(c), float(s)) for c, s in zip(0.7 * np.cos(angle), 0.7 * np.sin(angle), strict=True))
    assert not len(ends_of([(FRONT, scan(disc))])[1])


def test_a_mesh_is_cut_where_its_wall_ends() -> None:
    """Vertices beyond a side get the number of its boundary plane, others keep theirs."""
    found, places, of, planes, thin = ends_of([(FRONT, scan(((0, 0), (4, 0), (4, 3), (0, 3))))])
    u, v = np.meshgrid(np.arange(-0.225, 4.25, 0.05), np.arange(0.525, 2.5, 0.05))
    flat = np.column_stack([u.ravel(), v.ravel()])
    own = np.where(inside(flat, ((0, 0), (4, 0), (4, 3), (0, 3))), 0, -1).astype(np.int32)
    got = cut_at_boundaries(FRONT.at(flat), own, planes, found, places, of, thin, VOXEL)
    beyond = (flat[:, 0] < -precision(3.0)) | (flat[:, 0] > 4 + precision(3.0))
    within = (flat[:, 0] > precision(3.0)) & (flat[:, 0] < 4 - precision(3.0))
    assert (got[within] == 0).all() and (got[beyond] >= len(planes)).all()
    for left in (True, False):
        side = np.unique(got[beyond & ((flat[:, 0] < 2) == left)]) - len(planes)
        assert len(side) == 1 and FRONT.flat(found.start[side[0]])[0] == pytest.approx(0 if left else 4, abs=0.02)
    elsewhere = np.full(len(flat), 5, np.int32)  # vertices of another plane stay with it
    assert (cut_at_boundaries(FRONT.at(flat), elsewhere, planes, found, places, of, thin, VOXEL) == 5).all()
