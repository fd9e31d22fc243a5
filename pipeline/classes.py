"""The classes of points and what becomes of each: one table.

Codes are those of ASPRS LAS 1.4 (2 ground, 3-5 vegetation, 6 building, 11 road, ...) and, from 64
on, user-definable ones. A group is a surface that is meshed by itself (D3.2, section 4.2: terrain,
building, vegetation); classes without a group are left out of the surface, though they still hide
what is behind them.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Group = Literal["terrain", "building", "vegetation"]
GROUPS: tuple[Group, ...] = ("terrain", "building", "vegetation")


class PointClass(NamedTuple):
    """A class of points: LAS code, name (15 characters at most, as LAS asks), group, colour."""

    code: int
    name: str
    group: Group | None
    rgb: tuple[int, int, int]


CLASSES: tuple[PointClass, ...] = (
    PointClass(0, "never", None, (90, 90, 90)),
    PointClass(1, "unclassified", None, (120, 120, 120)),
    PointClass(2, "terrain", "terrain", (152, 118, 84)),
    PointClass(3, "low_vegetation", "vegetation", (154, 205, 80)),
    PointClass(4, "mid_vegetation", "vegetation", (110, 176, 64)),
    PointClass(5, "high_vegetation", "vegetation", (60, 130, 50)),
    PointClass(6, "building", "building", (196, 140, 110)),
    PointClass(7, "low_noise", None, (255, 0, 255)),
    PointClass(8, "keypoint", "terrain", (152, 118, 84)),
    PointClass(9, "water", "terrain", (70, 110, 180)),
    PointClass(10, "rail", "terrain", (120, 100, 110)),
    PointClass(11, "road", "terrain", (110, 110, 118)),
    PointClass(13, "wire_guard", None, (230, 220, 120)),
    PointClass(14, "wire", None, (230, 220, 120)),
    PointClass(15, "tower", "building", (170, 170, 190)),
    PointClass(16, "wire_connector", None, (230, 220, 120)),
    PointClass(17, "bridge_deck", "terrain", (150, 150, 150)),
    PointClass(18, "high_noise", None, (255, 0, 255)),
    PointClass(64, "road_sign", "building", (220, 50, 50)),
    PointClass(65, "pole", "building", (170, 170, 170)),
    PointClass(66, "vehicle", None, (40, 80, 220)),
    PointClass(67, "person", None, (230, 120, 30)),
    PointClass(68, "wall_or_fence", "building", (170, 130, 160)),
    PointClass(69, "sidewalk", "terrain", (200, 180, 190)),
)
CODE: dict[str, int] = {c.name: c.code for c in CLASSES}
NOISE = (7, 18)
UNKNOWN = (0, 1, 12)  # never classified, unclassified, legacy overlap


def group_of() -> npt.NDArray[np.int8]:
    """Lookup table (256,): LAS code to index into `GROUPS`, -1 for what is left out."""
    table = np.full(256, -1, np.int8)
    for c in CLASSES:
        if c.group is not None:
            table[c.code] = GROUPS.index(c.group)
    return table


def colour_of() -> npt.NDArray[np.uint8]:
    """Lookup table (256, 3): LAS code to a display colour."""
    table = np.full((256, 3), 128, np.uint8)
    for c in CLASSES:
        table[c.code] = c.rgb
    return table
