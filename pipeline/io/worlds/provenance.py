"""Where each face of a tile has its colour from: a photo (which, when, from how far), the cloud's points, or filled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, I32, View
from scan2sim.pipeline.io.gps_time import from_gps
from scan2sim.pipeline.io.worlds.scene import Surface

FILLED, POINTS, PHOTO = 0, 1, 2
SOURCES = ("filled", "points", "photo")
LEVELS = {64: FILLED, 128: POINTS, 255: PHOTO}
"""Of the step `texture`'s masks."""
FIRST = 3
"""Row of the first view; those before it stand for what is filled, for points, and for a photo that isn't known."""
UNKNOWN = -1.0
"""Metres, of what no photo shows."""


@dataclass(frozen=True)
class Row:
    """Of the table that faces refer to.

    Attributes:
        source: one of `SOURCES`.
        photo: its name, or "".
        taken: when, ISO 8601 in UTC; "" where the photo's time doesn't tell its date.
    """

    source: str
    photo: str = ""
    taken: str = ""


def table(views: Sequence[View]) -> list[Row]:
    """What faces of a tile refer to, given its photos."""
    return [*map(Row, SOURCES), *(Row("photo", view.name, _taken(view)) for view in views)]


def rows(surface: Surface) -> I32 | None:
    """(F,) row in the table of each face; None: its texture doesn't tell."""
    seen = surface.seen()
    if seen is None:
        return None
    lookup = np.zeros(256, np.int32)
    lookup[list(LEVELS)] = list(LEVELS.values())
    row = lookup[seen]
    photo = surface.shape.photo
    if photo is None:
        return row
    named = (photo >= 0) & ((seen == 255) | (seen == 0))  # 0: too small for a texel
    return np.where(named, photo + FIRST, row).astype(np.int32)


def distance(xyz: F32, row: I32, views: Sequence[View]) -> F32:
    """(N,) metres from places (N, 3) to the photos of their rows (N,); `UNKNOWN` where none is known, or from above."""
    out = np.full(len(xyz), UNKNOWN, np.float32)
    if not views:
        return out
    centre = np.array([view.centre for view in views])
    of = np.where(row >= FIRST, row - FIRST, 0)
    near = (row >= FIRST) & np.array([view.camera.model != "orthographic" for view in views])[of]
    out[near] = np.linalg.norm(xyz[near] - centre[of[near]], axis=1)
    return out


def _taken(view: View) -> str:
    time = None if view.time is None else from_gps(view.time)
    return "" if time is None else time.isoformat(timespec="seconds")
