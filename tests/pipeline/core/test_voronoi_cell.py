"""Voronoi cells of tiles: every position belongs to one tile, and neighbours compute the same border."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.voronoi_cell import Cell, beyond, cells, outline

SQUARES = {"a": (0.0, 0.0), "b": (10.0, 0.0), "c": (0.0, 10.0), "d": (10.0, 10.0)}


def scattered(n: int = 25, seed: int = 0) -> dict[str, tuple[float, float]]:
    places = np.random.default_rng(seed).uniform(690_000, 690_500, (n, 2))
    return {f"t_{i:04d}": (x, y) for i, (x, y) in enumerate(places.tolist())}


def test_squares_that_meet_in_a_corner_are_neighbours() -> None:
    made = cells(SQUARES, max_distance=30.0)
    for name, cell in made.items():
        assert cell.seed == SQUARES[name]
        assert list(cell.neighbours) == sorted(set(SQUARES) - {name})


def test_neighbour_relation_is_symmetric() -> None:
    made = cells(scattered(), max_distance=1e4)
    for name, cell in made.items():
        for other, seed in cell.neighbours.items():
            assert made[other].seed == seed and made[other].neighbours[name] == cell.seed


def test_every_position_is_in_the_cell_of_its_nearest_seed_only() -> None:
    seeds = scattered()
    made = cells(seeds, max_distance=1e4)
    xy = np.random.default_rng(1).uniform(690_000, 690_500, (2000, 2))
    nearest = np.argmin(np.linalg.norm(xy[:, None] - np.array(list(seeds.values())), axis=2), axis=1)
    for i, cell in enumerate(made.values()):
        assert np.array_equal(cell.outside(xy) < 0, nearest == i)


def test_border_distance_is_identical_from_both_sides() -> None:
    a, b = (690_012.345, 5_335_000.1), (690_100.777, 5_335_031.9)
    xy = np.random.default_rng(2).uniform(-100, 100, (100, 2)) + a
    assert np.array_equal(beyond(a, b, xy), -beyond(b, a, xy))
    assert np.allclose(beyond(a, b, np.array([a, b])), [-np.hypot(88.432, 31.8) / 2, np.hypot(88.432, 31.8) / 2])


def test_outlines_are_counter_clockwise_and_fill_the_plane() -> None:
    made = cells(SQUARES, max_distance=30.0)
    corners = outline(made["a"], np.subtract(made["a"].seed, 20.0), np.add(made["a"].seed, 20.0))
    x, y = corners.T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2
    assert area == 25.0**2  # from -20 to the border at 5, both ways


def test_single_tile_contains_every_position() -> None:
    (cell,) = cells({"a": (1.0, 2.0)}, max_distance=10.0).values()
    assert cell == Cell((1.0, 2.0)) and (cell.outside(np.zeros((3, 2))) == -np.inf).all()
    assert cells({}, max_distance=10.0) == {}


def test_seeds_far_apart_are_not_neighbours() -> None:
    assert not cells({"a": (0.0, 0.0), "b": (100.0, 0.0)}, max_distance=99.0)["a"].neighbours
