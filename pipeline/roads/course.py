"""Course of a vehicle along a road: the centre of its lane if lanes are known, else the reference line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.roads.lanes import Section, sections
from scan2sim.pipeline.roads.model import Road, surface

STEP_M = 0.5
"""Spacing of the points of a course."""


@dataclass(frozen=True)
class Course:
    """A polyline to drive along.

    Attributes:
        places: (N, 3) points in metres, in the road's frame.
        by: "lane", "road" (its reference line) or "path" (of the recording vehicle).
    """

    places: F64
    by: str

    @property
    def headings(self) -> F64:
        """Headings (N,) in radians from the x axis."""
        x, y = np.gradient(self.places[:, :2], axis=0).T
        return np.arctan2(y, x)


def course(road: Road) -> Course:
    """The course along a road, in the direction in which it was driven."""
    s = np.linspace(0.0, road.line.length, max(2, round(road.line.length / STEP_M) + 1))
    t, by = np.zeros(len(s)), "road"
    for section in sections(road):
        lane = _lane(section, road.keeps_right)
        if lane is not None:
            here = (s >= section.first) & (s <= section.last)
            left, right = (section.borders[k].offset.at(s[here]) for k in (lane, lane + 1))
            t[here], by = (left + right) / 2, "lane"
    return Course(surface(road, s, t), by)


def _lane(section: Section, keeps_right: bool) -> int | None:
    """Lane next to the centre line with traffic in the direction of the road; None if directions are unknown."""
    lane = section.centre if keeps_right else section.centre - 1
    return lane if 0 <= lane < len(section.kinds) and section.kinds[lane] == "driving" else None
