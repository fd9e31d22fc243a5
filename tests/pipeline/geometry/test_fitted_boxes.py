"""Boxes fitted to points: position, gaps between objects, tables, hidden parts, maximum number."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, Frame, Mesh
from scan2sim.pipeline.geometry.fitted_boxes import Box, Surroundings, fit_boxes, mesh_of
from scan2sim.pipeline.geometry.surface_distance import distances


def box(low: tuple[float, float, float], high: tuple[float, float, float], seed: int = 0) -> F32:
    """Points on the sides and the top of a box, 5 cm apart on average."""
    rng = np.random.default_rng(seed)
    size = np.subtract(high, low)
    points = rng.uniform(0, 1, (int(400 * (2 * size[2] * (size[0] + size[1]) + size[0] * size[1])), 3))
    area = np.array([size[1] * size[2]] * 2 + [size[0] * size[2]] * 2 + [size[0] * size[1]])
    side = rng.choice(5, len(points), p=area / area.sum())
    points[np.arange(len(points)), side // 2] = np.where(side == 4, 1, side % 2)
    return (low + points * size).astype(np.float32)


def test_points_of_one_box_give_one_box() -> None:
    xyz = box((1, 2, 0), (2.2, 2.6, 0.8))
    (found,) = fit_boxes(xyz, 0.05)
    vertices, faces = mesh_of([found])
    assert len(faces) == 12
    assert np.allclose(vertices.min(axis=0), (1, 2, 0), atol=0.06)
    assert np.allclose(vertices.max(axis=0), (2.2, 2.6, 0.8), atol=0.06)
    mesh = Mesh(Frame(), vertices, faces)
    a, b, c = np.moveaxis(mesh.corners.astype(np.float64), 1, 0)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0  # faces point outwards


def test_boxes_of_an_l_shape_leave_its_corner_free() -> None:
    xyz = np.concatenate([box((0, 0, 0), (3, 0.5, 0.8)), box((0, 0.5, 0), (0.5, 3, 0.8), 1)])
    found = fit_boxes(xyz, 0.05)
    vertices, faces = mesh_of(found)
    assert 2 <= len(found) <= 16
    mesh = Mesh(Frame(), vertices, faces)
    assert np.quantile(distances(xyz, mesh), 0.95) < 0.1
    free = np.array([[1.5, 1.5, 0.4]])
    inside = [
        np.all(np.abs((free[0] - v.mean(axis=0))[:2]) < np.ptp(v, axis=0)[:2] / 2) for v in vertices.reshape(-1, 8, 3)
    ]
    assert not any(inside)


def test_scattered_points_stay_within_the_maximum_number_of_boxes() -> None:
    xyz = np.random.default_rng(0).uniform(0, 2, (2000, 3)).astype(np.float32)
    assert len(fit_boxes(xyz, 0.1, max_boxes=3)) <= 3
    assert fit_boxes(np.zeros((0, 3), np.float32), 0.05) == []
    assert fit_boxes(xyz[:5], 0.05) == []


def floor(low: tuple[float, float], high: tuple[float, float], without: tuple[F32, ...] = ()) -> F32:
    """Points of a floor at z = 0, 4 cm apart, except below boxes (2, 2) `without`."""
    x, y = np.meshgrid(np.arange(low[0], high[0], 0.04), np.arange(low[1], high[1], 0.04))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float32)
    for hole in without:
        xyz = xyz[~((xyz[:, :2] > hole[0]) & (xyz[:, :2] < hole[1])).all(axis=1)]
    return xyz


def is_inside(boxes: list[Box], position: tuple[float, float, float]) -> bool:
    """Whether a position is in a box with heading 0."""
    return any(bool(((position >= one.low) & (position <= one.high)).all()) for one in boxes)


def table(at: float = 0.0) -> F32:
    """Points of a table of 1.6 x 0.9 m, 0.75 m high, with four legs."""
    legs = [box((at + x, y, 0.1), (at + x + 0.08, y + 0.08, 0.72), 3) for x in (0, 1.52) for y in (0, 0.82)]
    top = [box((at, 0, 0.72), (at + 1.6, 0.9, 0.75), seed) for seed in (4, 5, 6)]
    return np.concatenate([*top, *legs])


def test_table_is_open_below_its_top() -> None:
    around = Surroundings(floor((-2, -2), (3, 3)), 0.0)
    boxes = fit_boxes(table(), 0.05, around=around)
    assert is_inside(boxes, (0.8, 0.45, 0.745))
    assert not is_inside(boxes, (0.8, 0.45, 0.3))
    assert is_inside(boxes, (0.04, 0.04, 0.05))  # a leg reaches the floor


def test_front_of_a_cupboard_becomes_a_solid_box() -> None:
    front = box((0, 0, 0.1), (1.2, 0.02, 0.9))
    side = box((0, 0, 0.1), (0.02, 0.5, 0.9), 1)
    solid = np.array([[0, 0], [1.2, 0.5]], np.float32)
    around = Surroundings(floor((-2, -2), (3, 3), (solid,)), 0.0)
    boxes = fit_boxes(np.concatenate([front, side]), 0.05, around=around)
    assert is_inside(boxes, (0.2, 0.2, 0.05))
    assert not is_inside(boxes, (1.5, 0.3, 0.3))
    assert len(boxes) <= 6


def test_sides_of_a_box_are_unbiased_by_noise() -> None:
    rng = np.random.default_rng(0)
    xyz = box((0, 0, 0.1), (1.2, 0.6, 0.8))
    noisy = (xyz + rng.normal(0, 0.05, xyz.shape) * [1, 1, 0]).astype(np.float32)
    boxes = fit_boxes(noisy, 0.05, around=Surroundings(floor((-2, -2), (3, 3)), 0.0, noise=0.05))
    one = max(boxes, key=lambda box: float(np.prod(box.high - box.low)))
    assert np.allclose(one.low[:2], 0, atol=0.06) and np.allclose(one.high[:2], (1.2, 0.6), atol=0.06)


def test_adjacent_objects_keep_the_heading_of_the_walls() -> None:
    xyz = np.concatenate([box((0, 0, 0.1), (1.5, 0.6, 0.8)), box((1.55, 0.3, 0.1), (2.1, 1.8, 0.8), 1)])
    boxes = fit_boxes(xyz, 0.05, around=Surroundings(floor((-2, -2), (4, 4)), 0.0))
    assert all(one.heading == 0 for one in boxes)
    assert not is_inside(boxes, (0.7, 1.2, 0.3))
