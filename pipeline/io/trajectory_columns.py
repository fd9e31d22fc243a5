"""Columns of trajectory tables by the names, or without any the layouts, of the programs that write them.

Read are the names of TUM, evo (pandas), EuRoC, ROS 1 (`rostopic echo -p`) and ROS 2, and tables without a header line
of TUM, EuRoC, MulRan, KITTI and ROS 2 (`ros2 topic echo --csv`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import text_columns

TIME, SECONDS, NANOSECONDS = "time", "sec", "nanosec"
"""Names of times: one column in any unit, or two."""
POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
MATRIX = tuple(f"m{row}{column}" for row in range(3) for column in range(4))
"""Names of the elements of a 3x4 pose."""
DEVIATIONS = ("sx", "sy", "sz", "srx", "sry", "srz")
OWN = frozenset(("unsure", *DEVIATIONS))
"""Further columns that this program writes."""
TIMES = ("time", "timestamp", "stamp", "t", "header.stamp", "timestamps", "time_s", "timestamp_s", "timestamp_ns", "")
"""Names of a time; empty: pandas' index."""
OTHER = re.compile(r"vel|twist|acc|bias|cov|linear|angular|omega|gyro|^v_|^b_|^w_|sigma|std")
"""Quantities with axes that aren't of the pose."""
UNNAMED: dict[int, tuple[str, ...]] = {
    4: (TIME, *POSITION),
    8: (TIME, *POSITION, *QUATERNION),
    12: MATRIX,
    13: (TIME, *MATRIX),
    17: (TIME, *POSITION, "qw", "qx", "qy", "qz", *[""] * 9),
}
"""Layouts of tables without a header line by their number of columns: TUM, KITTI, MulRan, EuRoC's ground truth."""
ROS_POSE = (SECONDS, NANOSECONDS, "", *POSITION, *QUATERNION)
ROS_ODOMETRY = (SECONDS, NANOSECONDS, "", "", *POSITION, *QUATERNION)
"""Beginnings of the lines of ROS 2: seconds, nanoseconds, the frame's name (and the child's)."""
SECONDS_PER_UNIT = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Times since the epoch from which on they are in nano-, micro- or milliseconds, and their unit."""


def named(cells: Sequence[str]) -> tuple[str, ...]:
    """Our names of the columns of a header line; empty: not read. ROS 1 adds its own time to that of the message."""
    names = [_name(cell) for cell in cells]
    stamp = next((k for k, cell in enumerate(cells) if cell.strip().endswith("header.stamp")), None)
    if stamp is not None:
        names = ["" if name == TIME and k != stamp else name for k, name in enumerate(names)]
    if not {*POSITION} & {*names}:
        meanings = [text_columns.meaning(cell.strip(" #%")) for cell in cells]
        names = [
            meaning if not name and meaning in (TIME, *POSITION) else name
            for name, meaning in zip(names, meanings, strict=True)
        ]
    return tuple(names)


def unnamed(cells: Sequence[str]) -> tuple[str, ...] | None:
    """Our names of the columns of a table without a header line, by the cells of its first line; None: unknown."""
    numeric = [is_number(cell) for cell in cells]
    if all(numeric):
        return UNNAMED.get(len(cells))
    for layout in (ROS_POSE, ROS_ODOMETRY):
        texts = [not name for name in layout]
        if len(cells) >= len(layout) and all(numeric[k] != text for k, text in enumerate(texts)):
            return layout + ("",) * (len(cells) - len(layout))
    return None


def seconds(times: F64) -> F64:
    """Times in seconds: those since the epoch that are too large are in milli-, micro- or nanoseconds."""
    largest = float(np.abs(times).max(initial=0.0))
    return times * next((unit for bound, unit in SECONDS_PER_UNIT if largest > bound), 1.0)


def is_number(text: str) -> bool:
    """Whether a cell is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _name(cell: str) -> str:
    text = re.sub(r"[\[(].*?[\])]", "", cell).strip(" #%\t\"'").lower()  # units in brackets
    text = text.removeprefix("field.").removeprefix("/")
    if text in OWN or text in (*QUATERNION, *POSITION):
        return text
    if text in TIMES:
        return TIME
    if re.fullmatch(r"(.*stamp\.)?(sec|secs)", text):
        return SECONDS
    if re.fullmatch(r"(.*stamp\.)?(nanosec|nsec|nsecs)", text):
        return NANOSECONDS
    quantity, _, axis = re.sub(r"[._ ]?([xyzw])$", r"|\1", text).partition("|")
    if not axis or OTHER.search(text):
        return ""
    if re.search(r"orient|quat|rot", quantity) or re.fullmatch(r"q(_.*)?", quantity):
        return f"q{axis}"
    if axis != "w" and (re.search(r"pos|transl|^loc", quantity) or re.fullmatch(r"[pt](_.*)?", quantity)):
        return axis
    return ""
