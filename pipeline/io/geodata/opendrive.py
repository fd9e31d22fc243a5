"""OpenDRIVE 1.7 (ASAM) writer: reference lines as clothoids, lane widths as cubics, road marks with their dashes.

Coordinates are local metres; the header georeferences them with a PROJ string and the frame's origin as offset.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import from_os_error
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io.geodata.crs import LOCAL, proj_string
from scan2sim.pipeline.roads.lanes import Border, Section, sections
from scan2sim.pipeline.roads.model import Road
from scan2sim.pipeline.roads.profile import Profile

GEOMETRY_TOLERANCE_M = 1e-4
"""Deviation up to which a clothoid is written as an arc, and an arc as a line."""
SHAPE_RIGHT_EXTENT_M = 50.0
"""Distance to the right of the reference line at which the lateral shape starts."""
MIN_MARK_LENGTH_M = 0.5
"""Shorter marks, and shorter gaps between marks, are not written."""


def write(path: Path, name: str, frame: Frame, roads: Sequence[Road]) -> int:
    """Write the roads that have lanes; returns their number. Without any, no file is written.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    roads_with_lanes = [(road, parts) for road in roads if (parts := sections(road))]
    if not roads_with_lanes:
        return 0
    root = ET.Element("OpenDRIVE")
    root.append(_header(name, frame, [road for road, _ in roads_with_lanes]))
    for number, (road, parts) in enumerate(roads_with_lanes, start=1):
        root.append(_road(number, road, parts))
    try:
        ET.indent(root)
        ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    except OSError as error:
        raise from_os_error(error, path) from None
    return len(roads_with_lanes)


def _text(**values: object) -> dict[str, str]:
    """XML attributes; floats with 12 significant digits."""
    return {k: f"{v:.12g}" if isinstance(v, float) else str(v) for k, v in values.items()}


def _header(name: str, frame: Frame, roads: Sequence[Road]) -> ET.Element:
    points = np.concatenate([road.line.points(np.linspace(0, road.line.length, 100)) for road in roads])
    (west, south), (east, north) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    box = {"north": north, "south": south, "east": east, "west": west}
    header = ET.Element("header", _text(revMajor=1, revMinor=7, name=name, version=1.0, **box, vendor="scan2sim"))
    if frame.crs != LOCAL:
        ET.SubElement(header, "geoReference").text = proj_string(frame.crs)
    x, y, z = (float(value) for value in frame.origin)
    ET.SubElement(header, "offset", _text(x=x, y=y, z=z, hdg=0.0))
    return header


def _road(number: int, road: Road, parts: Sequence[Section]) -> ET.Element:
    rule = "RHT" if road.keeps_right else "LHT"
    length = road.line.length
    element = ET.Element("road", _text(name=f"road_{number}", length=length, id=number, junction=-1, rule=rule))
    ET.SubElement(element, "link")
    plan = ET.SubElement(element, "planView")
    _plan(plan, road)
    elevation = ET.SubElement(element, "elevationProfile")
    for s, cubic in road.height.pieces(0.0, length):
        ET.SubElement(elevation, "elevation", _cubic(cubic, s=s))
    _surface(ET.SubElement(element, "lateralProfile"), road)
    lanes = ET.SubElement(element, "lanes")
    for section in parts:
        for s, cubic in section.borders[section.centre].offset.pieces(section.first, section.last):
            ET.SubElement(lanes, "laneOffset", _cubic(cubic, s=s))
    for section in parts:
        lanes.append(_section(section))
    return element


def _cubic(cubic: np.ndarray, **at: float) -> dict[str, str]:
    return _text(**at, **dict(zip("abcd", map(float, cubic), strict=True)))


def _plan(plan: ET.Element, road: Road) -> None:
    """Add the reference line: one geometry between each two knots."""
    line = road.line
    points, headings = line.points(line.knots), line.headings(line.knots)
    for i, length in enumerate(np.diff(line.knots).tolist()):
        begin, end = line.curvature[i : i + 2].tolist()
        x, y = points[i].tolist()
        at = _text(s=float(line.knots[i]), x=x, y=y, hdg=float(headings[i]), length=length)
        geometry = ET.SubElement(plan, "geometry", at)
        if abs(end - begin) * length**2 > GEOMETRY_TOLERANCE_M:
            ET.SubElement(geometry, "spiral", _text(curvStart=begin, curvEnd=end))
        elif abs(begin + end) / 2 * length**2 > GEOMETRY_TOLERANCE_M:
            ET.SubElement(geometry, "arc", _text(curvature=(begin + end) / 2))
        else:
            ET.SubElement(geometry, "line")


def _surface(lateral: ET.Element, road: Road) -> None:
    """Add the cross slopes on both sides as shapes: straight lines that meet at the reference line."""
    left, right = road.cross_slopes
    for s in left.knots.tolist():
        to_left, to_right = float(left.at(s)), float(right.at(s))
        ET.SubElement(
            lateral,
            "shape",
            _text(s=s, t=-SHAPE_RIGHT_EXTENT_M, a=SHAPE_RIGHT_EXTENT_M * to_right, b=-to_right, c=0.0, d=0.0),
        )
        ET.SubElement(lateral, "shape", _text(s=s, t=0.0, a=0.0, b=to_left, c=0.0, d=0.0))


def _section(section: Section) -> ET.Element:
    element = ET.Element("laneSection", _text(s=section.first))
    borders, centre = section.borders, section.centre
    left = ET.Element("left")
    for i in range(centre):  # from the outermost to the middle
        left.append(_lane(section, centre - i, section.kinds[i], borders[i + 1].offset, borders[i]))
    middle = ET.Element("center")
    lane = ET.SubElement(middle, "lane", _text(id=0, type="none", level="false"))
    _marks(lane, section, borders[centre])
    right = ET.Element("right")
    for i in range(centre, len(borders) - 1):
        right.append(_lane(section, centre - i - 1, section.kinds[i], borders[i].offset, borders[i + 1]))
    for side in (left, middle, right):
        if len(side):
            element.append(side)
    return element


def _lane(section: Section, number: int, kind: str, inner: Profile, outer: Border) -> ET.Element:
    lane = ET.Element("lane", _text(id=number, type=kind, level="false"))
    width = outer.offset - inner if number > 0 else inner - outer.offset
    for s, cubic in width.pieces(section.first, section.last):
        ET.SubElement(lane, "width", _cubic(cubic, sOffset=s - section.first))
    _marks(lane, section, outer)
    return lane


def _marks(lane: ET.Element, section: Section, border: Border) -> None:
    """Add the road marks along a border: paint or kerb, and "none" where nothing was detected."""
    line = border.line
    marked = [] if line is None else [(max(a, section.first), min(b, section.last)) for a, b in line.ranges]
    marked = [(a, b) for a, b in marked if b - a > MIN_MARK_LENGTH_M]
    at = section.first
    for first, last in marked:
        if first - at > MIN_MARK_LENGTH_M:
            ET.SubElement(lane, "roadMark", _text(sOffset=at - section.first, type="none", color="standard"))
        else:
            first = at
        assert line is not None
        begin = _text(sOffset=first - section.first)
        if line.kind != "marking":
            kerb = {} if line.kerb is None else _text(height=line.kerb)
            ET.SubElement(
                lane, "roadMark", begin | {"type": "none" if line.kerb is None else "curb", "color": "standard"} | kerb
            )
        else:
            assert line.marking is not None and line.width is not None
            paint = _text(type=line.marking, weight="standard", color="white", width=line.width)
            mark = ET.SubElement(lane, "roadMark", begin | paint)
            if line.dash is not None and line.gap is not None and line.first is not None:
                kind = ET.SubElement(mark, "type", _text(name="broken", width=line.width))
                offset = (line.first - first) % (line.dash + line.gap)
                dashes = _text(length=line.dash, space=line.gap, tOffset=0.0, sOffset=offset, rule="none")
                ET.SubElement(kind, "line", dashes | _text(width=line.width))
        at = last
    if section.last - at > MIN_MARK_LENGTH_M:
        ET.SubElement(lane, "roadMark", _text(sOffset=at - section.first, type="none", color="standard"))
