"""Sky in photos, where it shows beside or through a surface: there nothing may be painted from them.

A mesh's outline is right to a voxel or so, and crowns have holes: photos show sky where the depth map has a surface.
What sky looks like is told by the smooth, bright or blue parts of the photo in which the depth map has nothing; what
looks like that, near to where there is nothing, is sky, and so are the pixels beside it, which mix it with the surface.
No network is needed: clouds that come with classes have none.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, U8, Bools

SMOOTH = 4.0
"""Grey levels, standard deviation within 5 x 5 pixels: sky varies by no more ..."""
INSIDE = 4
"""... so many pixels from all surfaces."""
BLUE = 6
"""Grey levels by which its blue may be less than its red or green: grey clouds, and white where overexposed."""
BRIGHT = 90
"""Grey level of its brightest channel at least."""
AROUND = 40
"""Pixels around which its colour is a mean."""
ALIKE = 24.0
"""Grey levels between a pixel's colour and the sky's around: more is no sky, or less than half."""
LEAST = 200
"""Pixels of sky from which on there is any."""
MOSTLY = 0.7
"""Share of a patch of the sky's colour that lies so near to the outline: else it is a surface like the sky."""
MIXED = 3
"""Pixels across of what one pixel of sky mixes with."""


def sky(rgb: U8, depth: F32, up: F32, pixel: float, loose: float) -> Bools | None:
    """(H, W) where a photo shows sky or a mixture with it; None: nowhere.

    Args:
        rgb: (H, W, 3) the photo.
        depth: (h, w) its depth map, metres, infinite where there is nothing.
        up: (k, l) of any size, above 0 where the photo looks above the horizon.
        pixel: radians that a pixel of the photo spans.
        loose: metres by which a surface's outline may be off.
    """
    import cv2

    size = (rgb.shape[1], rgb.shape[0])
    far = cv2.resize((~np.isfinite(depth)).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    colour, seeds = _colour(rgb, far & (cv2.resize(up, size) > 0))
    if colour is None or int(seeds.sum()) < LEAST:
        return None
    most = float(np.nextafter(np.float32(ALIKE), np.float32(0)))
    like = np.asarray(cv2.inRange(cv2.absdiff(rgb.astype(np.float32), colour), (0,) * 3, (most,) * 3), np.uint8) & 1
    open_ = _touching(like & far, seeds)
    near = cv2.resize(np.where(np.isfinite(depth), depth, 0), size, interpolation=cv2.INTER_NEAREST)
    aside = cv2.distanceTransform(1 - open_, cv2.DIST_L2, 3) * near * pixel  # metres from its outline, seen from here
    shown = like & (1 - far)
    count, part = cv2.connectedComponents(shown, connectivity=4, ltype=cv2.CV_32S)
    whole = np.bincount(part.ravel(), minlength=count)
    beside = np.bincount(part[aside < loose], minlength=count)
    bleeds = beside > MOSTLY * whole
    bleeds[0] = False
    return np.asarray(cv2.dilate(open_ | bleeds[part].astype(np.uint8), np.ones((MIXED, MIXED))) > 0)


def _touching(mask: U8, seeds: U8) -> U8:
    """The connected pieces of a mask that hold a seed."""
    import cv2

    count, part = cv2.connectedComponents(mask, connectivity=4, ltype=cv2.CV_32S)
    held = np.zeros(count, np.uint8)
    held[part[seeds > 0]] = 1
    held[0] = 0
    return held[part]


def _colour(rgb: U8, far: U8) -> tuple[F32 | None, U8]:
    """The sky's colour around every pixel (H, W, 3) float32, None where it shows none; and where it is told from."""
    import cv2

    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.blur(grey, (5, 5))
    rough = cv2.blur(grey * grey, (5, 5)) - mean * mean
    inner = cv2.erode(far, np.ones((2 * INSIDE + 1, 2 * INSIDE + 1)), borderValue=1)
    r, g, b = cv2.split(rgb)
    seeds = ((inner > 0) & (rough < SMOOTH**2) & (cv2.add(b, BLUE) >= cv2.max(r, g)) & (b > BRIGHT)).astype(np.uint8)
    seeds = cv2.morphologyEx(seeds, cv2.MORPH_OPEN, np.ones((7, 7)))
    small = (max(1, rgb.shape[1] // 8), max(1, rgb.shape[0] // 8))
    weight = cv2.resize(seeds.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    if float(weight.sum()) * 64 < LEAST:
        return None, seeds
    held = cv2.resize(cv2.copyTo(rgb, seeds).astype(np.float32), small, interpolation=cv2.INTER_AREA)
    sigma = AROUND / 8
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    colour = cv2.GaussianBlur(held, (0, 0), sigma) / np.maximum(total, 1e-3)[..., None]
    colour[total < 1e-3] = -1000  # none is near
    return np.asarray(cv2.resize(colour, (rgb.shape[1], rgb.shape[0])), np.float32), seeds
