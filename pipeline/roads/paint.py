"""Lane markings: detection of painted lines in the ground's texture, as ridges brighter than the asphalt on both sides.

Detection uses the logarithm of brightness, so that the contrast of paint is the same in shadow and in light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.pipeline.roads.clothoid import Clothoids

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Renderer

PIXEL_ALONG_M, PIXEL_ACROSS_M = 0.05, 0.02
"""Pixel size of the rendered road."""
ROW_M = 0.25
"""Spacing along the road at which lines are detected."""
WINDOW_M = 0.5
"""Length along the road that is averaged for a row: lines continue, stones don't."""
RIDGE_WIDTHS_M = ((0.04, 0.09, 0.17), (0.07, 0.17, 0.30))
"""Ridge filters, distances from the centre: half width of the bright part, and range of the asphalt beside it."""
MIN_LOG_CONTRAST = 0.16
"""Minimum log ratio of brightness between paint and the brighter side, in sRGB values: EN 1436 requires a luminance
coefficient of 100 mcd/m2/lx for white lines (Q2), asphalt has 70 at most."""
MIN_CONTRAST_SIGMAS = 4.0
"""Minimum contrast relative to the (robust) standard deviation of the background."""
MAX_ROW_SHIFT_M = 0.08
"""Largest change of a line's centre per row."""
MAX_MISSING_ROWS = 3
"""Largest gap in a stroke: worn paint."""
MIN_STROKE_M = 0.75
"""Minimum length of a stroke."""
SOURCE_FILLED = 64  # value of colour source masks: inpainted, not seen by a photo or a point
CHUNK_M = 50.0
"""Length of road that is rendered at a time, to bound memory."""


@dataclass(frozen=True)
class Paint:
    """Strokes of paint, as points on their centre lines.

    Attributes:
        position: (N, 2) local metres.
        stroke: (N,) index of the point's stroke.
        width: (N,) width of the paint, metres.
    """

    position: F64
    stroke: I64
    width: F64


def strokes(renderer: Renderer, line: Clothoids, max_offset: float, top: float) -> Paint:
    """Detect strokes of paint along a line.

    Args:
        renderer: renderer of the ground's textured mesh.
        line: line along the road.
        max_offset: largest distance from the line to either side, metres.
        top: a height above all ground, metres.
    """
    rows: list[tuple[float, F64]] = []
    stations = np.arange(ROW_M / 2, line.length, ROW_M)
    rows_per_chunk = max(1, int(CHUNK_M / ROW_M))
    for first in range(0, len(stations), rows_per_chunk):
        rows += _rows(renderer, line, stations[first : first + rows_per_chunk], max_offset, top)
    return _trace(line, rows)


def _rows(renderer: Renderer, line: Clothoids, stations: F64, max_offset: float, top: float) -> list[tuple[float, F64]]:
    """For each station: its chainage; offset, width and contrast (M, 3) of line candidates."""
    t = np.arange(-max_offset, max_offset, PIXEL_ACROSS_M)
    s = np.arange(stations[0] - WINDOW_M, stations[-1] + WINDOW_M, PIXEL_ALONG_M)
    xy = line.points(np.repeat(s, len(t)), np.tile(t, len(s)))
    places = np.column_stack([xy, np.full(len(xy), top)]).reshape(len(s), len(t), 3)
    image = renderer.down(places)
    known = image.hit & (image.seen > SOURCE_FILLED)
    light = np.where(known, np.log(image.rgb.astype(np.float32).mean(axis=2) + 8.0), 0.0)
    inside = np.abs(s[None] - stations[:, None]) <= WINDOW_M / 2 + 1e-9
    count = inside.astype(np.float32) @ known.astype(np.float32)
    half = count >= inside.sum(axis=1, keepdims=True) / 2
    mean = np.where(half, inside.astype(np.float32) @ light / np.maximum(count, 1), np.nan)
    response = np.fmax.reduce([_ridge(mean, *(round(x / PIXEL_ACROSS_M) for x in shape)) for shape in RIDGE_WIDTHS_M])
    finite = response[np.isfinite(response)]
    if not len(finite):
        return []
    limit = max(MIN_LOG_CONTRAST, MIN_CONTRAST_SIGMAS * 1.4826 * float(np.median(np.abs(finite - np.median(finite)))))
    return [(float(at), _peaks(t, r, m, limit)) for at, r, m in zip(stations, response, mean, strict=True)]


def _ridge(mean: F64, half: int, near: int, far: int) -> F64:
    """Ridge filter response (R, T): brightness of the centre minus that of the brighter side; NaN with unknown pixels.

    Both sides must be equally bright: a kerb stone has asphalt on one side only.
    """
    total = np.cumsum(np.pad(np.nan_to_num(mean), ((0, 0), (far + 1, far))), axis=1)
    known = np.cumsum(np.pad(np.isfinite(mean), ((0, 0), (far + 1, far))), axis=1)
    n = mean.shape[1]

    def box(a: int, b: int) -> F64:
        """Means over the pixels at offsets a to b (inclusive)."""
        first, last = far + a, far + b + 1
        enough = known[:, last : last + n] - known[:, first : first + n] == b - a + 1
        return np.where(enough, (total[:, last : last + n] - total[:, first : first + n]) / (b - a + 1), np.nan)

    left, right = box(-far, -near), box(near, far)
    more = box(-half, half) - np.maximum(left, right)
    return np.where(np.abs(left - right) < more, more, np.minimum(more, 0.0))


def _peaks(t: F64, response: F64, mean: F64, limit: float) -> F64:
    """Offset, width and contrast (M, 3) of the peaks in a row."""
    value = np.nan_to_num(response, nan=-np.inf)
    max_offset = round(0.15 / PIXEL_ACROSS_M)
    found: list[tuple[float, float, float]] = []
    for i in np.flatnonzero(value >= limit).tolist():
        around = slice(max(0, i - max_offset), i + max_offset + 1)
        if value[i] < value[around].max() or (found and t[i] - found[-1][0] < 0.1):
            continue
        level = mean[i] - value[i] / 2
        bright = np.nan_to_num(mean[around], nan=-np.inf) > level
        lo = hi = i - around.start
        while lo > 0 and bright[lo - 1]:
            lo -= 1
        while hi + 1 < len(bright) and bright[hi + 1]:
            hi += 1
        middle = float(t[around][lo] + t[around][hi]) / 2
        found.append((middle, (hi - lo + 1) * PIXEL_ACROSS_M, float(value[i])))
    return np.array(found).reshape(-1, 3)


def _trace(line: Clothoids, rows: list[tuple[float, F64]]) -> Paint:
    """Link peaks of successive rows to strokes of (row, chainage, offset, width, contrast)."""
    growing: list[list[tuple[int, float, float, float, float]]] = []
    done: list[list[tuple[int, float, float, float, float]]] = []
    for i, (s, peaks) in enumerate(rows):
        for t, width, contrast in peaks.tolist():
            near = [k for k in growing if k[-1][0] < i and abs(k[-1][2] - t) < MAX_ROW_SHIFT_M * (i - k[-1][0])]
            if near:
                min(near, key=lambda k: abs(k[-1][2] - t)).append((i, s, t, width, contrast))
            else:
                growing.append([(i, s, t, width, contrast)])
        done += [k for k in growing if i - k[-1][0] > MAX_MISSING_ROWS]
        growing = [k for k in growing if i - k[-1][0] <= MAX_MISSING_ROWS]
    kept = [own for own in map(_trim_ends, done + growing) if own[-1, 0] - own[0, 0] + ROW_M >= MIN_STROKE_M]
    flat = np.concatenate([np.zeros((0, 3)), *kept])
    number = np.repeat(np.arange(len(kept)), [len(k) for k in kept]).astype(np.int64)
    places = line.points(flat[:, 0], flat[:, 1]) if len(flat) else np.zeros((0, 2))
    return Paint(places, number, flat[:, 2])


def _trim_ends(stroke: list[tuple[int, float, float, float, float]]) -> F64:
    """Chainage, offset and width (M, 3) of a stroke, without ends of less than half the median contrast."""
    own = np.array(stroke)[:, 1:]
    strong = np.flatnonzero(own[:, 3] >= np.median(own[:, 3]) / 2)
    return np.asarray(own[strong[0] : strong[-1] + 1, :3])
