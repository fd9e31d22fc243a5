"""A straight road of two lanes with known traffic: the ego, a car ahead, a van that comes towards it, a cyclist, a
pedestrian, a parked car."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.roads.clothoid import Clothoids
from scan2sim.pipeline.roads.model import Line, Road
from scan2sim.pipeline.roads.profile import Profile
from scan2sim.pipeline.tracking.tracks import Category, Track

LENGTH_M, LANE_M, HEIGHT_M = 120.0, 3.5, 10.0
START_S = 1_700_000_000.0
"""The recording's clock at its beginning."""


def road() -> Road:
    """Along the x axis, with a broken centre line on it and edges `LANE_M` to each side."""
    knots = np.linspace(0.0, LENGTH_M, 13)

    def line(kind: str, offset: float, **marking: object) -> Line:
        flat = Profile.constant(knots, offset)
        return Line(kind, flat, ((0.0, LENGTH_M),), 0.0, np.empty((0, 2)), **marking)  # type: ignore[arg-type]

    centre = line("marking", 0.0, marking="broken", width=0.12, dash=3.0, gap=3.0, first=0.0)
    height = Profile.constant(knots, HEIGHT_M)
    flat = Profile.constant(knots, 0.0)
    axis = Clothoids(np.zeros(2), 0.0, knots, np.zeros(len(knots)))
    return Road(axis, "marking", height, (flat, flat), (centre,), line("left", LANE_M), line("right", -LANE_M))


def drive(
    number: int,
    category: Category,
    size: tuple[float, float, float],
    along: tuple[float, float],
    aside: float,
    begin: float,
    speed: float,
) -> Track:
    """A track along the road from one chainage to another, at an offset to its left, from a time after the start on."""
    first, last = along
    duration = abs(last - first) / speed
    times = np.linspace(0.0, duration, round(10 * duration) + 1)
    x = np.linspace(first, last, len(times))
    yaw = np.full(len(times), 0.0 if last > first else np.pi)
    poses = np.column_stack([x, np.full(len(times), aside), np.full(len(times), HEIGHT_M), yaw])
    return Track(number, category, size, START_S + begin + times, poses, np.full((len(times), 2), 0.05), True, None)


def tracks() -> list[Track]:
    """All of them, on the recording's clock."""
    pose, colour = np.array([[60.0, -5.0, HEIGHT_M, 0.0]]), (20, 20, 60)
    parked = Track(6, "car", (4.4, 1.8, 1.5), np.array([START_S + 3.0]), pose, np.zeros((1, 2)), False, colour)
    return [
        drive(0, "ego", (4.3, 1.8, 1.6), (5.0, 60.0), -1.75, 0.0, 11.0),
        drive(1, "car", (4.2, 1.75, 1.5), (25.0, 85.0), -1.75, 0.0, 12.0),
        drive(2, "van", (5.2, 2.0, 2.3), (110.0, 10.0), 1.75, 1.0, 25.0),
        drive(3, "cyclist", (1.8, 0.6, 1.8), (30.0, 44.0), -3.1, 0.5, 4.0),
        drive(4, "pedestrian", (0.6, 0.55, 1.75), (50.0, 54.0), -7.0, 1.0, 1.4),
        parked,
    ]
