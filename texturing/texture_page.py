"""Texture pages while they are painted, and the marks of their texels."""

from __future__ import annotations

from dataclasses import dataclass

from scan2sim.pipeline.core.types import F32, I32, U8

SEEN, FROM_POINTS, FILLED = 255, 128, 64
"""Marks of texels: seen by a photo, coloured from points, or filled otherwise."""


@dataclass(frozen=True)
class Page:
    """A texture page while it is painted.

    Attributes:
        rgb: (H, W, 3) colours.
        seen: (H, W) marks (`SEEN`, `FROM_POINTS`, `FILLED`), 0 where there is no colour yet.
        owner: (H, W) face of each texel, index into the other two; -1 where there is none.
        flat, corners: (F, 3, 2) texels and (F, 3, 3) local metres of the faces' corners.
    """

    rgb: U8
    seen: U8
    owner: I32
    flat: F32
    corners: F32
