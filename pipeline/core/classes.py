"""Point classes: LAS codes, names, display colours, and the surface group that each is meshed in.

Codes are those of ASPRS LAS 1.4 (2 ground, 3-5 vegetation, 6 building, 11 road, ...) and, from 64
on, user-definable ones, which differ between surveys (`code_table` maps them to ours). A group is a surface that is
meshed separately (D3.2, section 4.2: terrain, building, vegetation); points of classes without a group are not
meshed, but still occlude what is behind them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import I64, U8, Bools

Group = Literal["terrain", "building", "vegetation", "vehicle", "ceiling", "furniture"]
GROUPS: tuple[Group, ...] = ("terrain", "building", "vegetation")
CEILING: Group = "ceiling"
"""Surface that hides rooms from above: views from there omit it (`flows/reports/pages/walk.js` by this name, too)."""
INDOOR_GROUPS: tuple[Group, ...] = (CEILING, "furniture")
"""Further surfaces of an indoor map; in other clouds their classes have no surface."""
SURFACES: tuple[Group, ...] = (*GROUPS, "vehicle", *INDOOR_GROUPS)
"""All surfaces of a world: the groups, parked vehicles if `split.vehicles` keeps them, and those of indoor maps."""


class PointClass(NamedTuple):
    """A point class: LAS code, name (at most 15 characters, a limit of LAS), group, display colour."""

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
    PointClass(70, "floor", "terrain", (176, 152, 124)),
    PointClass(71, "wall", "building", (214, 206, 192)),
    PointClass(72, "ceiling", None, (236, 236, 232)),
    PointClass(73, "stairs", "terrain", (150, 140, 150)),
    PointClass(74, "furniture", None, (120, 148, 176)),
)
CODE: dict[str, int] = {c.name: c.code for c in CLASSES}
CODE_OF_SURFACE: dict[str, int] = {
    "terrain": CODE["terrain"], "building": CODE["building"], "vegetation": CODE["high_vegetation"],
    "vehicle": CODE["vehicle"], "ceiling": CODE["ceiling"], "furniture": CODE["furniture"],
}  # fmt: skip
"""Class of a surface's faces that have none of their own."""
CODE_OF_ROOMS: dict[str, int] = {"terrain": CODE["floor"], "building": CODE["wall"]}
"""The same in maps of rooms, where it differs."""
SYNONYMS = {"ground": 2, "vegetation": 5, "noise": 7, "bridge": 17, "sign": 64, "car": 66, "fence": 68}
PHOTO_CLASSES = (
    "road", "sidewalk", "terrain", "building", "road_sign", "pole", "low_vegetation", "high_vegetation", "vehicle",
    "person", "wall_or_fence", "sky",
)  # fmt: skip
"""Classes that networks predict for pixels of a photo, in the channel order of the probabilities of step `label`."""
NOISE = (7, 18)
UNCLASSIFIED = CODE["unclassified"]
UNKNOWN = (0, UNCLASSIFIED, 12)  # never classified, unclassified, legacy overlap
FIRST_USER_CODE = 64
"""First user-definable code: from here on, each survey defines its own classes (LAS 1.4 R15, table 17)."""


def code_of(text: str) -> int | None:
    """Code of a class given by name ("Road sign"; case and spaces don't matter) or by code ("64"); None if unknown."""
    plain = plain_name(text)
    return _codes_by_name().get(plain, int(plain) if plain in map(str, CODE.values()) else None)


@cache
def _codes_by_name() -> dict[str, int]:
    return {plain_name(name): code for name, code in (SYNONYMS | CODE).items()}


def name_of(code: int) -> str:
    """Name of a code; "code_31" if it has none."""
    return next((c.name for c in CLASSES if c.code == code), f"code_{code}")


def parse_mapping(text: str) -> dict[int, int]:
    """Parse a mapping of a survey's codes to ours, "65=noise,200=5".

    Raises:
        SettingError: a code is out of range or given twice, or a class is unknown.
    """
    given: dict[str, str] = {}
    for entry in filter(None, map(str.strip, text.split(","))):
        code, _, name = entry.partition("=")
        if not name or code.strip() in given:
            cause = f"{entry[:40]!r} " + ("names no class" if not name else "names a class for this code again")
            raise SettingError("classes", cause, "Write CODE=CLASS pairs, each code once: 65=noise,200=5")
        given[code.strip()] = name
    return mapping(given)


def mapping(given: Mapping[str, str | int]) -> dict[int, int]:
    """Mapping of a survey's codes (0 to 255) to ours, from text: `{"65": "noise"}`.

    Raises:
        SettingError: a code is out of range, or a class is unknown.
    """
    found = {}
    for code, name in given.items():
        target = code_of(name if isinstance(name, str) else str(min(max(name, -1), 256)))
        if not (code.strip().isdecimal() and len(code.strip()) < 4 and int(code) < 256):
            raise SettingError(
                "classes", f"{code[:40]!r} is no code", "Write CODE=CLASS with a code from 0 to 255: 65=noise"
            )
        if target is None:
            raise SettingError(
                "classes",
                f"there is no class {str(name)[:40]!r} (for {code})",
                f"Use one of these names, or its code: {', '.join(CODE)}",
            )
        found[int(code)] = target
    return found


def code_table(ours: bool, names: Mapping[int, str], given: Mapping[int, int]) -> U8:
    """Lookup table (256,) from a file's codes to ours.

    Codes below 64 are standard LAS. User-definable codes become unclassified, unless the file gives them a name that we
    know, or scan2sim wrote the file. The user's mapping takes precedence over all of these.

    Args:
        ours: whether scan2sim wrote the file.
        names: class names in the file, by code.
        given: the user's mapping, code to code.
    """
    table = np.arange(256, dtype=np.uint8)
    known = set(CODE.values())
    for code in range(256):
        named = code_of(names.get(code, ""))
        if code in given:
            table[code] = given[code]
        elif code in known and (code < FIRST_USER_CODE or (ours and not names.get(code))):
            continue
        elif named is not None:
            table[code] = named
        elif code >= FIRST_USER_CODE:
            table[code] = UNCLASSIFIED
    return table


def classified_codes() -> Bools:
    """Lookup table (256,): whether a LAS code is a known class other than unclassified."""
    table = np.zeros(256, bool)
    table[list(CODE.values())] = True
    table[list(UNKNOWN)] = False
    return table


def unmapped_codes_warning(count: npt.NDArray[np.integer], table: U8) -> str:
    """Warning about user-definable codes in a file that `code_table` left unclassified; empty if there are none.

    Args:
        count: (256,) number of points of each code.
        table: from `code_table`.
    """
    unmapped = [c for c in np.flatnonzero(count).tolist() if c >= FIRST_USER_CODE and table[c] == UNCLASSIFIED]
    if not unmapped:
        return ""
    codes = ", ".join(f"{c} ({count[c] / count.sum():.1%})" for c in unmapped[:8])
    one = unmapped[0]
    return (
        f"codes {codes} are the survey's own (LAS: {FIRST_USER_CODE} and up), read as unclassified. "
        f'Map them to classes: import with --classes {one}=building, or set [classes] {one} = "building" in tile.toml'
    )


def plain_name(text: str) -> str:
    """Letters and digits of a name, in lower case: names are compared by them."""
    return "".join(c for c in text.lower() if c.isalnum())


def group_of() -> npt.NDArray[np.int8]:
    """Lookup table (256,): LAS code to index into `GROUPS`, -1 for classes without a group."""
    table = np.full(256, -1, np.int8)
    for c in CLASSES:
        if c.group is not None:
            table[c.code] = GROUPS.index(c.group)
    return table


def surface_of(names: Sequence[Group]) -> I64:
    """Lookup table (256,) from a class code to the index of its surface in `names`, -1 without one."""
    table = np.full(256, -1, np.int64)
    groups = group_of()
    for i, name in enumerate(names):
        if name in GROUPS:
            table[groups == GROUPS.index(name)] = i
        else:
            table[CODE[name]] = i
    return table


def colour_of() -> U8:
    """Lookup table (256, 3): LAS code to a display colour."""
    table = np.full((256, 3), 128, np.uint8)
    for c in CLASSES:
        table[c.code] = c.rgb
    return table
