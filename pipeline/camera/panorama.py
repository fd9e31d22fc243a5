"""What an image that is twice as wide as high shows: the whole sphere, two fisheye circles, or a perspective view.

The left and right edges of an equirectangular image are neighbours on the sphere. Unstitched recordings of 360 cameras
have the size of stitched ones; their two circles leave the corners of both halves black.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, U8, Bools

HEIGHT = 256
"""Height down to which larger images are scaled, pixels: averages out noise and compression."""
EDGE_FACTOR, EDGE_LEVELS = 1.75, 4.0
"""Edges meet if they differ by at most this factor times the 95th percentile of neighbouring columns, plus levels."""
BLACK_LEVEL, CIRCLE_LEVEL = 12.0, 30.0
"""Largest mean of the corners beside fisheye circles, and least of the circles, grey levels."""
OUTSIDE, INSIDE = 1.08, 0.9
"""Radii, relative to half the height, outside which a corner lies, and inside which the circle is filled."""


STITCH = "Export a 360 (equirectangular) video by the camera's program: Insta360 Studio, GoPro Player, Ricoh's app, ..."
"""Advice for unstitched recordings."""


def check(path: Path, grey: U8) -> None:
    """Check that an image (H, 2 H), read from `path`, shows the whole sphere.

    Raises:
        InputError: it shows two fisheye circles, or its left and right edges don't meet.
    """
    if fisheye_pair(grey):
        raise InputError(
            path, "shows two fisheye circles side by side, as 360 cameras record them",
            f"{STITCH} If these are no circles, set the camera: --camera equirectangular",
        )  # fmt: skip
    if not whole_sphere(grey):
        raise InputError(
            path, "is twice as wide as high like a 360 image, but its left and right edges don't meet",
            "Set the camera: --camera pinhole, with --focal if it is known, or --camera equirectangular",
        )  # fmt: skip


def whole_sphere(grey: U8) -> bool:
    """Whether the left and right edges of an image (H, 2 H) meet; also of one that shows almost nothing."""
    small = _small(grey)
    small = small[len(small) // 4 : -len(small) // 4]  # near the poles, columns are alike
    between = np.abs(np.diff(small, axis=1)).mean(axis=0)
    edges = np.abs(small[:, 0] - small[:, -1]).mean()
    return bool(edges <= EDGE_FACTOR * np.percentile(between, 95) + EDGE_LEVELS)


def fisheye_pair(grey: U8) -> bool:
    """Whether an image (H, 2 H) shows two fisheye circles side by side."""
    small = _small(grey)
    radius = _radius(len(small))
    halves = np.split(small, 2, axis=1)
    corners = [half[mask].mean() for half in halves for mask in _corners(radius)]
    circles = [half[radius < INSIDE].mean() for half in halves]
    return bool(max(corners) < BLACK_LEVEL and min(circles) > CIRCLE_LEVEL)


def _small(grey: U8) -> F32:
    import cv2

    height = min(HEIGHT, len(grey))
    return cv2.resize(grey, (2 * height, height), interpolation=cv2.INTER_AREA).astype(np.float32)


def _radius(height: int) -> F64:
    """(H, H) distance from the middle of a half, relative to half its height."""
    x = (np.arange(height) + 0.5) / (height / 2) - 1
    return np.hypot(x, x[:, None])


def _corners(radius: F64) -> list[Bools]:
    """The four corners (H, H) outside the circle."""
    middle = len(radius) // 2
    found = []
    for rows in (slice(0, middle), slice(middle, None)):
        for columns in (slice(0, middle), slice(middle, None)):
            corner = np.zeros(radius.shape, bool)
            corner[rows, columns] = radius[rows, columns] > OUTSIDE
            found.append(corner)
    return found
