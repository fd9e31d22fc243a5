"""Texture of the layers: one page in which each cell is the mean of the photos that see it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.types import F32, U8
from scan2sim.texturing.backdrop import dome
from scan2sim.texturing.backdrop.layers import AGREEMENT, AGREEMENT_INVERSE, CELL_PX, Cells
from scan2sim.texturing.backdrop.photos import Photo, fill

BLOCK_CELLS, PADDING_PX = 4, 4
"""Cells along the side of a block of texture, and pixels of texture around it."""
PAGE_PX = 4096
SAMPLED_PER_ROW = 4096
"""Width of the image as which positions to sample are arranged."""
MAX_BLENDED = 12
"""Number of photos, the nearest ones, whose mean a cell shows."""


def page(photos: Sequence[Photo], kept: Sequence[F32], cells: Sequence[Cells], sky: U8) -> tuple[U8, list[F32]]:
    """One texture page for all cells, and the texture coordinates (N, 2, 2, 2) of each photo's cells.

    The page consists of strips: horizontally adjacent blocks of a photo that contain cells. It is as sharp as the
    photos unless that takes more than `PAGE_PX` squared.
    """
    import cv2

    runs = [_runs(one) for one in cells]
    for reduction in (1.0, 0.75, 0.5, 0.35, 0.25, 0.15, 0.1):
        sizes = [_strip_size(photos[one.photo], reduction) for one in cells]
        widths = [[size * n + 2 * PADDING_PX for _, _, n in run] for run, size in zip(runs, sizes, strict=True)]
        places, used = _place(widths, sizes)
        if used <= PAGE_PX:
            break
    canvas = np.zeros((max(used, 1), PAGE_PX, 3), np.uint8)
    shown = [_levels(photo, mask, sky) for photo, mask in zip(photos, kept, strict=True)]
    coordinates = []
    for one, run, size, place in zip(cells, runs, sizes, places, strict=True):
        photo = photos[one.photo]
        scale = size / (BLOCK_CELLS * CELL_PX)  # pixels of the page per pixel of the matched image
        shape = (round(photo.camera.width * scale), round(photo.camera.height * scale))
        levels = np.asarray(cv2.resize(shown[one.photo], shape, interpolation=cv2.INTER_AREA))
        levels = _blended(photos, kept, shown, one, levels)
        border = size + 2 * PADDING_PX
        levels = cv2.copyMakeBorder(levels, PADDING_PX, border, PADDING_PX, border, cv2.BORDER_REPLICATE)
        offset = np.zeros((len(one.rows), 2))
        for (row, column, length), (x, y) in zip(run, place, strict=True):
            cut = levels[row * size :, column * size :][:border, : length * size + 2 * PADDING_PX]
            canvas[y : y + cut.shape[0], x : x + cut.shape[1]] = cut
            block = one.columns // BLOCK_CELLS
            own = (one.rows // BLOCK_CELLS == row) & (block >= column) & (block < column + length)
            offset[own] = x + PADDING_PX - column * size, y + PADDING_PX - row * size
        side = CELL_PX * scale
        uv = np.empty((len(one.rows), 2, 2, 2), np.float32)
        for lower in (0, 1):
            for right in (0, 1):
                pixel = offset + np.column_stack([one.columns + right, one.rows + lower]) * side
                uv[:, lower, right] = pixel / (PAGE_PX, len(canvas)) * (1, -1) + (0, 1)
        coordinates.append(uv)
    return canvas, coordinates


def _levels(photo: Photo, scenery_mask: F32, sky: U8) -> U8:
    """Texture (h, w, 3) of a photo's backdrop: surfaces and vehicles nearby filled from around, sky as in the dome."""
    import cv2

    from scan2sim.pipeline.camera.models import pixel_rays

    height, width = photo.texture.shape[:2]
    hidden = cv2.dilate((photo.hit | (scenery_mask == 0)).astype(np.uint8), np.ones((3, 3)))
    hidden = cv2.resize(hidden, (width, height), interpolation=cv2.INTER_NEAREST)
    levels = np.where(hidden[..., None] > 0, fill(photo.texture.astype(np.float32), hidden == 0), photo.texture)
    camera = photo.view.camera.resized(width, height)
    rays = np.nan_to_num(pixel_rays(camera).astype(np.float64)) @ photo.view.T_world_cam[:3, :3].T
    share = cv2.blur(photo.texture_sky.astype(np.float32), (3, 3))[..., None]
    return np.clip(levels * (1 - share) + dome.sample(sky, rays) * share, 0, 255).astype(np.uint8)


def _strip_size(photo: Photo, reduction: float) -> int:
    """Side of a block in pixels of the page."""
    return max(1, round(BLOCK_CELLS * CELL_PX * photo.texture.shape[1] / photo.camera.width * reduction))


def _runs(cells: Cells) -> list[tuple[int, int, int]]:
    """Row, first column and length of the runs of adjacent blocks that contain cells."""
    blocks = np.unique(np.column_stack([cells.rows, cells.columns]) // BLOCK_CELLS, axis=0)
    runs: list[tuple[int, int, int]] = []
    for row, column in blocks.tolist():
        if runs and runs[-1][0] == row and runs[-1][1] + runs[-1][2] == column:
            runs[-1] = (row, runs[-1][1], runs[-1][2] + 1)
        else:
            runs.append((row, column, 1))
    return runs


def _place(widths: Sequence[Sequence[int]], sizes: Sequence[int]) -> tuple[list[list[tuple[int, int]]], int]:
    """Positions (x, y) of strips in rows of a page, widest first, and the height that they use."""
    order = sorted(((sizes[k], w, k, j) for k, row in enumerate(widths) for j, w in enumerate(row)), reverse=True)
    places: list[list[tuple[int, int]]] = [[(0, 0)] * len(row) for row in widths]
    shelves: list[list[int]] = []  # y, height, used width
    bottom = 0
    for size, width, k, j in order:
        height = size + 2 * PADDING_PX
        shelf = next((s for s in shelves if s[1] >= height and s[2] + width <= PAGE_PX), None)
        if shelf is None:
            shelf = [bottom, height, 0]
            shelves.append(shelf)
            bottom += height
        places[k][j] = (shelf[2], shelf[0])
        shelf[2] += width
    return places, bottom


def _blended(photos: Sequence[Photo], kept: Sequence[F32], shown: Sequence[U8], cells: Cells, levels: U8) -> U8:
    """Texture (h, w, 3) of a photo in which cells are the mean of the photos that see them.

    Args:
        photos, kept: all photos, and their scenery.
        shown: textures of all photos.
        cells: cells of the photo.
        levels: its texture.
    """
    from scan2sim.pipeline.camera.projection import pixels

    photo = photos[cells.photo]
    height, width = levels.shape[:2]
    index = np.full(np.array(photo.sky.shape) // CELL_PX + 1, -1)
    index[cells.rows, cells.columns] = np.arange(len(cells.rows))
    row = (np.arange(height) + 0.5) * photo.sky.shape[0] / height / CELL_PX
    column = (np.arange(width) + 0.5) * photo.sky.shape[1] / width / CELL_PX
    at = index[row.astype(int)[:, None], column.astype(int)]
    y, x = np.nonzero(at >= 0)
    corners, down, right = cells.corners[at[y, x]], (row % 1)[y, None], (column % 1)[x, None]
    upper = corners[:, 0, 0] * (1 - right) + corners[:, 0, 1] * right
    lower = corners[:, 1, 0] * (1 - right) + corners[:, 1, 1] * right
    points = upper * (1 - down) + lower * down
    total, weight = levels[y, x].astype(np.float64), np.ones((len(y), 1))
    distance = [np.linalg.norm(other.view.centre - photo.view.centre) for other in photos]
    nearest = [int(k) for k in np.argsort(distance, kind="stable") if k != cells.photo]
    for k in nearest[:MAX_BLENDED]:
        other, texture = photos[k], shown[k]
        uv, inside = pixels(other.camera, other.view.T_world_cam, points)
        uv = np.where(inside[:, None], uv, 0)  # NaN behind the camera
        c, r = np.clip(np.rint(uv).astype(int), 0, np.array(other.sky.shape[::-1]) - 1).T
        expected = 1 / np.maximum(np.linalg.norm(points - other.view.centre, axis=1), 0.1)
        found = other.inverse[r, c]
        seen = found - expected < np.maximum(AGREEMENT * expected, AGREEMENT_INVERSE)
        seen &= inside & (kept[k][r, c] > 0) & ~other.hit[r, c]
        scale = np.array(texture.shape[1::-1]) / other.sky.shape[::-1]
        maps = ((uv + 0.5) * scale - 0.5).astype(np.float32)
        sampled = _sample(texture, maps)
        total += np.where(seen[:, None], sampled, 0)
        weight += seen[:, None]
    out = levels.copy()
    out[y, x] = np.clip(np.round(total / weight), 0, 255)
    return out


def _sample(texture: U8, at: F32) -> F32:
    """Levels (N, 3) at pixels (N, 2), bilinear."""
    import cv2

    rows = -(-len(at) // SAMPLED_PER_ROW)
    padded = np.zeros((rows * SAMPLED_PER_ROW, 2), np.float32)
    padded[: len(at)] = at
    maps = padded.reshape(rows, SAMPLED_PER_ROW, 2)  # as an image, the sides of which OpenCV limits
    found = cv2.remap(texture, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    return np.asarray(found.reshape(-1, 3)[: len(at)], np.float32)
