"""Rays of a panorama, compiled: their directions, and their intersections with the ground."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.data_samples.ground import HALF_ROAD_M
from scan2sim.data_samples.hills import ground_height, ground_intersection

Array = npt.NDArray[Any]

SKY, OBJECT, ROAD, WALL, PAVEMENT = range(5)  # kinds of hits; WALL: the face of a kerb
TASK_PIXELS = 1021  # pixels per task
TASK_STRIDE = 1_000_003  # prime that shuffles the tasks, to balance the load: sky is faster than road


@njit(cache=True, error_model="numpy", parallel=True)
def rays(
    rotations: Array, origins: Array, width: int, height: int, index: Array, right: float, down: float, lens: float
) -> Array:
    """(N, 6) origins and unit directions of rays through pixels of an equirectangular image.

    Args:
        rotations, origins: (R, 3, 3) and (R, 3) camera pose of each row.
        width, height: size of the image.
        index: (N,) pixels, row by row.
        right, down: offset from the pixels' centres, in pixels.
        lens: distance of the front lens before the origin, and of the back lens behind it, metres.
    """
    out = np.empty((len(index), 6), np.float32)
    lon = ((np.arange(width) + 0.5 + right) / width - 0.5) * 2 * math.pi
    lat = ((np.arange(len(origins)) + 0.5 + down) / height - 0.5) * math.pi
    c, s, around, ahead = np.cos(lat), np.sin(lat), np.sin(lon), np.cos(lon)
    for i in prange(len(index)):
        row = index[i] // width
        column = index[i] - row * width
        x, y, z = c[row] * around[column], s[row], c[row] * ahead[column]
        m = rotations[row]
        for j in range(3):
            out[i, j] = origins[row, j] + math.copysign(lens, z) * m[j, 2]
            out[i, 3 + j] = m[j, 0] * x + m[j, 1] * y + m[j, 2] * z
    return out


@njit(cache=True, error_model="numpy", parallel=True)
def high_contrast(image: Array, limit: int) -> Array:
    """(H, W) bool: pixels of (H, W, 3) uint8 that differ from a neighbour by more than `limit` in some channel."""
    h, w = image.shape[0], image.shape[1]
    out = np.zeros((h, w), np.bool_)
    for r in prange(h):
        for c in range(w):
            for k in range(3):
                v = np.int64(image[r, c, k])  # in Numba, int() of an unsigned number stays unsigned
                most = max(abs(v - image[r, c - 1, k]), abs(v - image[r, (c + 1) % w, k]))
                most = max(most, abs(v - image[max(r - 1, 0), c, k]), abs(v - image[min(r + 1, h - 1), c, k]))
                if most > limit:
                    out[r, c] = True
    return out


@njit(cache=True, error_model="numpy")
def from_road(x: float, y: float, ground: Any) -> float:
    """Distance to the nearest centre line, bilinear; 999 off the raster."""
    distance, origin, cell = ground[0], ground[3], ground[4]
    gx, gy = (x - origin[0]) / cell, (y - origin[1]) / cell
    if not (0 <= gx < distance.shape[1] - 1 and 0 <= gy < distance.shape[0] - 1):
        return 999.0
    i, j = int(gx), int(gy)
    a, b = gx - i, gy - j
    low = distance[j, i] * (1 - a) + distance[j, i + 1] * a
    high = distance[j + 1, i] * (1 - a) + distance[j + 1, i + 1] * a
    return low * (1 - b) + high * b


@njit(cache=True, error_model="numpy", inline="always")
def task(turn: int, n: int) -> tuple[int, int]:
    """First pixel, and last pixel + 1, of a task; consecutive tasks are far apart, to balance the load of threads."""
    tasks = n // TASK_PIXELS + 1
    first = (turn * TASK_STRIDE) % tasks * TASK_PIXELS
    return first, min(first + TASK_PIXELS, n)


@njit(cache=True, error_model="numpy")
def interpolated(values: Array, part: Any, face: int, uv: Array) -> tuple[float, float, float]:
    """Barycentric interpolation of the first three columns of vertex values (of one column: three times)."""
    p, q, r = part[0][face, 0], part[0][face, 1], part[0][face, 2]
    b, c = uv[0], uv[1]
    a = 1 - b - c
    one, last = min(1, values.shape[1] - 1), values.shape[1] - 1
    return (
        a * values[p, 0] + b * values[q, 0] + c * values[r, 0],
        a * values[p, one] + b * values[q, one] + c * values[r, one],
        a * values[p, last] + b * values[q, last] + c * values[r, last],
    )


@njit(cache=True, error_model="numpy")
def _ground(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, t: float, ground: Any
) -> tuple[int, float, float, float, float]:
    """First hit of a ray on the ground before distance `t`: kind (SKY: none), distance, normal."""
    high, nears = ground_intersection(ox, oy, oz - ground[5], dx, dy, dz, t, ground[7])
    if high >= t:
        return SKY, t, 0.0, 0.0, 1.0
    low = high + ground[5] / nears
    _, to_x, to_y = ground_height(ox + high * dx, oy + high * dy, ground[7])
    up = 1 / math.sqrt(1 + to_x * to_x + to_y * to_y)
    d = from_road(ox + high * dx, oy + high * dy, ground)
    if d >= HALF_ROAD_M:
        return PAVEMENT, high, -to_x * up, -to_y * up, up
    e = from_road(ox + low * dx, oy + low * dy, ground)
    if e >= HALF_ROAD_M:
        at = high + (low - high) * (HALF_ROAD_M - d) / (e - d)
        if at < t:
            flat = math.sqrt(dx * dx + dy * dy) + 1e-9
            return WALL, at, -dx / flat, -dy / flat, 0.0
    elif low < t:
        return ROAD, low, -to_x * up, -to_y * up, up
    return SKY, t, 0.0, 0.0, 1.0


@njit(cache=True, error_model="numpy", parallel=True)
def hit_ground(
    ray: Array, distance: Array, face: Array, uv: Array, moved: Array, static: Any, other: Any, ground: Any, sun: Array
) -> tuple[Array, Array, Array]:
    """Intersect rays with the ground where they hit no object before it; updates `distance` (N,) in place.

    Returns:
        (N,) uint8 kind of hit, (N, 3) normal, and (N, 6) shadow ray from there to the sun; where no shadow test is
        needed, the shadow ray starts far above everything.
    """
    n = len(ray)
    kind, normal, shadow = np.empty(n, np.uint8), np.empty((n, 3), np.float32), np.empty((n, 6), np.float32)
    for turn in prange(n // TASK_PIXELS + 1):
        first, last = task(turn, n)
        for i in range(first, last):
            ox, oy, oz, dx, dy, dz = ray[i, 0], ray[i, 1], ray[i, 2], ray[i, 3], ray[i, 4], ray[i, 5]
            what, t, nx, ny, nz = _ground(ox, oy, oz, dx, dy, dz, distance[i], ground)
            if what == SKY and t < 1e9:
                what, part = OBJECT, other if moved[i] else static
                nx, ny, nz = interpolated(part[1], part, face[i], uv[i])
                length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-6)
                nx, ny, nz = nx / length, ny / length, nz / length
            distance[i], kind[i] = t, what
            normal[i, 0], normal[i, 1], normal[i, 2] = nx, ny, nz
            if what == SKY or nx * sun[0] + ny * sun[1] + nz * sun[2] <= 0:
                shadow[i, 0], shadow[i, 1], shadow[i, 2] = 0, 0, 5000
                shadow[i, 3], shadow[i, 4], shadow[i, 5] = 0, 0, 1
            else:
                shadow[i, 0] = ox + t * dx + 0.03 * nx + 0.02 * sun[0]
                shadow[i, 1] = oy + t * dy + 0.03 * ny + 0.02 * sun[1]
                shadow[i, 2] = oz + t * dz + 0.03 * nz + 0.02 * sun[2]
                shadow[i, 3], shadow[i, 4], shadow[i, 5] = sun[0], sun[1], sun[2]
    return kind, normal, shadow
