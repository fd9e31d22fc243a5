"""Planes of a thinned cloud, against the corner of two walls and a floor that the points are of."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, F64, I32
from scan2sim.pipeline.geometry.planes import MIN_PLANE_POINTS, Planes, detect

VOXEL = 0.1
NORMALS = np.array([(-np.cos(0.4), -np.sin(0.4), 0.0), (np.sin(0.4), -np.cos(0.4), 0.0), (0.0, 0.0, 1.0)])
OFFSETS = np.array([-6.0, -4.0, 0.5])
COLUMN = 0.3
"""Radius in metres of a round column in the room."""


def room(noise: float) -> tuple[F32, F32, I32]:
    """Points (N, 3), normals (N, 3) to the inside of a room's corner, and the plane of each; -1 on a column."""
    random = np.random.default_rng(3)
    corner = np.linalg.solve(NORMALS, OFFSETS)
    along, up = np.meshgrid(np.arange(0.05, 4, VOXEL), np.arange(0.05, 2.5, VOXEL))
    flat, height = along.ravel()[:, None], up.ravel()[:, None]
    a, b, z = NORMALS[1], NORMALS[0], NORMALS[2]  # into the room along the first and second wall, and up
    across = np.meshgrid(np.arange(0.05, 4, VOXEL), np.arange(0.05, 4, VOXEL))
    walls = [corner + flat * a + height * z, corner + flat * b + height * z]
    floor = corner + across[0].ravel()[:, None] * a + across[1].ravel()[:, None] * b
    parts = [*walls, floor]
    xyz, normal = np.concatenate(parts), np.repeat(NORMALS, [len(part) for part in parts], axis=0)
    which = np.repeat([0, 1, 2], [len(part) for part in parts])
    angle, high = np.meshgrid(np.arange(0, 2 * np.pi, VOXEL / COLUMN), np.arange(0.1, 2.4, VOXEL))
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1).reshape(-1, 3)
    column = corner + 2.0 * (a + b) + COLUMN * out + high.reshape(-1, 1) * z
    xyz, normal = np.concatenate([xyz, column]), np.concatenate([normal, out])
    which = np.append(which, np.full(len(out), -1))
    xyz = xyz + noise * random.standard_normal((len(xyz), 1)) * normal
    return xyz.astype(np.float32), normal.astype(np.float32), which.astype(np.int32)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_planes_are_those_of_the_walls_and_the_floor(noise: float) -> None:
    xyz, normal, truth = room(noise)
    planes, which, tolerance = detect(xyz, normal, VOXEL)
    assert len(planes) == 3
    assert max(3 * noise, 0.15 * VOXEL) * 0.7 < tolerance < max(3 * noise, 0.15 * VOXEL) * 1.3
    match: F64 = planes.normal @ NORMALS.T
    order = match.argmax(axis=1)
    assert sorted(order) == [0, 1, 2] and match.max(axis=1).min() > np.cos(np.radians(0.2))
    assert planes.offset == pytest.approx(OFFSETS[order], abs=0.02)  # at the origin, metres away
    found = np.where(which < 0, -1, order[which])
    flat = truth >= 0
    edge = np.sort(np.abs(xyz.astype(np.float64) @ NORMALS.T - OFFSETS), axis=1)[:, 1] < 0.3  # near another plane
    assert (found[flat & ~edge] == truth[flat & ~edge]).mean() > 0.98
    assert (found[flat & edge] == truth[flat & edge]).mean() > 0.9
    assert (found[~flat] == -1).mean() > 0.9, "a column is no plane"
    signed = planes.signed_distance(xyz[which >= 0], which[which >= 0])
    assert np.abs(signed).max() <= tolerance * 1.2


def test_too_few_points_have_no_plane() -> None:
    xyz, normal, _ = room(0.0)
    planes, which, _ = detect(xyz[: MIN_PLANE_POINTS - 1], normal[: MIN_PLANE_POINTS - 1], VOXEL)
    assert not len(planes) and (which == -1).all()


def test_the_nearest_plane_has_the_points_normal_and_offset() -> None:
    planes = Planes(np.array([(1.0, 0, 0), (-1.0, 0, 0), (1.0, 0, 0)]), np.array([2.0, -2.0, 5.0]))
    xyz = np.array([(2.1, 0, 0), (1.9, 3, 1), (4.8, -7, 2)], np.float32)
    normal = np.array([(1, 0, 0), (-1, 0, 0), (1, 0, 0)], np.float32)
    assert planes.nearest(xyz, normal).tolist() == [0, 1, 2]
    both = Planes.join([planes, planes])
    signed = both.signed_distance(xyz, np.array([0, 1, 5], np.int32))
    assert len(both) == 6 and signed == pytest.approx([0.1, 0.1, -0.2], abs=1e-6)
