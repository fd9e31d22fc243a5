"""Procedural materials: colour of a surface point, compiled.

No detail is finer than 2 cm, and edges are box-filtered over `footprint`, the width of a sample in metres, so that
textures of 1 cm contain all details, and distant photos don't alias.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.data_samples.paints import Material

PLAIN, ASPHALT, SETTS, KERB, SLABS = (
    int(m) for m in (Material.PLAIN, Material.ASPHALT, Material.SETTS, Material.KERB, Material.SLABS)
)
GRASS, BRICK, PLASTER, STONE, WINDOW = (
    int(m) for m in (Material.GRASS, Material.BRICK, Material.PLASTER, Material.STONE, Material.WINDOW)
)
DOOR, SHOP, ROOF_TILES, BARK, FOLIAGE = (
    int(m) for m in (Material.DOOR, Material.SHOP, Material.ROOF_TILES, Material.BARK, Material.FOLIAGE)
)
WOOD, CAR_BODY, CAR_GLASS, CAR_END, WHEEL, SIGN = (
    int(m)
    for m in (Material.WOOD, Material.CAR_BODY, Material.CAR_GLASS, Material.CAR_END, Material.WHEEL, Material.SIGN)
)
GRIT, PANELS = int(Material.GRIT), int(Material.PANELS)


@njit(cache=True, inline="always")
def _hash(i: int, j: int, k: int) -> float:
    """Hash of three integers, in [0, 1)."""
    h = (i * 374761393 + j * 668265263 + k * 362437) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 2246822519) & 0xFFFFFFFF
    return (h ^ (h >> 16)) / 4294967296.0


@njit(cache=True)
def noise(x: float, y: float, wavelength: float, w: float, k: int) -> float:
    """Value noise in [-1, 1], faded out when the footprint `w` approaches the wavelength; `k`: seed."""
    fade = 2.0 - 2.0 * w / wavelength
    if fade <= 0.0:
        return 0.0
    x /= wavelength
    y /= wavelength
    i, j = int(math.floor(x)), int(math.floor(y))
    a, b = x - i, y - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    low = _hash(i, j, k) * (1 - a) + _hash(i + 1, j, k) * a
    high = _hash(i, j + 1, k) * (1 - a) + _hash(i + 1, j + 1, k) * a
    return min(fade, 1.0) * (2.0 * (low * (1 - b) + high * b) - 1.0)


@njit(cache=True, inline="always")
def _clamp(x: float) -> float:
    return min(max(x, 0.0), 1.0)


@njit(cache=True)
def _inside(x: float, low: float, high: float, w: float) -> float:
    """Share of the interval [x - w/2, x + w/2] inside [low, high]."""
    return max(min(x + w / 2, high) - max(x - w / 2, low), 0.0) / w


@njit(cache=True)
def _joint(x: float, period: float, width: float, w: float) -> float:
    """Coverage by lines of a width at all multiples of `period`."""
    if w > period:
        return width / period
    d = x - period * math.floor(x / period + 0.5)
    return _inside(d, -width / 2, width / 2, w)


@njit(cache=True)
def _asphalt(s: float, t: float, w: float, k: int, road: npt.NDArray[Any]) -> tuple[float, float]:
    """Brightness of the road surface, and coverage by white paint; `road`: `Layout.road`."""
    half, zebra, dash = road[0], road[1], road[2]
    v = 1.0 + 0.07 * noise(s, t, 2.7, w, k) + 0.05 * noise(s, t, 0.55, w, k + 1)
    v += 0.10 * noise(s, t, 0.11, w, k + 2) + 0.20 * noise(s, t, 0.042, w, k + 3) + 0.26 * noise(s, t, 0.021, w, k + 4)
    lane = abs(abs(t) - half / 2)  # two wheel tracks in each lane are darker
    v *= 1.0 - 0.10 * math.exp(-(((lane - 0.78) / 0.24) ** 2)) * (1 + 0.4 * noise(s * 0.1, t, 0.5, w, k + 5))
    seam = _inside(t + 0.03 * noise(s, 0.0, 3.0, w, k + 6), -0.16, -0.135, w)
    v *= 1.0 - 0.35 * seam * _clamp(1 + noise(s, 0.0, 1.1, w, k + 13))
    cell = int(math.floor(s / 8.5))  # repaired patches
    if _hash(cell, 3, k) < 0.55:
        s0 = 8.5 * cell + 1 + 3 * _hash(cell, 4, k)
        t0 = (2 * _hash(cell, 5, k) - 1) * (half - 1.3) - 0.6
        s1, t1 = s0 + 0.9 + 2.8 * _hash(cell, 6, k), t0 + 0.7 + 0.7 * _hash(cell, 7, k)
        patch = _inside(s, s0, s1, w) * _inside(t, t0, t1, w)
        core = _inside(s, s0 + 0.035, s1 - 0.035, w) * _inside(t, t0 + 0.035, t1 - 0.035, w)
        v *= 1.0 - 0.20 * patch - 0.28 * (patch - core)
    crack = noise(s, t, 1.9, w, k + 7) + 0.35 * noise(s, t, 0.5, w, k + 8) + 0.1 * noise(s, t, 0.12, w, k + 12)
    v *= 1.0 - 0.42 * _clamp(1.3 - abs(crack) / 0.018) * _clamp(noise(s, t, 5.0, w, k + 9) * 3.0) * _clamp(2 - w / 0.03)
    cover = int(math.floor(s / 23.0))  # manhole covers
    ds, dt = s - 23.0 * cover - 6 - 10 * _hash(cover, 8, k), t - 1.1 * (1 if _hash(cover, 9, k) < 0.5 else -1)
    r = math.sqrt(ds * ds + dt * dt)
    if r < 0.45:
        lid = _inside(r, -1.0, 0.32, w)
        ribs = _joint(ds, 0.09, 0.04, w) * _joint(dt, 0.09, 0.04, w)
        v = v * (1 - lid) + lid * (0.62 - 0.25 * ribs)
        v *= 1.0 - 0.55 * _inside(r, 0.31, 0.345, w)
    paint = 0.0
    far = abs(s - zebra)
    if far < 1.9:
        if abs(t) < half - 0.1:
            paint = _inside(far, -2.0, 1.6, w) * (1 - _joint(t + 0.25, 1.0, 0.5, w))
    else:
        stop = _inside(far, 2.5, 2.85, w)
        here = stop * (1.0 if (s - zebra) * t > 0 else 0.0) * _inside(abs(t), 0.15, half - 0.3, w)
        phase = (s - dash) - 6.0 * math.floor((s - dash) / 6.0)
        centre = _inside(t, -0.06, 0.06, w) * _inside(phase, 0.0, 3.0, w) * (1.0 if far > 3.2 else 0.0)
        edge = _inside(abs(t), half - 0.27, half - 0.15, w)
        paint = max(max(here, centre), edge)
    if paint > 0.0:
        wear = (
            0.55 * noise(s, t, 0.3, w, k + 10) + 0.5 * noise(s, t, 0.05, w, k + 11) + 0.3 * noise(s, t, 1.3, w, k + 14)
        )
        paint *= 0.93 - 0.75 * _clamp(1.6 * wear - 0.55)
    return v, paint


@njit(cache=True)
def _bond(u: float, v: float, length: float, height: float, joint: float, w: float, k: int) -> tuple[float, float]:
    """Running bond: coverage by joints, and a random number in [0, 1) per stone (0.5 where stones blur)."""
    row = int(math.floor(v / height))
    x = u + (0.5 * length if row % 2 else 0.0)
    column = int(math.floor(x / length))
    j = max(_joint(x, length, joint, w), _joint(v, height, joint, w))
    sharp = _clamp(2.0 - 2.0 * w / length)
    return j, 0.5 + sharp * (_hash(column, row, k) - 0.5)


@njit(cache=True)
def _window(u: float, v: float, a: float, b: float, w: float, k: int) -> tuple[float, float, float, float]:
    """Coverage by the frame, and the colour seen through the glass."""
    frame = 1.0 - _inside(u, 0.065, a - 0.065, w) * _inside(v, 0.065, b - 0.065, w)
    kind = _hash(k, 1, 7)
    if a > 0.8:
        frame = max(frame, _inside(u, a / 2 - 0.04, a / 2 + 0.04, w))
    if kind < 0.55:
        frame = max(frame, _inside(v, 0.70 * b - 0.025, 0.70 * b + 0.025, w))
    if kind < 0.22:
        frame = max(frame, _inside(v, 0.36 * b - 0.015, 0.36 * b + 0.015, w))
    up = v / b
    sheen = 0.045 + 0.22 * _clamp(up - 0.25 + 0.35 * noise(u + 0.6 * v, v, 1.4, w, k)) ** 1.3
    r, g, bl = 0.75 * sheen, 0.95 * sheen, 1.2 * sheen
    drape = _hash(k, 2, 7)
    side = a * (0.14 + 0.16 * _hash(k, 3, 7))
    cloth = 0.0
    if drape < 0.5:
        cloth = max(_inside(u, 0.0, side, w), _inside(u, a - side, a, w))
    elif drape < 0.75:
        cloth = _inside(v, b * (0.35 + 0.5 * _hash(k, 4, 7)), b, w)
    if cloth > 0.0:
        fold = 0.34 + (
            0.09 * math.sin(u * 55.0) * _clamp(2 - w / 0.05) if drape < 0.5 else -0.10 * _joint(v, 0.08, 0.02, w)
        )
        tint = _hash(k, 5, 7)
        cloth *= 0.75
        r += cloth * (fold * (0.9 + 0.2 * tint) - r)
        g += cloth * (fold * 0.92 - g)
        bl += cloth * (fold * (0.98 - 0.25 * tint) - bl)
    rim = 1.0 - _inside(u, 0.095, a - 0.095, w) * _inside(v, 0.065, b - 0.11, w)  # shadow of the frame on the pane
    dim = 1.0 - 0.45 * rim
    return frame, r * dim, g * dim, bl * dim


@njit(cache=True)
def _sample(image: npt.NDArray[Any], u: float, v: float, channel: int) -> float:
    """Bilinear sample of a square image (n, n, 3); v upwards."""
    n = image.shape[0]
    x = min(max(u * n - 0.5, 0.0), n - 1.001)
    y = min(max((1 - v) * n - 0.5, 0.0), n - 1.001)
    i, j = int(x), int(y)
    a, b = x - i, y - j
    top = image[j, i, channel] * (1 - a) + image[j, i + 1, channel] * a
    low = image[j + 1, i, channel] * (1 - a) + image[j + 1, i + 1, channel] * a
    return top * (1 - b) + low * b


@njit(cache=True)
def _colour(
    m: int, u: float, v: float, r: float, g: float, b: float, k: int, a: float, h: float, w: float,
    road: npt.NDArray[Any], sign_images: npt.NDArray[Any],
) -> tuple[float, float, float]:  # fmt: skip
    """Albedo (linear RGB) at (u, v) of material `m` with base colour r, g, b, seed k, size a x h and footprint w."""
    if m == ASPHALT:
        f, paint = _asphalt(u, v, w, k, road)
        warm = 0.03 * noise(u, v, 4.0, w, k + 20)
        white = 0.60 * (1 + 0.04 * noise(u, v, 0.03, w, k + 21))
        return (
            r * f * (1 + warm) * (1 - paint) + white * paint,
            g * f * (1 - paint) + white * paint,
            b * f * (1 - warm) * (1 - paint) + 0.94 * white * paint,
        )
    if m == FOLIAGE:
        x, y = _hash(k, 1, 3), _hash(k, 2, 3)
        f = (0.72 + 0.56 * x) * (1 + 0.16 * noise(u, v, 0.06, w, k) + 0.10 * noise(u, v, 0.4, w, k))
        return r * f * (0.85 + 0.45 * y), g * f, b * f * (1.15 - 0.4 * y)
    if m == GRASS:
        big = 0.5 + 0.5 * noise(u, v, 3.3, w, k) + 0.25 * noise(u, v, 0.9, w, k + 1)
        f = (
            1
            + 0.24 * noise(u, v, 0.27, w, k + 2)
            + 0.34 * noise(u, v, 0.06, w, k + 3)
            + 0.36 * noise(u, v, 0.024, w, k + 4)
        )
        dry = _clamp(big - 0.35) * 0.6
        soil = _clamp(2.5 * noise(u, v, 1.7, w, k + 5) + noise(u, v, 0.35, w, k + 6) - 1.55)
        flower = _clamp(8 * (noise(u, v, 0.045, w, k + 8) - 0.80)) * _clamp(2 * noise(u, v, 2.1, w, k + 9))
        r, g, b = r * (1 + 1.0 * dry), g * (1 + 0.25 * dry), b * (1 + 0.1 * dry)
        r, g, b = r + (0.145 - r) * soil, g + (0.105 - g) * soil, b + (0.065 - b) * soil
        return r * f + 0.45 * flower, g * f + 0.42 * flower, b * f + 0.25 * flower
    if m == SETTS:
        j, tone = _bond(u, v, 0.16, 0.105, 0.016, w, k)
        f = (0.78 + 0.44 * tone) * (1 + 0.14 * noise(u, v, 0.024, w, k) + 0.10 * noise(u, v, 1.9, w, k + 1))
        f *= 1 - 0.62 * j
        return r * f, g * f, b * f * (0.94 + 0.12 * tone)
    if m == KERB:
        j = _joint(u, 1.0, 0.014, w)
        tone = _hash(int(math.floor(u)), 3, k)
        f = (
            (0.90 + 0.18 * tone)
            * (1 + 0.18 * noise(u, v, 0.022, w, k) + 0.1 * noise(u, v, 0.3, w, k + 1))
            * (1 - 0.6 * j)
        )
        return r * f, g * f, b * f
    if m == SLABS:
        j, tone = _bond(u, v, 0.5, 0.5, 0.013, w, k)
        f = (0.88 + 0.24 * tone) * (1 + 0.09 * noise(u, v, 0.022, w, k) + 0.07 * noise(u, v, 0.13, w, k + 1))
        f *= (1 + 0.09 * noise(u, v, 2.3, w, k + 2)) * (1 - 0.55 * j)
        spot = _clamp(6 * (noise(u, v, 0.07, w, k + 3) - 0.83))  # stains of chewing gum
        f *= 1 - 0.35 * spot
        return r * f, g * f * (0.99 + 0.02 * tone), b * f * (0.96 + 0.08 * tone)
    if m == BRICK:
        j, tone = _bond(u, v, 0.25, 0.075, 0.013, w, k)
        f = (0.62 + 0.76 * tone) * (1 + 0.13 * noise(u, v, 0.022, w, k))
        dirt = 1 + 0.13 * noise(u, v, 2.1, w, k + 1) - 0.18 * _clamp(1 - v / 0.9)
        mortar = 0.36 * (1 + 0.08 * noise(u, v, 0.03, w, k + 2))
        r, g, b = r * f, g * f * (0.9 + 0.2 * tone), b * f * (0.85 + 0.3 * tone)
        return (
            (r + (mortar - r) * j) * dirt, (g + (0.93 * mortar - g) * j) * dirt, (b + (0.82 * mortar - b) * j) * dirt,
        )  # fmt: skip
    if m == PLASTER:
        f = (
            1
            + 0.055 * noise(u, v, 0.022, w, k)
            + 0.035 * noise(u, v, 0.07, w, k + 1)
            + 0.05 * noise(u, v, 1.8, w, k + 2)
        )
        streak = _clamp(noise(u, 0.08 * v, 0.22, w, k + 3) - 0.15) * _clamp(0.3 + 0.7 * noise(u, v, 2.5, w, k + 4))
        f *= 1 - 0.22 * streak - 0.22 * _clamp(1 - v / 0.7) * (1 + 0.6 * noise(u, v, 0.4, w, k + 5))
        return r * f, g * f * (1 - 0.02 * streak), b * f * (1 - 0.06 * streak)
    if m == STONE:
        j, tone = _bond(u, v, 0.7, 0.34, 0.014, w, k)
        f = (
            (0.86 + 0.28 * tone)
            * (1 + 0.11 * noise(u, v, 0.024, w, k) + 0.09 * noise(u, v, 0.25, w, k + 1))
            * (1 - 0.5 * j)
        )
        return r * f, g * f, b * f * (0.94 + 0.1 * tone)
    if m == WINDOW:
        frame, x, y, z = _window(u, v, a, h, w, k)
        return x + (r - x) * frame, y + (g - y) * frame, z + (b - z) * frame
    if m == DOOR:
        f = 1 + 0.06 * noise(u, 0.05 * v, 0.025, w, k)
        for low, high in ((0.06, 0.36), (0.40, 0.64)):
            for left in (0.10, 0.56):
                rim = _inside(u / a, left, left + 0.34, w / a) * _inside(v / h, low, high, w / h)
                core = _inside(u / a, left + 0.03, left + 0.31, w / a) * _inside(
                    v / h, low + 0.013, high - 0.013, w / h
                )
                f *= 1 - 0.45 * (rim - core)
        f *= 1 - 0.5 * _joint(u - 0.012, a, 0.025, w)
        pane = (
            _inside(u / a, 0.16, 0.84, w / a)
            * _inside(v / h, 0.70, 0.92, w / h)
            * (1 - _inside(u, a / 2 - 0.02, a / 2 + 0.02, w))
        )
        knob = _inside(math.hypot(u - 0.1, v - 1.03), -1.0, 0.035, w)
        r, g, b = r * f, g * f, b * f
        r, g, b = r + (0.06 - r) * pane, g + (0.075 - g) * pane, b + (0.085 - b) * pane
        return r + (0.6 - r) * knob, g + (0.5 - g) * knob, b + (0.3 - b) * knob
    if m == SHOP:
        post = max(_joint(u, a / max(1.0, math.floor(a / 1.5 + 0.5)), 0.09, w), 1 - _inside(v, 0.09, h - 0.09, w))
        up = v / h
        x = 0.05 + 0.10 * _clamp(up + 0.4 * noise(u + 0.5 * v, v, 1.6, w, k))
        goods = _inside(v, 0.12, 0.3 + 0.5 * _hash(int(math.floor(u / 0.31)), 5, k), w) * _inside(
            u - 0.31 * math.floor(u / 0.31), 0.03, 0.28, w
        )
        c = int(math.floor(u / 0.31))
        x1, y1, z1 = 0.9 * x, x, 1.1 * x
        x1 += goods * (0.05 + 0.4 * _hash(c, 1, k) - x1)
        y1 += goods * (0.05 + 0.35 * _hash(c, 2, k) - y1)
        z1 += goods * (0.05 + 0.35 * _hash(c, 3, k) - z1)
        return x1 + (r - x1) * post, y1 + (g - y1) * post, z1 + (b - z1) * post
    if m == ROOF_TILES:
        row = int(math.floor(v / 0.33))
        x = u + (0.13 if row % 2 else 0.0)
        tone = 0.5 + _clamp(2 - 2 * w / 0.26) * (_hash(int(math.floor(x / 0.26)), row, k) - 0.5)
        y = v / 0.33 - row
        sharp = _clamp(2 - 2 * w / 0.26)
        f = (0.80 + 0.4 * tone) * (1 - sharp * (0.32 * math.exp(-y * 7) - 0.1 * math.sin(6.2832 * x / 0.26)))
        f *= (1 + 0.1 * noise(u, v, 0.03, w, k) + 0.12 * noise(u, v, 2.2, w, k + 1)) * (
            1 - 0.35 * _joint(x, 0.26, 0.018, w)
        )
        moss = _clamp(noise(u, v, 1.3, w, k + 2) + 0.6 * noise(u, v, 0.2, w, k + 3) - 0.6)
        r, g, b = r * f, g * f, b * f
        return r + (0.09 - r) * moss, g + (0.11 - g) * moss, b + (0.05 - b) * moss
    if m == BARK:
        f = (
            1
            + 0.30 * noise(u, 0.2 * v, 0.028, w, k)
            + 0.22 * noise(u, 0.3 * v, 0.09, w, k + 1)
            + 0.14 * noise(u, v, 0.5, w, k + 2)
        )
        return r * f, g * f, b * f
    if m == WOOD:
        f = 1 + 0.14 * noise(u, 0.06 * v, 0.022, w, k) + 0.12 * noise(u, 0.1 * v, 0.07, w, k + 1)
        f *= 0.85 + 0.3 * _hash(k, 1, 5)
        return r * f, g * f, b * f
    if m in (CAR_BODY, CAR_GLASS):
        if m == CAR_BODY:
            f = 1 - 0.45 * _clamp((0.45 - v) / 0.2)
            doors = max(_inside(u, 0.82, 0.84, w), max(_inside(u, -0.16, -0.14, w), _inside(u, -1.12, -1.10, w)))
            f *= 1 - 0.6 * doors * _inside(v, 0.36, 0.92, w)
            handle = _inside(v, 0.76, 0.79, w) * max(_inside(u, 0.0, 0.17, w), _inside(u, -0.95, -0.78, w))
            f *= 1 - 0.5 * handle - 0.25 * _inside(v, 0.62, 0.645, w) * _inside(u, -1.9, 1.9, w)
            for x in (-1.32, 1.36):
                f *= 1 - 0.93 * _inside(math.hypot(u - x, v - 0.33), -1.0, 0.40, w)
            return r * f + 0.004, g * f + 0.004, b * f + 0.004
        glass = 0.018 + 0.10 * _clamp((v - 0.95) / 0.5) * (1 + 0.4 * noise(u + v, v, 0.8, w, k))
        pillar = max(_inside(u, -0.20, -0.12, w), max(_inside(u, -1.22, -1.12, w), _inside(v, 1.34, 2.0, w))) * (
            1 if h < 0.5 else 0
        )
        return (
            0.9 * glass + (r - 0.9 * glass) * pillar,
            glass + (g - glass) * pillar,
            1.15 * glass + (b - 1.15 * glass) * pillar,
        )  # fmt: skip
    if m == CAR_END:
        lamp = _inside(abs(u), 0.50, 0.80, w) * _inside(v, 0.60, 0.74, w)
        plate = _inside(abs(u), -1.0, 0.26, w) * _inside(v, 0.46, 0.57, w)
        text = plate * _joint(u, 0.06, 0.03, w) * _inside(v, 0.485, 0.545, w)
        grille = _inside(abs(u), -1.0, 0.42, w) * _inside(v, 0.60, 0.70, w) * (1 if a > 0 else 0)
        f = (1 - 0.8 * _clamp((0.40 - v) / 0.06)) * (1 - 0.85 * grille * (1 - 0.4 * _joint(v, 0.035, 0.015, w)))
        x, y, z = (0.75, 0.75, 0.7) if a > 0 else (0.45, 0.02, 0.02)
        r, g, b = r * f + (x - r * f) * lamp, g * f + (y - g * f) * lamp, b * f + (z - b * f) * lamp
        ink = 0.65 - 0.6 * text
        return r + (ink - r) * plate, g + (ink - g) * plate, b + (ink - b) * plate
    if m == WHEEL:
        q = math.hypot(u, v)
        rim = _inside(q, -1.0, 0.215, w)
        spokes = 0.55 + 0.45 * math.cos(5 * math.atan2(v, u)) if q > 0.05 else 1.0
        grey = 0.022 * (1 - rim) + rim * (0.06 + 0.38 * spokes)
        return grey, grey, grey
    if m == SIGN:
        p = sign_images[k]
        return _sample(p, u, v, 0), _sample(p, u, v, 1), _sample(p, u, v, 2)
    if m == GRIT:
        size, deep = 0.03 * 20 ** _hash(k, 1, 9), 0.15 + 0.55 * _hash(k, 2, 9)
        f = 1 + deep * (noise(u, v, size, w, k) + 0.5 * noise(u, v, 3 * size, w, k + 1))
        f *= 1 + 0.25 * noise(u, v, 1.7, w, k + 2) + 0.3 * _hash(k, 3, 9) * noise(u, v, 6.0, w, k + 3)
        other = _clamp(3 * noise(u, v, 2.5 * size, w, k + 4) - 3 * _hash(k, 4, 9))  # share of a second colour
        x, y, z = _hash(k, 5, 9), _hash(k, 6, 9), _hash(k, 7, 9)
        f = max(f, 0.1)
        return (
            r * f * (1 - other) + (0.5 * r + 0.3 * x) * other, g * f * (1 - other) + (0.5 * g + 0.27 * x * y) * other,
            b * f * (1 - other) + (0.5 * b + 0.24 * x * z) * other,
        )  # fmt: skip
    if m == PANELS:
        if _hash(k, 1, 9) < 0.5:
            u, v = v, u
        wide, long = 0.08 * 20 ** _hash(k, 2, 9), 1.0 + 6.0 * _hash(k, 3, 9)
        j, tone = _bond(u, v, long, wide, 0.02 + 0.03 * _hash(k, 4, 9), w, k)
        round_ = 0.4 * _hash(k, 5, 9) * (v / wide - math.floor(v / wide) - 0.5) * _clamp(2 - 2 * w / wide)
        f = (1 + round_) * (1 + 0.5 * _hash(k, 6, 9) * (tone - 0.5)) * (1 - (0.3 + 0.6 * _hash(k, 7, 9)) * j)
        f *= 1 + 0.08 * noise(u, v, 0.05, w, k + 2) + 0.12 * noise(u, v, 1.5, w, k + 3)
        return r * f, g * f, b * f
    f = 1 + 0.05 * noise(u, v, 0.03, w, k) + 0.06 * noise(u, v, 0.6, w, k + 1)
    return r * f, g * f, b * f


@njit(cache=True, parallel=True)
def surface(
    face: npt.NDArray[Any], bary: npt.NDArray[Any], footprint: npt.NDArray[Any],
    faces: npt.NDArray[Any], normals: npt.NDArray[Any], uv: npt.NDArray[Any], sky: npt.NDArray[Any],
    material: npt.NDArray[Any], colour: npt.NDArray[Any], seed: npt.NDArray[Any], size: npt.NDArray[Any],
    road: npt.NDArray[Any], sign_images: npt.NDArray[Any],
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:  # fmt: skip
    """Surface properties at points given by face and barycentric coordinates.

    Args:
        face: (N,) faces.
        bary: (N, 2) weights of the face's second and third corner.
        footprint: (N,) width of the sample, metres.
        faces, normals, uv, sky, material, colour, seed, size: arrays of a `shapes.Part`.
        road: `Layout.road`.
        sign_images: `signs.images()`.

    Returns:
        Albedo (N, 3) in linear RGB, shading normal (N, 3), sky openness (N,), all float32.
    """
    n = len(face)
    albedo, normal, openness = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty(n, np.float32)
    for i in prange(n):
        f = face[i]
        c1, c2 = bary[i, 0], bary[i, 1]
        c0 = 1 - c1 - c2
        p, q, s = faces[f, 0], faces[f, 1], faces[f, 2]
        u = c0 * uv[p, 0] + c1 * uv[q, 0] + c2 * uv[s, 0]
        v = c0 * uv[p, 1] + c1 * uv[q, 1] + c2 * uv[s, 1]
        w = max(footprint[i], 0.01)
        r, g, b = _colour(
            material[f],
            u,
            v,
            colour[f, 0],
            colour[f, 1],
            colour[f, 2],
            seed[f],
            size[f, 0],
            size[f, 1],
            w,
            road,
            sign_images,
        )
        albedo[i, 0], albedo[i, 1], albedo[i, 2] = _clamp(r), _clamp(g), _clamp(b)
        x = c0 * normals[p, 0] + c1 * normals[q, 0] + c2 * normals[s, 0]
        y = c0 * normals[p, 1] + c1 * normals[q, 1] + c2 * normals[s, 1]
        z = c0 * normals[p, 2] + c1 * normals[q, 2] + c2 * normals[s, 2]
        length = max(math.sqrt(x * x + y * y + z * z), 1e-9)
        normal[i, 0], normal[i, 1], normal[i, 2] = x / length, y / length, z / length
        openness[i] = c0 * sky[p] + c1 * sky[q] + c2 * sky[s]
    return albedo, normal, openness
