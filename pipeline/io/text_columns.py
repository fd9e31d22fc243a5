"""Columns of text clouds: by their names in several languages, else by their number and values."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64

NAMES = {
    "x": ("x", "easting", "east", "e", "rechtswert", "rechts", "ostwert", "ost", "est", "este", "coord_x"),
    "y": ("y", "northing", "north", "n", "hochwert", "hoch", "nordwert", "nord", "norte", "coord_y"),
    "z": (
        "z", "h", "height", "elevation", "elev", "altitude", "alt", "höhe", "hoehe", "hauteur", "altitud", "altura",
        "quota", "coord_z",
    ),
    "r": ("r", "red", "rf", "rot", "rouge", "rojo", "rosso"),
    "g": ("g", "green", "gf", "grün", "gruen", "vert", "verde"),
    "b": ("b", "blue", "bf", "blau", "bleu", "azul", "blu"),
    "intensity": (
        "intensity", "i", "reflectance", "scalar_intensity", "intensität", "intensitaet", "intensité", "intensidad",
        "intensità",
    ),
    "class": ("class", "classification", "label", "scalar_classification", "klasse", "classe", "clase"),
    "time": ("time", "gps_time", "gpstime", "timestamp", "scalar_gpstime", "zeit"),
}  # fmt: skip
COLOURS, NORMAL = ("r", "g", "b"), ("nx", "ny", "nz")
ORDERS: dict[int, tuple[tuple[str, ...], ...]] = {
    0: ((),),
    1: (("intensity",),),
    2: (("intensity", "class"),),
    3: (COLOURS, NORMAL),
    4: ((*COLOURS, "intensity"), ("intensity", *COLOURS)),
    5: ((*COLOURS, "intensity", "class"), ("intensity", *COLOURS, "class")),
    6: ((*COLOURS, *NORMAL), (*NORMAL, *COLOURS)),
    7: ((*COLOURS, "intensity", *NORMAL), ("intensity", *COLOURS, *NORMAL), (*COLOURS, *NORMAL, "intensity")),
}
"""Orders of the columns after x y z by their number; the first one that fits the values is taken."""
MIN_NUMBERED_ROWS = 5
"""Rows from which consecutive integers in the first column are point numbers."""
CORRELATION_MARGIN = 0.1
"""Difference of correlations that decides whether an intensity comes before or after the colours."""


def is_heading(line: str) -> bool:
    """Whether a line names columns x, y and z."""
    return {"x", "y", "z"} <= {meaning(name) for name in re.split(r"[,;\s]+", line)}


def meaning(name: str) -> str:
    """Key in `NAMES` of a column's name, without regard to case, quotes and units in brackets; empty if unknown."""
    plain = re.sub(r"[\[(].*", "", name.strip().strip("\"'").lower()).strip().replace(" ", "_")
    return next((known for known, others in NAMES.items() if plain in others), "")


def by_values(path: Path, sample: F64) -> tuple[tuple[str, ...], str]:
    """Names of the columns of a table without a header line ("" if not read), and a note on them.

    Args:
        path: the file, for errors.
        sample: (N, M) its first rows.

    Raises:
        InputError: the values fit no known order.
    """
    numbered = sample.shape[1] > 3 and _is_numbering(sample[:, 0])
    width = sample.shape[1]
    rest = sample[:, 3 + numbered :]
    fitting = [order for order in ORDERS.get(rest.shape[1], ()) if _fits(order, rest)] if width >= 3 else []
    if not fitting:
        cause = f"has {width} columns and no header line" + (
            ", and their values fit no known order" if width > 3 else ""
        )
        raise InputError(path, cause, "Name the columns in its first line: x,y,z,r,g,b")
    order = fitting[0]
    if len(fitting) > 1 and rest.shape[1] in (4, 5) and _intensity_first(rest):
        order = fitting[1]
    columns = (*(("",) if numbered else ()), "x", "y", "z", *(name if name not in NORMAL else "" for name in order))
    read = " ".join((*(("(number)",) if numbered else ()), "x", "y", "z", *order))
    return columns, f"no header line: {width} columns interpreted as {read}"


def _is_numbering(column: F64) -> bool:
    return len(column) >= MIN_NUMBERED_ROWS and bool((np.diff(column) == 1).all() and column[0] == np.rint(column[0]))


def _fits(order: tuple[str, ...], values: F64) -> bool:
    """Whether columns have the values of an order: whole or fractional colours, unit normals, integer classes."""
    for at, name in enumerate(order):
        if name == "r" and not _are_colours(values[:, at : at + 3]):
            return False
        if name == "nx" and not _are_normals(values[:, at : at + 3]):
            return False
        if name == "class" and (values[:, at] != np.rint(values[:, at])).any():
            return False
    return True


def _are_colours(values: F64) -> bool:
    known = values[np.isfinite(values).all(axis=1)]
    if not len(known) or known.min() < 0:
        return not len(known)
    whole = bool((known == np.rint(known)).all())
    return bool(known.max() <= 1 or (whole and known.max() <= 65535))


def _are_normals(values: F64) -> bool:
    length = np.linalg.norm(values, axis=1)
    return bool((np.abs(length - 1) < 0.05).mean() > 0.9)


def _intensity_first(values: F64) -> bool:
    """Whether the last three of four columns are more like each other than the first three: colours are alike."""
    if len(values) < MIN_NUMBERED_ROWS or (values[:, :4].std(axis=0) == 0).any():
        return False
    like = np.asarray(np.corrcoef(values[:, :4].T))
    return bool(like[2, 3] > like[0, 1] + CORRELATION_MARGIN)
