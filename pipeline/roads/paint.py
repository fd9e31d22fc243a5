"""Painted lines along a road, as its texture shows them: brighter than the asphalt to both sides, a hand wide.

Brightness is looked at as its logarithm, so that paint in a shadow is paint: it is a share brighter than what is
beside it, whatever the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.pipeline.roads.clothoid import Clothoids

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Renderer

ALONG, ACROSS = 0.05, 0.02
"""Metres of a pixel of the road's picture."""
ROW = 0.25
"""Metres along the road between places where lines are looked for."""
WINDOW = 0.5
"""Metres along the road that are seen as one there: a line goes on, a stone doesn't."""
SHAPES = ((0.04, 0.09, 0.17), (0.07, 0.17, 0.30))
"""Metres from a line's middle: half of what must be bright; from where to where the asphalt beside it is looked at."""
CONTRAST = 0.16
"""Logarithm of how many times brighter paint is than the brighter side, at least, in sRGB values: EN 1436 asks for a
luminance coefficient of 100 mcd/m2/lx of white lines (Q2), asphalt has 70 at most."""
SPREAD = 4.0
"""Times the spread of what isn't paint, likewise."""
STRAY = 0.08
"""Metres by which a line's middle may differ from row to row."""
GAP = 3
"""Rows that may miss in a stroke: worn paint."""
SHORTEST = 0.75
"""Metres of a stroke."""
FILLED = 64  # of textures' masks: no photo and no point has seen it
PIECE = 50.0
"""Metres of road that are looked at in one go, to bound memory."""


@dataclass(frozen=True)
class Paint:
    """Strokes of paint, as rows of places in their middle.

    Attributes:
        place: (N, 2) local metres.
        stroke: (N,) which stroke a place belongs to.
        width: (N,) metres of paint there.
    """

    place: F64
    stroke: I64
    width: F64


def strokes(renderer: Renderer, line: Clothoids, reach: float, top: float) -> Paint:
    """The strokes of paint that run along a line, as far as `reach` metres to either side.

    Args:
        renderer: of the ground's textured mesh.
        line: along the road.
        reach: metres.
        top: metres above all ground.
    """
    rows: list[tuple[float, F64]] = []
    stations = np.arange(ROW / 2, line.length, ROW)
    per = max(1, int(PIECE / ROW))
    for first in range(0, len(stations), per):
        rows += _rows(renderer, line, stations[first : first + per], reach, top)
    return _followed(line, rows)


def _rows(renderer: Renderer, line: Clothoids, stations: F64, reach: float, top: float) -> list[tuple[float, F64]]:
    """Of each station: the chainage; offset, width and contrast (M, 3) of what looks like a line."""
    t = np.arange(-reach, reach, ACROSS)
    s = np.arange(stations[0] - WINDOW, stations[-1] + WINDOW, ALONG)
    xy = line.places(np.repeat(s, len(t)), np.tile(t, len(s)))
    places = np.column_stack([xy, np.full(len(xy), top)]).reshape(len(s), len(t), 3)
    image = renderer.down(places)
    known = image.hit & (image.seen > FILLED)
    light = np.where(known, np.log(image.rgb.astype(np.float32).mean(axis=2) + 8.0), 0.0)
    inside = np.abs(s[None] - stations[:, None]) <= WINDOW / 2 + 1e-9
    count = inside.astype(np.float32) @ known.astype(np.float32)
    half = count >= inside.sum(axis=1, keepdims=True) / 2
    mean = np.where(half, inside.astype(np.float32) @ light / np.maximum(count, 1), np.nan)
    response = np.fmax.reduce([_ridge(mean, *(round(x / ACROSS) for x in shape)) for shape in SHAPES])
    finite = response[np.isfinite(response)]
    if not len(finite):
        return []
    limit = max(CONTRAST, SPREAD * 1.4826 * float(np.median(np.abs(finite - np.median(finite)))))
    return [(float(at), _peaks(t, r, m, limit)) for at, r, m in zip(stations, response, mean, strict=True)]


def _ridge(mean: F64, half: int, near: int, far: int) -> F64:
    """(R, T) how much brighter the middle of so many pixels is than the brighter side; NaN where any isn't known.

    Both sides are asphalt, as bright as each other: a kerb's stone has asphalt to one side alone.
    """
    total = np.cumsum(np.pad(np.nan_to_num(mean), ((0, 0), (far + 1, far))), axis=1)
    known = np.cumsum(np.pad(np.isfinite(mean), ((0, 0), (far + 1, far))), axis=1)
    n = mean.shape[1]

    def box(a: int, b: int) -> F64:
        """Means over the pixels from a to b (inclusive) beside each."""
        first, last = far + a, far + b + 1
        enough = known[:, last : last + n] - known[:, first : first + n] == b - a + 1
        return np.where(enough, (total[:, last : last + n] - total[:, first : first + n]) / (b - a + 1), np.nan)

    left, right = box(-far, -near), box(near, far)
    more = box(-half, half) - np.maximum(left, right)
    return np.where(np.abs(left - right) < more, more, np.minimum(more, 0.0))


def _peaks(t: F64, response: F64, mean: F64, limit: float) -> F64:
    """Offset, width and contrast (M, 3) of the lines of a row."""
    value = np.nan_to_num(response, nan=-np.inf)
    reach = round(0.15 / ACROSS)
    found: list[tuple[float, float, float]] = []
    for i in np.flatnonzero(value >= limit).tolist():
        around = slice(max(0, i - reach), i + reach + 1)
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
        found.append((middle, (hi - lo + 1) * ACROSS, float(value[i])))
    return np.array(found).reshape(-1, 3)


def _followed(line: Clothoids, rows: list[tuple[float, F64]]) -> Paint:
    """Strokes: what goes on from row to row, as (row, chainage, offset, width, contrast)."""
    growing: list[list[tuple[int, float, float, float, float]]] = []
    done: list[list[tuple[int, float, float, float, float]]] = []
    for i, (s, peaks) in enumerate(rows):
        for t, width, contrast in peaks.tolist():
            near = [k for k in growing if k[-1][0] < i and abs(k[-1][2] - t) < STRAY * (i - k[-1][0])]
            if near:
                min(near, key=lambda k: abs(k[-1][2] - t)).append((i, s, t, width, contrast))
            else:
                growing.append([(i, s, t, width, contrast)])
        done += [k for k in growing if i - k[-1][0] > GAP]
        growing = [k for k in growing if i - k[-1][0] <= GAP]
    kept = [own for own in map(_trimmed, done + growing) if own[-1, 0] - own[0, 0] + ROW >= SHORTEST]
    flat = np.concatenate([np.zeros((0, 3)), *kept])
    number = np.repeat(np.arange(len(kept)), [len(k) for k in kept]).astype(np.int64)
    places = line.places(flat[:, 0], flat[:, 1]) if len(flat) else np.zeros((0, 2))
    return Paint(places, number, flat[:, 2])


def _trimmed(stroke: list[tuple[int, float, float, float, float]]) -> F64:
    """(M, 3) chainage, offset and width, without ends where less than half of what is looked at is paint."""
    own = np.array(stroke)[:, 1:]
    strong = np.flatnonzero(own[:, 3] >= np.median(own[:, 3]) / 2)
    return np.asarray(own[strong[0] : strong[-1] + 1, :3])
