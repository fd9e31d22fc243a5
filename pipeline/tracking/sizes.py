"""Sizes of road users: unseen sides are completed with them, and categories are distinguished by them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.tracking.extents import completed
from scan2sim.pipeline.tracking.tracks import Category


class Size(NamedTuple):
    """Length, width, height in metres."""

    length: float
    width: float
    height: float


TYPICAL: dict[Category, Size] = {
    "car": Size(4.2, 1.75, 1.5),
    "van": Size(4.9, 1.95, 2.1),
    "truck": Size(8.0, 2.5, 3.3),
    "bus": Size(12.0, 2.55, 3.1),
    "motorcycle": Size(2.1, 0.8, 1.4),
    "cyclist": Size(1.75, 0.6, 1.75),
    "pedestrian": Size(0.6, 0.6, 1.72),
    "ego": Size(4.5, 1.8, 1.6),
}
"""Means of registered vehicles without mirrors (new cars of the EU, ICCT), of bicycles with riders, and of adults."""
LARGEST: dict[Category, Size] = {
    "car": Size(5.3, 2.05, 2.0),
    "van": Size(7.0, 2.3, 3.1),
    "truck": Size(19.0, 2.75, 4.2),
    "bus": Size(19.0, 2.75, 4.2),
    "motorcycle": Size(2.6, 1.1, 1.9),
    "cyclist": Size(2.4, 0.9, 2.1),
    "pedestrian": Size(1.2, 1.1, 2.1),
    "ego": Size(7.0, 2.3, 3.1),
}
CAR_HEIGHT_MAX_M = 1.95
"""Height from which a parked vehicle of a car's length is a van."""


class Habit(NamedTuple):
    """Share of a category among moving road users, mean and standard deviation of its speed (m/s)."""

    share: float
    speed: float
    speed_sigma: float


HABITS: dict[Category, Habit] = {
    "car": Habit(0.75, 12.0, 8.0),
    "van": Habit(0.08, 12.0, 8.0),
    "truck": Habit(0.05, 11.0, 7.0),
    "motorcycle": Habit(0.02, 13.0, 8.0),
    "cyclist": Habit(0.05, 4.5, 1.5),
    "pedestrian": Habit(0.05, 1.4, 0.5),
}
"""Shares in urban traffic, and usual speeds."""
HEIGHT_SPREAD = 0.09
"""Standard deviation of the height within a category, relative to the typical one."""
UNUSUAL = 1e-3
"""Relative density of sizes and speeds far from the usual ones."""


def categorize(length: tuple[float, float], width: tuple[float, float], height: float, speed: float) -> Category:
    """The likeliest category of a moving object.

    Args:
        length, width: extent that was seen of it, and the spacing of the points along it, metres.
        height: metres.
        speed: m/s.
    """

    def likelihood(category: Category) -> float:
        typical, largest, habit = TYPICAL[category], LARGEST[category], HABITS[category]
        value = habit.share * _normal(speed, habit.speed, habit.speed_sigma)
        value *= _normal(height, typical.height, HEIGHT_SPREAD * typical.height)
        for axis, (seen, gap) in enumerate((length, width)):
            value *= completed(seen, gap, axis, typical[axis], largest[axis])[2]
        return value

    return max(HABITS, key=likelihood)


def _normal(value: float, mean: float, sigma: float) -> float:
    """Normal density with heavy tails."""
    return float((np.exp(-(((value - mean) / sigma) ** 2) / 2) + UNUSUAL) / sigma)
