"""The classes of points and what becomes of each: one table.

Codes are those of ASPRS LAS 1.4 (2 ground, 3-5 vegetation, 6 building, 11 road, ...) and, from 64
on, user-definable ones: another survey's 65 is no pole (`meanings`). A group is a surface that is
meshed by itself (D3.2, section 4.2: terrain, building, vegetation); classes without a group are left
out of the surface, though they still hide what is behind them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import U8, Bools

Group = Literal["terrain", "building", "vegetation", "vehicle"]
GROUPS: tuple[Group, ...] = ("terrain", "building", "vegetation")
SURFACES: tuple[Group, ...] = (*GROUPS, "vehicle")
"""All that a world may have: the groups, and what is parked where `split.vehicles` keeps it."""


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
CODE_OF_SURFACE: dict[str, int] = {
    "terrain": CODE["terrain"], "building": CODE["building"], "vegetation": CODE["high_vegetation"],
    "vehicle": CODE["vehicle"],
}  # fmt: skip
"""The label of a surface's faces that have no class of their own."""
OTHER_NAMES = {"ground": 2, "vegetation": 5, "noise": 7, "bridge": 17, "sign": 64, "car": 66, "wall": 68, "fence": 68}
SHOWN = (
    "road", "sidewalk", "terrain", "building", "road_sign", "pole", "low_vegetation", "high_vegetation", "vehicle",
    "person", "wall_or_fence", "sky",
)  # fmt: skip
"""The classes that networks predict for a photo's pixels, in the order of the step `label`'s probabilities."""
NOISE = (7, 18)
UNCLASSIFIED = CODE["unclassified"]
UNKNOWN = (0, UNCLASSIFIED, 12)  # never classified, unclassified, legacy overlap
OF_THE_SURVEY = 64
"""From this code on each survey has classes of its own (LAS 1.4 R15, table 17)."""


def code_of(text: str) -> int | None:
    """The code of a class by its name, however that is written ("Road sign"), or by itself ("64"); None: no such."""
    plain = _plain(text)
    names = {_plain(name): code for name, code in (OTHER_NAMES | CODE).items()}
    return names.get(plain, int(plain) if plain in map(str, CODE.values()) else None)


def name_of(code: int) -> str:
    """What a code is called; "code_31" where it has no name."""
    return next((c.name for c in CLASSES if c.code == code), f"code_{code}")


def parse(text: str) -> dict[int, int]:
    """Codes of a survey and what they are here, of "65=noise,200=5".

    Raises:
        SettingError: a code or class that there isn't.
    """
    given: dict[str, str] = {}
    for entry in filter(None, map(str.strip, text.split(","))):
        code, _, name = entry.partition("=")
        if not name or code.strip() in given:
            cause = f"{entry[:40]!r} " + ("names no class" if not name else "names a class for this code again")
            raise SettingError("classes", cause, "Write 65=noise,200=5: each code once")
        given[code.strip()] = name
    return mapping(given)


def mapping(given: Mapping[str, str | int]) -> dict[int, int]:
    """Codes of a survey (0 to 255) and what they are here, of texts: `{"65": "noise"}`.

    Raises:
        SettingError: a code or class that there isn't.
    """
    found = {}
    for code, name in given.items():
        meant = code_of(name if isinstance(name, str) else str(min(max(name, -1), 256)))
        if not (code.strip().isdecimal() and len(code.strip()) < 4 and int(code) < 256):
            raise SettingError(
                "classes", f"{code[:40]!r} is no code", "Write 65=noise: a code of the file from 0 to 255"
            )
        if meant is None:
            raise SettingError(
                "classes",
                f"there is no class {str(name)[:40]!r} (for {code})",
                f"There are: {', '.join(CODE)}, or codes",
            )
        found[int(code)] = meant
    return found


def meanings(ours: bool, names: Mapping[int, str], given: Mapping[int, int]) -> U8:
    """Lookup table (256,): a file's code to ours.

    Codes below 64 are the standard's. Others are unclassified, but where the file names them as we do, or says that
    it is of this project; and what the user says holds before all that.

    Args:
        ours: the file says that scan2sim wrote it.
        names: what the file calls its codes.
        given: the user's word, code to code.
    """
    table = np.arange(256, dtype=np.uint8)
    known = set(CODE.values())
    for code in range(256):
        named = code_of(names.get(code, ""))
        if code in given:
            table[code] = given[code]
        elif code in known and (code < OF_THE_SURVEY or (ours and not names.get(code))):
            continue
        elif named is not None:
            table[code] = named
        elif code >= OF_THE_SURVEY:
            table[code] = UNCLASSIFIED
    return table


def known() -> Bools:
    """Lookup table (256,): whether a LAS code says what a point is."""
    table = np.zeros(256, bool)
    table[list(CODE.values())] = True
    table[list(UNKNOWN)] = False
    return table


def strangers(count: npt.NDArray[np.integer], table: U8) -> str:
    """What to say of a file's codes, of which there are so many (256,), that `meanings` made nothing of; mostly empty.

    Codes of the survey's own are meant: what has none is told of where surfaces are made (`split`).
    """
    lost = [c for c in np.flatnonzero(count).tolist() if c >= OF_THE_SURVEY and table[c] == UNCLASSIFIED]
    if not lost:
        return ""
    codes = ", ".join(f"{c} ({count[c] / count.sum():.1%})" for c in lost[:8])
    one = lost[0]
    return (
        f"codes {codes} are the survey's own (LAS leaves {OF_THE_SURVEY} and up to it), and taken as unclassified. "
        f'Say what they are: import with --classes {one}=building, or write [classes] {one} = "building" in tile.toml'
    )


def _plain(text: str) -> str:
    return "".join(c for c in text.lower() if c.isalnum())


def group_of() -> npt.NDArray[np.int8]:
    """Lookup table (256,): LAS code to index into `GROUPS`, -1 for what is left out."""
    table = np.full(256, -1, np.int8)
    for c in CLASSES:
        if c.group is not None:
            table[c.code] = GROUPS.index(c.group)
    return table


def colour_of() -> U8:
    """Lookup table (256, 3): LAS code to a display colour."""
    table = np.full((256, 3), 128, np.uint8)
    for c in CLASSES:
        table[c.code] = c.rgb
    return table
