"""Lanes of a road: strips between its lines, per section."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scan2sim.pipeline.roads.model import Line, Road
from scan2sim.pipeline.roads.profile import Profile

Kind = Literal["driving", "bidirectional", "shoulder", "restricted"]
MIN_SECTION_M = 5.0
"""Minimum length of a section."""
MIN_LANE_WIDTH_M = 2.0
"""Narrower strips are not for driving."""
MAX_SHOULDER_WIDTH_M = 4.5
"""A narrower strip between a solid line and the road's edge is a shoulder (or a parking bay)."""
DOUBLE_LINE_M = 0.4
"""Largest distance between the two lines of a double line."""


@dataclass(frozen=True)
class Border:
    """Border of a lane: a line, or None if nothing is painted."""

    offset: Profile
    line: Line | None


@dataclass(frozen=True)
class Section:
    """A section of a road with constant lanes.

    Attributes:
        first, last: chainages.
        borders: lane borders from left to right.
        kinds: kinds of the lanes between them.
        centre: index of the border between the two directions; 0 if all lanes are to its right.
    """

    first: float
    last: float
    borders: tuple[Border, ...]
    kinds: tuple[Kind, ...]
    centre: int

    @property
    def middle(self) -> float:
        """Chainage of its middle."""
        return (self.first + self.last) / 2


def sections(road: Road) -> list[Section]:
    """Sections of the road; empty if it doesn't have two lines beside each other everywhere.

    The direction of lanes is only known where a centre line is painted, and follows from the side that was driven on.
    Otherwise lanes are "bidirectional".
    """
    cuts = [0.0]
    for at in sorted(s for line in road.markings for s in line.span):
        if at - cuts[-1] > MIN_SECTION_M and road.line.length - at > MIN_SECTION_M:
            cuts.append(at)
    found = [_section(road, a, b) for a, b in zip(cuts, [*cuts[1:], road.line.length], strict=True)]
    return found if all(section.kinds for section in found) else []


def _section(road: Road, first: float, last: float) -> Section:
    middle = (first + last) / 2
    here = [line for line in road.markings if min(line.span[1], last) - max(line.span[0], first) > (last - first) / 2]
    borders = [Border(line.offset, line) for line in (road.left, *here, road.right) if line]
    borders.sort(key=lambda border: -float(border.offset.at(middle)))
    borders = _merge_double_lines(borders, middle)
    centre = 0
    if road.reference == "marking":
        flat = Profile.constant(road.height.knots, 0.0)
        near = [i for i, border in enumerate(borders) if abs(float(border.offset.at(middle))) < DOUBLE_LINE_M]
        line = borders[near[0]].line if near else None
        borders = [border for i, border in enumerate(borders) if i not in near] + [Border(flat, line)]
        borders.sort(key=lambda border: -float(border.offset.at(middle)))
        centre = next(i for i, border in enumerate(borders) if border.offset is flat)
    kinds = tuple(_kind(borders, i, middle, road.reference == "marking") for i in range(len(borders) - 1))
    return Section(first, last, tuple(borders), kinds, centre)


def _merge_double_lines(borders: list[Border], at: float) -> list[Border]:
    """Merge double lines: road edges take precedence over markings, then longer lines over shorter ones."""
    kept: list[Border] = []
    for border in sorted(borders, key=_priority, reverse=True):
        others = [k for k in kept if _priority(k)[0] == _priority(border)[0]]
        if all(abs(float(border.offset.at(at) - other.offset.at(at))) > DOUBLE_LINE_M for other in others):
            kept.append(border)
    return sorted(kept, key=lambda border: -float(border.offset.at(at)))


def _priority(border: Border) -> tuple[bool, float]:
    assert border.line is not None
    return border.line.kind != "marking", border.line.span[1] - border.line.span[0]


def _kind(borders: list[Border], i: int, at: float, has_centre_line: bool) -> Kind:
    """Kind of the strip to the right of a border."""
    width = float(borders[i].offset.at(at) - borders[i + 1].offset.at(at))
    ends = [borders[k].line for k in (i, i + 1)]
    edges = [line for line in ends if line and line.kind != "marking"]
    solid = [line for line in ends if line and line.marking == "solid"]
    if len(edges) == 1 and (width < MIN_LANE_WIDTH_M or (solid and width < MAX_SHOULDER_WIDTH_M)):
        return "shoulder"
    if width < MIN_LANE_WIDTH_M:
        return "restricted"
    return "driving" if has_centre_line else "bidirectional"
