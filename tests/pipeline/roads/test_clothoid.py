"""Chains of clothoids follow arcs and corners, and are robust to noise and outliers."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.roads import clothoid, driven, profile
from scan2sim.pipeline.roads.observed import Observed, join


def arc(radius: float, length: float, step: float = 0.5) -> np.ndarray:
    angle = np.arange(0, length, step) / radius
    return np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle))])


@pytest.mark.parametrize("radius", [60.0, -400.0])
def test_arc_is_fitted_in_spite_of_noise_and_outliers(radius: float) -> None:
    rng = np.random.default_rng(0)
    true = arc(radius, 100.0)
    seen = true + rng.normal(0, 0.05, true.shape)
    seen[::10] += rng.uniform(-3, 3, seen[::10].shape)
    line = clothoid.fit(clothoid.approximate(true[::10] + rng.normal(0, 0.3, true[::10].shape)), seen)
    found = line.points(np.linspace(1, line.length - 1, 200))
    away = np.abs(np.linalg.norm(found - [0, radius], axis=1) - abs(radius))
    assert away.max() < 0.06
    assert 1 / np.median(line.curvature) == pytest.approx(radius, rel=0.1)


def test_line_follows_a_corner() -> None:
    bend = arc(8.0, 4 * np.pi, 0.4)
    before, after = np.arange(-30.0, 0.0), np.arange(1.0, 31.0)
    way = np.concatenate([np.column_stack([before, 0 * before]), bend, np.column_stack([0 * after + 8, 8 + after])])
    line = clothoid.fit(clothoid.approximate(way), way)
    assert np.abs(line.locate(way)[1]).max() < 0.3


def test_locate_inverts_points() -> None:
    line = clothoid.fit(clothoid.approximate(arc(50.0, 80.0)), arc(50.0, 80.0))
    s, t = np.array([-3.0, 0.5, 33.3, 79.0, 90.0]), np.array([1.0, -4.0, 8.0, 0.0, 2.0])
    np.testing.assert_allclose(line.locate(line.points(s, t)), (s, t), atol=1e-3)
    part = line.part(10.2, 60.7)
    np.testing.assert_allclose(part.points([0.0, 20.0, 50.5]), line.points([10.2, 30.2, 60.7]), atol=1e-9)


def test_elevation_profile_is_robust_to_outliers() -> None:
    rng = np.random.default_rng(1)
    s = np.linspace(0, 100, 400)
    values = 0.2 * np.sin(s / 17) + rng.normal(0, 0.02, 400)
    values[80:130] += 2.0
    knots = np.linspace(0, 100, 11)
    found = profile.fit(knots, s, values, 0.02, 0.05)
    assert np.abs(found.at(s) - 0.2 * np.sin(s / 17)).max() < 0.06
    for begin, cubic in found.pieces(13.0, 58.0):
        x = np.array([0.0, 2.0])
        np.testing.assert_allclose(cubic @ x ** np.arange(4)[:, None], found.at(begin + x), atol=1e-9)


def test_repeated_passes_become_one_road() -> None:
    there = np.column_stack([np.arange(0.0, 60.0), np.zeros(60)])
    back = there[::-1] + [0.0, 3.4]
    across = np.column_stack([np.full(40, 30.0), np.arange(-20.0, 20.0)])
    path = np.concatenate([there, back, across])
    on = np.ones(len(path), bool)
    on[118:122] = False
    lengths = sorted(len(way) for way in driven.ways(path, on))
    assert len(lengths) == 2 and 59 <= lengths[1] <= 64 and lengths[0] > 35
    assert driven.ways(there[:2], np.ones(2, bool)) == [] == driven.ways(there, np.zeros(60, bool))


def seen_along(way: np.ndarray) -> Observed:
    one = np.ones(len(way))
    edge = np.column_stack([way + [0, 3], one, one])
    return Observed(way, way + [0, 1], np.zeros(len(way), np.int64), one, edge, np.zeros((0, 3)))


def test_consecutive_paths_are_joined_in_either_direction() -> None:
    line = np.column_stack([np.arange(0.0, 120.0), np.zeros(120)])
    across = np.column_stack([np.full(30, 61.0), np.arange(5.0, 35.0)])
    parts = [seen_along(p) for p in (line[80:], line[40:79][::-1], across, line[:39])]
    ways = sorted(join(parts), key=lambda way: len(way.way))
    assert [len(way.way) for way in ways] == [30, 118]
    assert np.all(np.abs(np.diff(ways[1].way[:, 0])) < 3) and len(np.unique(np.sign(np.diff(ways[1].way[:, 0])))) == 1
    assert len(np.unique(ways[1].stroke)) == 3
    sides = {float(x): side for x, _, side, _ in ways[1].edge}
    assert len(set(sides.values())) == 2  # one of the three was driven in the other direction
    assert join([]) == []


def test_ring_roads_are_opened_and_long_roads_split() -> None:
    angle = np.linspace(0, 2 * np.pi, 200)
    ring = 30 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert [len(way.way) for way in join([seen_along(ring[:100]), seen_along(ring[100:])])] == [200]
    line = np.column_stack([np.arange(0.0, 2500.0), np.zeros(2500)])
    pieces = driven.ways(line, np.ones(len(line), bool))
    assert len(pieces) == 3 and max(map(driven.length, pieces)) <= driven.MAX_LENGTH_M
    assert len(join([seen_along(piece) for piece in pieces])) == 3
