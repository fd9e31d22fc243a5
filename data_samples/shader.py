"""Shader of panoramas, compiled: colours of the surfaces, the ground and the sky that rays hit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange

from scan2sim.data_samples.ground import HALF_ROAD_M, PAVEMENT_WIDTH_M
from scan2sim.data_samples.hills import ground_height
from scan2sim.data_samples.materials import _asphalt, _colour, noise
from scan2sim.data_samples.paints import Material
from scan2sim.data_samples.rays import OBJECT, ROAD, SKY, TASK_PIXELS, WALL, Array, from_road, interpolated, task

KERBSTONE, SLABS, GRASS, FOLIAGE = (int(Material[m]) for m in ("KERB", "SLABS", "GRASS", "FOLIAGE"))
KERBSTONE_WIDTH_M, ZEBRA_SPACING_M = 0.15, 85.0  # width of a kerbstone; distance between zebra crossings
SLANT_EXPONENT = 0.6  # growth of the pixel footprint on slanted surfaces: 0 is sharp, 1 avoids all aliasing
SUN_RGB, SKY_RGB = (1.06, 1.0, 0.88), (0.90, 1.0, 1.16)  # colours of sunlight and skylight
HAZE_DISTANCE_M = 900.0  # in which haze covers all but 1/e of a colour
HORIZON_RGB = (0.52, 0.60, 0.66)  # colour of haze, linear light


@njit(cache=True, error_model="numpy")
def _road_coordinates(x: float, y: float, ground: Any) -> tuple[float, float, float]:
    """Chainage, offset to the left, and 1 if markings are painted, of a point on the raster."""
    nearest, line, origin, cell, points = ground[1], ground[2], ground[3], ground[4], ground[6]
    j, i = int((y - origin[1]) / cell + 0.5), int((x - origin[0]) / cell + 0.5)
    k = nearest[min(j, nearest.shape[0] - 1), min(i, nearest.shape[1] - 1)]
    ahead = (x - points[k, 0]) * line[k, 2] + (y - points[k, 1]) * line[k, 3]
    for _ in range(6):  # find the pair of points between whose normals this one lies, for continuity in bends
        n = k + (1 if ahead >= 0 else -1)
        if n < 0 or n >= len(line) or abs(line[n, 4] - line[k, 4]) > 1.0:
            break
        next_ahead = (x - points[n, 0]) * line[n, 2] + (y - points[n, 1]) * line[n, 3]
        if (ahead >= 0) != (next_ahead >= 0):
            f = ahead / (ahead - next_ahead)
            c, s = line[k, 2] * (1 - f) + line[n, 2] * f, line[k, 3] * (1 - f) + line[n, 3] * f
            px, py = points[k, 0] * (1 - f) + points[n, 0] * f, points[k, 1] * (1 - f) + points[n, 1] * f
            return line[k, 4] * (1 - f) + line[n, 4] * f, (y - py) * c - (x - px) * s, line[k, 5]
        k, ahead = n, next_ahead
    return line[k, 4] + ahead, (y - points[k, 1]) * line[k, 2] - (x - points[k, 0]) * line[k, 3], line[k, 5]


@njit(cache=True, error_model="numpy")
def _ground_colour(
    what: int, x: float, y: float, z: float, w: float, k: int, ground: Any, at: Array, sign_images: Array
) -> tuple[float, float, float]:
    """Albedo of road, kerb, pavement or garden at local (x, y).

    Args:
        what: kind of ground, as in `rays`.
        x, y, z: local position.
        w: footprint of the pixel, metres.
        k: seed.
        ground: arrays of the ground, as `panorama` passes them.
        at: (2,) world coordinates of the local origin.
        sign_images: images of `signs`.
    """
    far, u, v = from_road(x, y, ground), x + at[0], y + at[1]
    if far > HALF_ROAD_M + PAVEMENT_WIDTH_M:
        r, g, b = _colour(GRASS, u, v, 0.11, 0.16, 0.05, k, 1.0, 1.0, w, ground[3], sign_images)
        bare = min(max(3 * noise(u, v, 17.0, w, k + 31) - 0.6, 0.0), 1.0)  # share of paved yard instead of lawn
        yard = 0.24 * (1 + 0.2 * noise(u, v, 0.07, w, k) + 0.2 * noise(u, v, 0.4, w, k))
        return r + (yard - r) * bare, g + (0.95 * yard - g) * bare, b + (0.85 * yard - b) * bare
    s, t, painted = _road_coordinates(x, y, ground)
    if what == ROAD:
        zebra = (math.floor(s / ZEBRA_SPACING_M) + 0.5) * ZEBRA_SPACING_M if painted > 0 else -1e9
        road: Any = (HALF_ROAD_M, zebra, 0.0)
        f, white = _asphalt(s, t, w, k, road)
        white *= painted
        f *= 1 + 0.16 * noise(u, v, 0.27, w, k + 40) + 0.10 * noise(u, v, 1.3, w, k + 41)
        f *= 0.15 * (1 - 0.5 * min(max(5 * noise(u, v, 0.9, w, k + 42) - 3.2, 0.0), 1.0))  # oil stains
        return f + (0.6 - f) * white, f + (0.6 - f) * white, 1.02 * f + (0.57 - f) * white
    if what == WALL or far < HALF_ROAD_M + KERBSTONE_WIDTH_M:
        z -= ground_height(x, y, ground[7])[0]
        return _colour(KERBSTONE, s, t + z, 0.38, 0.37, 0.35, k, 1.0, 1.0, w, ground[3], sign_images)
    return _colour(SLABS, s, t, 0.33, 0.32, 0.30, k, 1.0, 1.0, w, ground[3], sign_images)


@njit(cache=True, error_model="numpy")
def _vehicle_shade(boxes: Array, x: float, y: float) -> float:
    """Factor by which vehicles (K, 6) darken a point of the ground near them (contact shadow)."""
    light = 1.0
    for k in range(len(boxes)):
        ex, ey = x - boxes[k, 0], y - boxes[k, 1]
        if abs(ex) < 9 and abs(ey) < 9:
            along = abs(ex * boxes[k, 2] + ey * boxes[k, 3]) - boxes[k, 4]
            aside = abs(ey * boxes[k, 2] - ex * boxes[k, 3]) - boxes[k, 5]
            light *= 1 - min(max(0.7 - 1.6 * max(along, aside), 0.0), 0.85)
    return light


@njit(cache=True, error_model="numpy")
def _foliage_brightness(x: float, y: float, z: float, w: float) -> float:
    """Brightness of foliage: noise of the scales of clumps, twigs and leaves, fixed in the world."""
    v = 1.0
    for k, (size, strength) in enumerate(((0.75, 0.22), (0.27, 0.30), (0.11, 0.36), (0.05, 0.34))):
        if w < size:
            v += strength * (
                noise(x + 0.3 * z, y, size, w, 51 + k)
                + noise(y, z + 0.3 * x, size, w, 61 + k)
                + noise(z, x + 0.3 * y, size, w, 71 + k)
            )
    return max(v, 0.15)


@njit(cache=True, error_model="numpy")
def _object_colour(
    part: Any, face: int, uv: Array, x: float, y: float, z: float, w: float, stands: bool, sign_images: Array
) -> tuple[float, float, float]:
    """Albedo of an object's surface; `stands`: it is part of the town, and weathered."""
    u, v, _ = interpolated(part[2], part, face, uv)
    m, c, size = part[4][face], part[5][face], part[7][face]
    r, g, b = _colour(m, u, v, c[0], c[1], c[2], part[6][face], size[0], size[1], w, size, sign_images)
    f = 1.0
    if m == FOLIAGE:
        f = _foliage_brightness(x, y, z, w)
    elif stands:
        u, v = x + y, z + 0.3 * (x - y)
        f = 1.0 + 0.07 * noise(u, v, 0.21, w, 55) + 0.08 * noise(u, v, 0.8, w, 56)
    return r * f, g * f, b * f


@njit(cache=True, error_model="numpy")
def _sky_light(dx: float, dy: float, dz: float, sky: Array) -> tuple[float, float, float]:
    """Linear light of the sky in a direction, interpolated bilinearly from the sky image."""
    rows, columns = sky.shape[0], sky.shape[1]
    v = min(max((1 - math.asin(min(max(dz, 0.0), 1.0)) * 2 / math.pi) * rows - 0.5, 0.0), rows - 1.001)
    u = (math.atan2(dy, dx) / (2 * math.pi) + 0.5) * columns - 0.5
    j, k = int(v), int(math.floor(u))
    b, a = v - j, u - k
    p, q, s, t = sky[j, k % columns], sky[j, (k + 1) % columns], sky[j + 1, k % columns], sky[j + 1, (k + 1) % columns]
    c, d, e, f = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    return (
        c * p[0] + d * q[0] + e * s[0] + f * t[0],
        c * p[1] + d * q[1] + e * s[1] + f * t[1],
        c * p[2] + d * q[2] + e * s[2] + f * t[2],
    )


@njit(cache=True, error_model="numpy", parallel=True)
def shade(
    ray: Array, distance: Array, face: Array, uv: Array, moved: Array, kind: Array, normal: Array, dark: Array,
    static: Any, other: Any, ground: Any, boxes: Array, sun: Array, sky: Array, centre: Array, sign_images: Array,
    angle: float, gain: float, table: Array, seed: int,
) -> Array:  # fmt: skip
    """(N, 3) uint8 sRGB colours of the surfaces that rays hit.

    Args:
        ray: (N, 6) origins and unit directions.
        distance, face, uv: (N,), (N,), (N, 2) hits: metres, face, barycentric coordinates.
        moved: (N,) whether a vehicle was hit.
        kind, normal: (N,), (N, 3) as returned by `rays.hit_ground`.
        dark: (N,) whether the point is in shadow.
        static, other: arrays of the town's and of the vehicles' meshes.
        ground: arrays of the ground.
        boxes: (K, 6) other vehicles, for their contact shadows.
        sun: (3,) unit vector towards the sun.
        sky: sky image, linear light.
        centre: (2,) world coordinates of the local origin; makes textures independent of it.
        sign_images: images of `signs`.
        angle: angle of a pixel, radians.
        gain: exposure, factor on the light.
        table: sRGB values by the square root of linear light.
        seed: seed of the textures.
    """
    n, top = len(ray), len(table) - 1
    out = np.empty((n, 3), np.uint8)
    for turn in prange(n // TASK_PIXELS + 1):
        first, last = task(turn, n)
        for i in range(first, last):
            dx, dy, dz, far = float(ray[i, 3]), float(ray[i, 4]), float(ray[i, 5]), float(distance[i])
            if kind[i] == SKY:
                r, g, b = _sky_light(dx, dy, dz, sky)
            else:
                x, y, z = ray[i, 0] + far * dx, ray[i, 1] + far * dy, ray[i, 2] + far * dz
                nx, ny, nz = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
                slant = max(abs(dx * nx + dy * ny + dz * nz), 0.06)
                w = max(far * angle / slant**SLANT_EXPONENT, 0.008)
                facing = nx * sun[0] + ny * sun[1] + nz * sun[2]
                if kind[i] == OBJECT:
                    part = other if moved[i] else static
                    r, g, b = _object_colour(
                        part, face[i], uv[i], x + centre[0], y + centre[1], z, w, not moved[i], sign_images
                    )
                    open_, _, _ = interpolated(part[3], part, face[i], uv[i])
                    if part[4][face[i]] == FOLIAGE:
                        facing = 0.3 + 0.7 * facing
                else:
                    r, g, b = _ground_colour(kind[i], x, y, z, w, seed, ground, centre, sign_images)
                    open_ = 0.9
                    f = _vehicle_shade(boxes, x, y)
                    r, g, b = r * f, g * f, b * f
                direct = (0.0 if dark[i] else 0.85 * max(facing, 0.0)) + 0.14 * open_ * (0.5 - 0.5 * nz)
                ambient = 0.48 * open_ * (0.7 + 0.3 * nz)
                mist = 1 - math.exp(-far / HAZE_DISTANCE_M)
                r = r * (direct * SUN_RGB[0] + ambient * SKY_RGB[0]) * (1 - mist) + HORIZON_RGB[0] * mist
                g = g * (direct * SUN_RGB[1] + ambient * SKY_RGB[1]) * (1 - mist) + HORIZON_RGB[1] * mist
                b = b * (direct * SUN_RGB[2] + ambient * SKY_RGB[2]) * (1 - mist) + HORIZON_RGB[2] * mist
            out[i, 0] = table[int(math.sqrt(min(max(r * gain, 0.0), 1.0)) * top)]
            out[i, 1] = table[int(math.sqrt(min(max(g * gain, 0.0), 1.0)) * top)]
            out[i, 2] = table[int(math.sqrt(min(max(b * gain, 0.0), 1.0)) * top)]
    return out
