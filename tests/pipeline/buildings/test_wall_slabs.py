"""Walls of synthetic rooms: position, thickness, openings, corners, number of triangles."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.buildings.wall_slabs import Wall, fit_walls, mesh_of, rectangles
from scan2sim.pipeline.core.types import F32, F64, Frame, Mesh

NONE = np.zeros((0, 3), np.float32)
HEIGHT_M, NOISE_M = 2.6, 0.03
DOOR = (2.0, 2.95)


def wall(a: tuple[float, float], b: tuple[float, float], seed: int = 0, door: tuple[float, float] | None = None) -> F64:
    """Points on a vertical rectangle from a to b; `door`: start and end of an opening 2.05 m high, along it."""
    rng = np.random.default_rng(seed)
    start, end = np.array(a), np.array(b)
    length = float(np.linalg.norm(end - start))
    count = int(length * HEIGHT_M * 500)
    u, z = rng.uniform(0, length, count), rng.uniform(0, HEIGHT_M, count)
    if door:
        keep = ~((u > door[0]) & (u < door[1]) & (z < 2.05))
        u, z = u[keep], z[keep]
    along = (end - start) / length
    off = rng.normal(0, NOISE_M, len(u))
    xy = start + u[:, None] * along + off[:, None] * [-along[1], along[0]]
    return np.column_stack([xy, z])


def room(turn: float = 0.0) -> tuple[F32, F32]:
    """Two rooms of 5 x 4 m, a wall of 14 cm between them with a door: wall points and floor points."""
    parts = [
        wall((0, 0), (5, 0), 1), wall((5, 0), (5, 8.14), 2), wall((0, 8.14), (5, 8.14), 3), wall((0, 0), (0, 8.14), 4),
        wall((0, 4), (5, 4), 5, DOOR), wall((0, 4.14), (5, 4.14), 6, DOOR),
    ]  # fmt: skip
    rng = np.random.default_rng(7)
    floor = np.column_stack([rng.uniform(0, 5, 12_000), rng.uniform(0, 8.14, 12_000), rng.normal(0, 0.01, 12_000)])
    inside = (floor[:, 1] < 4) | (floor[:, 1] > 4.14) | ((floor[:, 0] > DOOR[0]) & (floor[:, 0] < DOOR[1]))
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    walls, ground = np.concatenate(parts) @ R.T, floor[inside] @ R.T
    return walls.astype(np.float32), ground.astype(np.float32)


@pytest.fixture(scope="module", params=[0.0, 0.4], ids=["straight", "turned"])
def walls(request: pytest.FixtureRequest) -> list[Wall]:
    points, floor = room(request.param)
    return fit_walls(points, floor, NONE, 0.0, HEIGHT_M, 0.045)


def between(walls: list[Wall]) -> Wall:
    (found,) = [one for one in walls if one.sides == 2]
    return found


def test_every_wall_is_found_once(walls: list[Wall]) -> None:
    assert len(walls) == 5
    assert sorted(round(one.run.length) for one in walls) == [5, 5, 5, 8, 8]


def test_wall_between_rooms_has_its_true_thickness_and_position(walls: list[Wall]) -> None:
    run = between(walls).run
    assert 2 * run.half == pytest.approx(0.14, abs=0.03)
    assert abs(run.offset) == pytest.approx(4.07, abs=0.015)


def test_wall_seen_from_one_side_is_thin_and_ends_at_its_face(walls: list[Wall]) -> None:
    thin = [one for one in walls if one.sides == 1]
    assert all(2 * one.run.half == pytest.approx(0.03) for one in thin)
    assert min(abs(abs(one.run.offset) - one.run.half - 0.0) for one in thin) < 0.01


def test_door_is_open_and_other_walls_are_not(walls: list[Wall]) -> None:
    assert sum(len(one.openings) for one in walls) == 1
    start, end, low, high = between(walls).openings[0]
    assert end - start == pytest.approx(0.95, abs=0.12)
    assert low < 0 and high == pytest.approx(2.05, abs=0.15)


def test_person_in_a_door_does_not_close_it() -> None:
    points, floor = room()
    rng = np.random.default_rng(8)
    angle, z = rng.uniform(0, 2 * np.pi, 250), rng.uniform(0, 1.75, 250)
    person = np.column_stack([2.45 + 0.22 * np.cos(angle), 4.07 + 0.22 * np.sin(angle), z])
    found = fit_walls(np.concatenate([points, person]).astype(np.float32), floor, NONE, 0.0, HEIGHT_M, 0.045)
    assert sum(len(one.openings) for one in found) == 1


def test_hidden_part_of_an_outer_wall_is_not_a_door() -> None:
    points, floor = room()
    behind = (points[:, 1] < 0.2) & (points[:, 0] > 2) & (points[:, 0] < 3.2) & (points[:, 2] < 1.9)
    found = fit_walls(points[~behind], floor, NONE, 0.0, HEIGHT_M, 0.045)
    doors = [one for wall in found for one in wall.openings if one[2] < 0]
    assert len(doors) == 1  # there is floor on one side only


def test_hidden_wall_is_not_an_opening() -> None:
    points, floor = room()
    behind = (points[:, 1] < 0.2) & (points[:, 0] > 2) & (points[:, 0] < 3.2) & (points[:, 2] < 1.9)
    rng = np.random.default_rng(0)
    shelf = np.column_stack([rng.uniform(2, 3.2, 3000), rng.uniform(0.2, 0.5, 3000), rng.uniform(0, 1.9, 3000)])
    floor = floor[~((floor[:, 1] < 0.5) & (floor[:, 0] > 2) & (floor[:, 0] < 3.2))]
    found = fit_walls(points[~behind], floor, shelf.astype(np.float32), 0.0, HEIGHT_M, 0.045)
    assert sum(len(one.openings) for one in found) == 1  # the door


def test_corners_are_closed_with_few_triangles(walls: list[Wall]) -> None:
    vertices, faces = mesh_of(walls)
    assert len(faces) < 120
    corner = np.linalg.norm(vertices[:, :2], axis=1) < 0.1
    assert corner.sum() >= 8  # of two walls, below and above
    assert vertices[:, 2].min() == 0 and vertices[:, 2].max() == np.float32(HEIGHT_M)


def test_slab_faces_outwards() -> None:
    points, _ = room()
    one = fit_walls(points, NONE, NONE, 0.0, HEIGHT_M, 0.045)[0]
    vertices, faces = mesh_of([one])
    mesh = Mesh(Frame(), vertices, faces)
    a, b, c = np.moveaxis(mesh.corners.astype(np.float64), 1, 0)
    volume = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6
    assert volume == pytest.approx(2 * one.run.half * one.run.length * HEIGHT_M, rel=1e-3)


def test_walls_without_floor_and_ceiling_end_at_their_outermost_points() -> None:
    points, _ = room()
    found = fit_walls(points, NONE, NONE, None, None, 0.045)
    assert len(found) == 5
    assert all(one.low < 0.1 and one.high > HEIGHT_M - 0.1 for one in found)
    assert fit_walls(NONE, NONE, NONE, None, None, 0.045) == []


def test_rectangles_cover_a_mask_once() -> None:
    mask = np.random.default_rng(0).random((9, 7)) < 0.7
    cover = np.zeros(mask.shape, int)
    for i0, i1, j0, j1 in rectangles(mask):
        cover[i0:i1, j0:j1] += 1
    assert np.array_equal(cover, mask.astype(int))
