"""Box decomposition: walls of known position, against the boxes that a physics engine collides with."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, F64
from scan2sim.pipeline.geometry.box_decomposition import HEIGHT_STEP_M, boxes, samples

CELL = 0.2


def quad(a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]) -> F32:
    """The two triangles (2, 3, 3) of a parallelogram with the corners a, b, c."""
    p, q, r = (np.array(corner) for corner in (a, b, c))
    return np.array([[p, q, r], [p, r, r - q + p]], np.float32)


def wall(heading: float, length: float = 4.0, low: float = 0.1, high: float = 2.9) -> F32:
    """An upright wall from (0.31, 0.17) in a direction (radians)."""
    x, y = 0.31, 0.17
    u, v = x + length * np.cos(heading), y + length * np.sin(heading)
    return quad((x, y, low), (u, v, low), (u, v, high))


def points_on(corners: F32, count: int = 20_000) -> F64:
    """Random points (N, 3) on triangles (F, 3, 3)."""
    weights = np.random.default_rng(0).dirichlet((1, 1, 1), (len(corners), count // len(corners)))
    return (weights @ corners.astype(np.float64)).reshape(-1, 3)


def outside(points: F64, low: F64, high: F64) -> F64:
    """Distance (N,) of points (N, 3) from the nearest box, by exhaustive search; 0 inside."""
    apart = np.maximum(np.maximum(low - points[:, None], points[:, None] - high), 0)
    return np.asarray(np.linalg.norm(apart, axis=2).min(axis=1))


@pytest.mark.parametrize("heading", [0.0, 0.4, np.pi / 4, 2.0])
def test_boxes_contain_a_wall_and_extend_beyond_it_by_at_most_a_cell(heading: float) -> None:
    corners = wall(heading)
    low, high = boxes(corners, CELL)
    # samples are half a cell apart: a corner of a cell without a sample may stay free
    assert outside(points_on(corners), low, high).max() < CELL / 2 / np.sqrt(3)
    across = np.array([-np.sin(heading), np.cos(heading)])
    for x in (low[:, 0], high[:, 0]):
        for y in (low[:, 1], high[:, 1]):
            off = np.abs((np.column_stack([x, y]) - corners[0, 0, :2]) @ across)
            assert off.max() <= CELL * np.sqrt(2)
    assert low[:, 2].min() == 0.0 and high[:, 2].max() == 3.0, "not rounded down and up to steps of 25 cm"


@pytest.mark.parametrize("heading", [0.1, 0.6, np.pi / 4, 1.3])
def test_nothing_passes_between_the_boxes_of_a_wall(heading: float) -> None:
    """A sphere of 1 mm that crosses the wall anywhere collides with a box."""
    low, high = boxes(wall(heading), CELL)
    along, across = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    start = np.array([0.31, 0.17]) + np.linspace(0.1, 3.9, 381)[:, None] * along
    path = start[:, None] + np.linspace(-0.4, 0.4, 801)[:, None] * across
    for height in (0.3, 1.5, 2.7):
        points = np.column_stack([path.reshape(-1, 2), np.full(path.size // 2, height)])
        hit = np.concatenate([outside(part, low, high) < 0.001 for part in np.array_split(points, 40)])
        assert hit.reshape(len(start), -1).any(axis=1).all()


def test_a_wall_along_an_axis_is_one_box() -> None:
    low, high = boxes(quad((0.1, 0.1, 0.1), (4.1, 0.1, 0.1), (4.1, 0.1, 2.9)), CELL)
    assert low == pytest.approx(np.array([[0.0, 0.0, 0.0]])) and high == pytest.approx(np.array([[4.2, 0.2, 3.0]]))


@pytest.mark.parametrize("heading", [0.0, 0.4, 1.1])
@pytest.mark.parametrize(("bottom", "top"), [(0.0, 3.0), (0.25, 2.5), (-1.75, 1.0)])
def test_heights_at_multiples_of_the_step_are_kept(heading: float, bottom: float, top: float) -> None:
    low, high = boxes(wall(heading, 3.7, bottom, top), CELL)
    assert set(low[:, 2]) == {bottom} and set(high[:, 2]) == {top}


def test_level_plate_is_one_box_with_the_thickness_of_a_height_step() -> None:
    low, high = boxes(quad((0.1, 0.1, 0.6), (2.1, 0.1, 0.6), (2.1, 1.1, 0.6)), CELL)
    assert low == pytest.approx(np.array([[0.0, 0.0, 0.5]]))
    assert high == pytest.approx(np.array([[2.2, 1.2, 0.5 + HEIGHT_STEP_M]]))


def test_parts_of_different_height_are_not_merged() -> None:
    """A low wall next to a high one must not be raised, nor the high one lowered."""
    high_part = quad((0.1, 0.1, 0.1), (2.1, 0.1, 0.1), (2.1, 0.1, 2.9))
    low_part = quad((2.3, 0.1, 0.1), (4.1, 0.1, 0.1), (4.1, 0.1, 0.9))
    low, high = boxes(np.concatenate([high_part, low_part]), CELL)
    order = np.argsort(low[:, 0])
    assert low[order] == pytest.approx(np.array([[0, 0, 0], [2.2, 0, 0]]))
    assert high[order] == pytest.approx(np.array([[2.2, 0.2, 3.0], [4.2, 0.2, 1.0]]))


def test_boxes_do_not_overlap() -> None:
    corners = np.concatenate([wall(0.0), wall(0.7), wall(1.5, high=1.2)])
    low, high = boxes(corners, CELL)
    overlap = np.minimum(high[:, None, :2], high[:, :2]) - np.maximum(low[:, None, :2], low[:, :2])
    np.fill_diagonal(overlap[..., 0], -1.0)
    assert not (overlap > 1e-6).all(axis=2).any()


def test_boxes_are_equivariant_to_shifts_and_independent_of_triangle_order() -> None:
    corners = np.concatenate([wall(0.4), wall(1.9)])
    low, high = boxes(corners, 0.25)
    shift = np.array([12.5, -7.25, 3.75], np.float32)  # whole cells and steps, exact in binary
    exact = (np.round(corners * 256) / 256).astype(np.float32)
    low_moved, high_moved = boxes(exact + shift, 0.25)
    low_exact, high_exact = boxes(exact, 0.25)
    np.testing.assert_array_equal(low_moved, low_exact + shift)
    np.testing.assert_array_equal(high_moved, high_exact + shift)
    np.testing.assert_array_equal(boxes(corners[::-1, [1, 2, 0]], 0.25)[0], low)
    np.testing.assert_array_equal(boxes(corners, 0.25)[1], high)


def test_samples_are_dense_and_include_the_corners() -> None:
    corners = np.array([[[0, 0, 0], [3, 0, 0], [0.2, 1.1, 0.4]], [[5, 5, 5], [5.1, 5, 5], [5, 5.1, 5]]], np.float32)
    found = samples(corners, 0.3)
    for corner in corners.reshape(-1, 3):
        assert np.linalg.norm(found - corner, axis=1).min() < 1e-6
    distance = np.linalg.norm(points_on(corners, 2000)[:, None] - found, axis=2).min(axis=1)
    assert distance.max() < 0.3 / np.sqrt(3) + 1e-6


def test_degenerate_triangles_are_accepted() -> None:
    none = boxes(np.zeros((0, 3, 3), np.float32), CELL)
    assert none[0].shape == none[1].shape == (0, 3)
    point = boxes(np.full((1, 3, 3), 0.3, np.float32), CELL)
    assert point[0] == pytest.approx(np.array([[0.2, 0.2, 0.25]]))
    assert point[1] == pytest.approx(np.array([[0.4, 0.4, 0.5]]))
    line = boxes(np.array([[[0.1, 0.1, 0.1], [0.5, 0.1, 0.1], [0.9, 0.1, 0.1]]], np.float32), CELL)
    assert line[0] == pytest.approx(np.array([[0, 0, 0]])) and line[1] == pytest.approx(np.array([[1.0, 0.2, 0.25]]))
