"""Provenance of each face's colour: a photo (which one, when, from what distance), the cloud's points, or inpainted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, I32, View
from scan2sim.pipeline.io.gps_time import from_gps
from scan2sim.pipeline.io.worlds.scene import Surface

FILLED, POINTS, PHOTO = 0, 1, 2
SOURCES = ("filled", "points", "photo")
SOURCE_OF_MASK_LEVEL = {64: FILLED, 128: POINTS, 255: PHOTO}
"""Source for each level of the masks that the step `texture` writes."""
FIRST_VIEW_ROW = 3
"""Row of the first view in the table; the rows before it are: filled, points, and an unknown photo."""
UNKNOWN_DISTANCE = -1.0
"""Distance (m) of faces without a photo."""


@dataclass(frozen=True)
class Row:
    """A row of the provenance table, to which faces refer.

    Attributes:
        source: one of `SOURCES`.
        photo: name of the photo, or "".
        taken: capture time, ISO 8601 in UTC, or "" if the photo's time gives no date.
    """

    source: str
    photo: str = ""
    taken: str = ""


def table(views: Sequence[View]) -> list[Row]:
    """The provenance table of a tile with the given photos."""
    return [*map(Row, SOURCES), *(Row("photo", view.name, _taken(view)) for view in views)]


def rows(surface: Surface) -> I32 | None:
    """Row (F,) of each face in the table; None if the texture has no provenance masks."""
    seen = surface.seen()
    if seen is None:
        return None
    lookup = np.zeros(256, np.int32)
    lookup[list(SOURCE_OF_MASK_LEVEL)] = list(SOURCE_OF_MASK_LEVEL.values())
    row = lookup[seen]
    photo = surface.shape.photo
    if photo is None:
        return row
    photo_known = (photo >= 0) & ((seen == 255) | (seen == 0))  # 0: too small for a texel
    return np.where(photo_known, photo + FIRST_VIEW_ROW, row).astype(np.int32)


def distance(xyz: F32, row: I32, views: Sequence[View]) -> F32:
    """Distance (N,) in metres from points (N, 3) to the cameras of their rows (N,).

    `UNKNOWN_DISTANCE` without a known photo, and for orthophotos.
    """
    out = np.full(len(xyz), UNKNOWN_DISTANCE, np.float32)
    if not views:
        return out
    centre = np.array([view.centre for view in views])
    index = np.where(row >= FIRST_VIEW_ROW, row - FIRST_VIEW_ROW, 0)
    known = (row >= FIRST_VIEW_ROW) & np.array([view.camera.model != "orthographic" for view in views])[index]
    out[known] = np.linalg.norm(xyz[known] - centre[index[known]], axis=1)
    return out


def _taken(view: View) -> str:
    time = None if view.time is None else from_gps(view.time)
    return "" if time is None else time.isoformat(timespec="seconds")
