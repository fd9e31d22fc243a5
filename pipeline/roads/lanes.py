"""Lanes of a road: strips between its lines, section after section."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scan2sim.pipeline.roads.model import Line, Road
from scan2sim.pipeline.roads.profile import Profile

Kind = Literal["driving", "bidirectional", "shoulder", "restricted"]
SHORTEST = 5.0
"""Metres of a section."""
NARROW = 2.0
"""Metres: what is narrower isn't driven on."""
WIDE = 4.5
"""Metres: what is beyond a solid line, up to the road's edge, is a shoulder (or a parking bay) if narrower."""
DOUBLE = 0.4
"""Metres between lines that are one, doubled."""


@dataclass(frozen=True)
class Border:
    """Where a lane ends: at a line, or (None) where nothing is painted."""

    offset: Profile
    line: Line | None


@dataclass(frozen=True)
class Section:
    """A stretch of road with the same lanes all along.

    Attributes:
        first, last: chainages.
        borders: from left to right.
        kinds: of the lanes between them.
        centre: index of the border at which the directions part; 0 where all lanes are to its right.
    """

    first: float
    last: float
    borders: tuple[Border, ...]
    kinds: tuple[Kind, ...]
    centre: int

    @property
    def middle(self) -> float:
        """Chainage."""
        return (self.first + self.last) / 2


def sections(road: Road) -> list[Section]:
    """The road's sections; empty where there are no two lines beside each other.

    A lane's direction is only told where a centre line is painted, and then by the side that was driven on. Elsewhere
    lanes are "bidirectional".
    """
    cuts = [0.0]
    for at in sorted(s for line in road.markings for s in line.span):
        if at - cuts[-1] > SHORTEST and road.line.length - at > SHORTEST:
            cuts.append(at)
    found = [_section(road, a, b) for a, b in zip(cuts, [*cuts[1:], road.line.length], strict=True)]
    return found if all(section.kinds for section in found) else []


def _section(road: Road, first: float, last: float) -> Section:
    middle = (first + last) / 2
    here = [line for line in road.markings if min(line.span[1], last) - max(line.span[0], first) > (last - first) / 2]
    borders = [Border(line.offset, line) for line in (road.left, *here, road.right) if line]
    borders.sort(key=lambda border: -float(border.offset.at(middle)))
    borders = _single(borders, middle)
    centre = 0
    if road.reference == "marking":
        flat = Profile.constant(road.height.knots, 0.0)
        near = [i for i, border in enumerate(borders) if abs(float(border.offset.at(middle))) < DOUBLE]
        line = borders[near[0]].line if near else None
        borders = [border for i, border in enumerate(borders) if i not in near] + [Border(flat, line)]
        borders.sort(key=lambda border: -float(border.offset.at(middle)))
        centre = next(i for i, border in enumerate(borders) if border.offset is flat)
    kinds = tuple(_kind(borders, i, middle, road.reference == "marking") for i in range(len(borders) - 1))
    return Section(first, last, tuple(borders), kinds, centre)


def _single(borders: list[Border], at: float) -> list[Border]:
    """Borders with doubled lines as one: an edge of the road before others, then what is longer."""
    kept: list[Border] = []
    for border in sorted(borders, key=_importance, reverse=True):
        others = [k for k in kept if _importance(k)[0] == _importance(border)[0]]
        if all(abs(float(border.offset.at(at) - other.offset.at(at))) > DOUBLE for other in others):
            kept.append(border)
    return sorted(kept, key=lambda border: -float(border.offset.at(at)))


def _importance(border: Border) -> tuple[bool, float]:
    assert border.line is not None
    return border.line.kind != "marking", border.line.span[1] - border.line.span[0]


def _kind(borders: list[Border], i: int, at: float, parted: bool) -> Kind:
    """What the strip to the right of a border is."""
    width = float(borders[i].offset.at(at) - borders[i + 1].offset.at(at))
    ends = [borders[k].line for k in (i, i + 1)]
    edges = [line for line in ends if line and line.kind != "marking"]
    solid = [line for line in ends if line and line.marking == "solid"]
    if len(edges) == 1 and (width < NARROW or (solid and width < WIDE)):
        return "shoulder"
    if width < NARROW:
        return "restricted"
    return "driving" if parted else "bidirectional"
