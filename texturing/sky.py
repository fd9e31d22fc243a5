"""Sky detection in photos beside and through surfaces, where texture must not be painted from them.

The outline of a mesh is accurate to about a voxel, and tree crowns have holes: photos show sky where the depth map has
a surface. The colour of the sky is estimated from smooth, bright and bluish parts of the photo where the depth map is
empty. Pixels of that colour near empty regions of the depth map are sky, and so are the pixels beside them, which mix
sky and surface. This needs no network, as tiles whose clouds come with classes have no network output.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, U8, Bools

SEED_STD_LEVELS = 4.0
"""Largest standard deviation of sky within 5 x 5 pixels, grey levels."""
SEED_SURFACE_DISTANCE_PX = 4
"""Pixels between a seed and the nearest surface."""
SEED_BLUE_DEFICIT_LEVELS = 6
"""Grey levels by which the blue of sky may be below its red or green: grey clouds, and overexposed white."""
SEED_BLUE_MIN_LEVEL = 90
"""Smallest blue level of sky."""
COLOUR_SMOOTHING_PX = 40
"""Sigma in pixels over which the colour of the sky is averaged."""
COLOUR_TOLERANCE_LEVELS = 24.0
"""Largest difference between a pixel and the sky around it, grey levels: beyond, less than half of it is sky."""
SEEDS_MIN_PIXELS = 200
"""Pixels of seeds below which a photo has no sky."""
OUTLINE_SHARE_MIN = 0.7
"""Share of a sky-coloured component that must be near the outline: otherwise it is a surface of the sky's colour."""
MIXED_PIXELS_KERNEL_PX = 3
"""Kernel in pixels of the dilation that adds pixels which mix sky and surface."""


def sky(rgb: U8, depth: F32, up: F32, pixel: float, outline_tolerance: float) -> Bools | None:
    """(H, W) where a photo shows sky or pixels mixed with sky; None: nowhere.

    Args:
        rgb: (H, W, 3) the photo.
        depth: (h, w) its depth map in metres, infinite where there is no surface.
        up: (k, l) of any size, above 0 where the photo looks above the horizon.
        pixel: radians that a pixel of the photo spans.
        outline_tolerance: metres by which a surface's outline may be wrong.
    """
    import cv2

    size = (rgb.shape[1], rgb.shape[0])
    empty = cv2.resize((~np.isfinite(depth)).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    colour, seeds = _sky_colour(rgb, empty & (cv2.resize(up, size) > 0))
    if colour is None or int(seeds.sum()) < SEEDS_MIN_PIXELS:
        return None
    tolerance = float(np.nextafter(np.float32(COLOUR_TOLERANCE_LEVELS), np.float32(0)))
    difference = cv2.absdiff(rgb.astype(np.float32), colour)
    like_sky = np.asarray(cv2.inRange(difference, (0,) * 3, (tolerance,) * 3), np.uint8) & 1
    open_sky = _seeded_components(like_sky & empty, seeds)
    surface_range = cv2.resize(np.where(np.isfinite(depth), depth, 0), size, interpolation=cv2.INTER_NEAREST)
    outline_distance = cv2.distanceTransform(1 - open_sky, cv2.DIST_L2, 3) * surface_range * pixel  # metres
    on_surface = like_sky & (1 - empty)
    count, part = cv2.connectedComponents(on_surface, connectivity=4, ltype=cv2.CV_32S)
    total = np.bincount(part.ravel(), minlength=count)
    near_outline = np.bincount(part[outline_distance < outline_tolerance], minlength=count)
    is_sky = near_outline > OUTLINE_SHARE_MIN * total
    is_sky[0] = False
    kernel = np.ones((MIXED_PIXELS_KERNEL_PX, MIXED_PIXELS_KERNEL_PX))
    return np.asarray(cv2.dilate(open_sky | is_sky[part].astype(np.uint8), kernel) > 0)


def _seeded_components(mask: U8, seeds: U8) -> U8:
    """Connected components of a mask that contain a seed."""
    import cv2

    count, part = cv2.connectedComponents(mask, connectivity=4, ltype=cv2.CV_32S)
    has_seed = np.zeros(count, np.uint8)
    has_seed[part[seeds > 0]] = 1
    has_seed[0] = 0
    return has_seed[part]


def sky_seeds(rgb: U8, empty: U8) -> U8:
    """(H, W) 1 where a photo (H, W, 3) shows smooth, bright, bluish sky; `empty` (H, W) is 1 without a surface."""
    import cv2

    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.blur(grey, (5, 5))
    variance = cv2.blur(grey * grey, (5, 5)) - mean * mean
    kernel = np.ones((2 * SEED_SURFACE_DISTANCE_PX + 1, 2 * SEED_SURFACE_DISTANCE_PX + 1))
    inner = cv2.erode(empty, kernel, borderValue=1)
    r, g, b = cv2.split(rgb)
    is_bluish = (cv2.add(b, SEED_BLUE_DEFICIT_LEVELS) >= cv2.max(r, g)) & (b > SEED_BLUE_MIN_LEVEL)
    seeds = ((inner > 0) & (variance < SEED_STD_LEVELS**2) & is_bluish).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(seeds, cv2.MORPH_OPEN, np.ones((7, 7))), np.uint8)


def _sky_colour(rgb: U8, empty: U8) -> tuple[F32 | None, U8]:
    """Sky colour around every pixel (H, W, 3) float32, None if the photo shows no sky; and its seeds (H, W)."""
    import cv2

    seeds = sky_seeds(rgb, empty)
    small = (max(1, rgb.shape[1] // 8), max(1, rgb.shape[0] // 8))
    weight = cv2.resize(seeds.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    if float(weight.sum()) * 64 < SEEDS_MIN_PIXELS:
        return None, seeds
    seed_colour = cv2.resize(cv2.copyTo(rgb, seeds).astype(np.float32), small, interpolation=cv2.INTER_AREA)
    sigma = COLOUR_SMOOTHING_PX / 8
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    colour = cv2.GaussianBlur(seed_colour, (0, 0), sigma) / np.maximum(total, 1e-3)[..., None]
    colour[total < 1e-3] = -1000  # no seed is near
    return np.asarray(cv2.resize(colour, (rgb.shape[1], rgb.shape[0])), np.float32), seeds
