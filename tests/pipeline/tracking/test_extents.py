"""Completion of vehicle boxes, and categories by size and speed."""

import numpy as np
import pytest

from scan2sim.pipeline.tracking import extents, parked
from scan2sim.pipeline.tracking.sizes import TYPICAL, categorize
from scan2sim.pipeline.tracking.tracks import footprint


@pytest.mark.parametrize(
    ("length", "width", "height", "speed", "category"),
    [
        ((4.1, 0.1), (1.6, 0.1), 1.45, 12.0, "car"),
        ((0.4, 2.0), (1.6, 0.1), 1.45, 12.0, "car"),  # from behind
        ((4.7, 0.1), (1.9, 0.1), 2.2, 12.0, "van"),
        ((9.0, 0.2), (2.4, 0.1), 3.4, 12.0, "truck"),
        ((1.6, 0.1), (0.5, 0.1), 1.7, 5.0, "cyclist"),
        ((0.5, 0.05), (0.5, 0.05), 1.75, 1.4, "pedestrian"),
        ((2.1, 0.1), (0.7, 0.1), 1.4, 15.0, "motorcycle"),
    ],
)
def test_category_is_determined_by_size_and_speed(
    length: tuple[float, float], width: tuple[float, float], height: float, speed: float, category: str
) -> None:
    assert categorize(length, width, height, speed) == category


def test_unseen_length_is_typical_and_fully_seen_side_measured() -> None:
    typical, largest = TYPICAL["car"].length, 5.3
    mean, sigma, _ = extents.completed(0.5, 10.0, 0, typical, largest)
    assert mean == pytest.approx(typical, abs=0.1) and sigma > 0.3
    mean, sigma, _ = extents.completed(3.6, 0.05, 0, typical, largest)
    assert 3.6 <= mean < 3.85 and sigma < 0.25


def sides(size: tuple[float, float, float], pose: tuple[float, float, float, float], seen: str) -> np.ndarray:
    """Points on sides of a box: of "front", "rear", "left", "right"."""
    rng = np.random.default_rng(0)
    corners = footprint(size, pose)
    ends = {"front": (3, 0), "left": (0, 1), "rear": (1, 2), "right": (2, 3)}
    parts = []
    for name in seen.split():
        a, b = (corners[k] for k in ends[name])
        share = rng.random((400, 1))
        parts.append(np.column_stack([a + share * (b - a), pose[2] + rng.uniform(0.2, size[2], 400)]))
    return np.concatenate(parts) + rng.normal(scale=0.01, size=(400 * len(parts), 3))


def test_parked_car_seen_from_the_road_gets_its_whole_box() -> None:
    pose, size = (10.0, -3.0, 0.0, 0.1), (4.4, 1.75, 1.5)
    points = sides(size, pose, "rear left front")
    path = np.column_stack([np.linspace(-10, 30, 40), np.zeros(40)])
    box = parked.fit(points, points[:, 2], 0.05, path)
    assert np.hypot(*(box.centre - pose[:2])) < 0.08
    assert abs(box.yaw - 0.1) < np.radians(1.5)
    np.testing.assert_allclose(box.size, size, atol=0.1)


def test_parked_car_of_which_the_rear_was_seen_is_completed_away_from_the_scanner() -> None:
    pose, size = (30.0, 0.5, 0.0, 0.0), (4.2, 1.75, 1.5)
    points = sides(size, pose, "rear")
    path = np.column_stack([np.linspace(-10, 5, 20), np.zeros(20)])
    box = parked.fit(points, points[:, 2], 0.0, path)
    assert np.hypot(*(box.centre - pose[:2])) < 0.25
    assert box.sigma[0] > 0.15


def test_hedge_below_a_post_is_not_a_vehicle_body() -> None:
    rng = np.random.default_rng(0)
    hedge = rng.uniform([-2, -0.7, 0.1], [2, 0.7, 0.55], (600, 3))
    post = rng.uniform([-0.1, -0.1, 0.1], [0.1, 0.1, 1.5], (80, 3))
    points = np.concatenate([hedge, post])
    assert not parked.has_body(points, points[:, 2], np.zeros(2), 0.0)
    car = sides((4.2, 1.75, 1.5), (0, 0, 0, 0), "left front")
    assert parked.has_body(car, car[:, 2], np.zeros(2), 0.0)
