"""Plates in photos: outlines that all photos agree on, and where they hang.

Along a plate's outline what is just inside differs from what is just outside, in every photo, while all of its face
is alike in all of them; what is behind a plate moves from photo to photo. The place, heading and size where that is
so are found by differential evolution (Storn and Price 1997) and the method of Nelder and Mead.
Import late: it loads numba.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, U8, View
from scan2sim.pipeline.furniture.sign_panels import ASPECT, OUTLINES, SIZE, Plate, Shape, inside

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

PHOTOS = (3, 6)
"""Photos that a plate is looked for in, at least and at most: the finest."""
COARSEST = 0.4
"""Of the finest one's pixels a metre, those of the coarsest photo at least."""
SIDEWAYS = 0.5
"""cos of the angle between two photos' rays to a plate at least: beyond, one may see its back."""
AROUND = 1.6
"""Metres that a close-up shows to each side of a place, and ..."""
WHOLE = 0.6
"""... that a photo must show."""
LEAST = 8
"""Pixels a metre below which a photo tells nothing of plates."""
RIM = 48
"""Places along an outline."""
NOISE = 4.0
"""Grey levels, standard deviation, by which photos of one thing differ."""
CLOSED = 2 / 3
"""Where an outline is weakest, the contrast across it is twice what photos disagree by there and their noise."""
ALIKE = 0.8
"""Share of what is seen of a plate's face that all photos agree on."""
NEARLY = 0.8
"""Share of both from which a plate is looked at more closely."""
HOPEFUL, MIDWAY, GENERATIONS = 0.4, 25, 50
"""Share of both below which a search ends midway, and generations: a plate that is there may be met late, but by then
has nearly all."""
ROUGHLY = 0.6
"""Share of both from which what a search ends with is refined."""
TURN = math.radians(60)
"""By which a plate's heading may be wrong."""
LARGER = 0.03
"""What twice the area is worth against contrast: an outline is the outermost of those that are as clear."""
GROWN, RINGS = np.linspace(1.02, 1.4, 20), 3
"""Times an outline's size at which another one is looked for around it, and how often."""
FINE, TURNS = 0.5, (-0.3, 0.0, 0.3)
"""Pixels to both sides of an outline that are compared where it is found exactly, and radians that it may be turned:
small plates are as clear so."""
ALIKE_SIZE, ALIKE_PLACE = 0.05, 0.1
"""Share of its size, and metres, by which it is moved at most."""
ASIDE, TOUCH, GAP = 0.15, 0.03, 0.15
"""Metres that a plate may hang beside another one of its pole, reach into its bounds, and be apart from it."""
AS_LARGE = 0.8
"""Of the largest plate's area that one has that is taken for it."""


@dataclass(frozen=True)
class CloseUps:
    """What several photos show around a place.

    Attributes:
        pictures: (J, S, S, 3) float32, pinhole pictures that look at it.
        project: (J, 3, 4) from local metres to their pixels, homogeneous.
        focal: (J,) pixels.
        place: (3,) local metres, their middle.
        towards: (3,) unit, from there to the photos.
    """

    pictures: F32
    project: F64
    focal: F64
    place: F64
    towards: F64

    def clear(self, shape: Shape, plates: F64, off: float = 1.0) -> F64:
        """(N, 3) how clear outlines are on average, where they are weakest, and how alike their faces; each 0 to 1.

        Args:
            shape: of the outlines.
            plates: (N, 6) x, y, z (local metres), heading (radians), width, height.
            off: pixels to both sides of an outline that are compared.
        """
        return _clear(self.pictures, self.project, self.focal, plates, *_samples(shape), RIM, off, NOISE)

    def is_there(self, plate: Plate, share: float = 1.0) -> bool:
        """Whether a plate is there, as clear as one must be, or a share of it."""
        _, weakest, alike = self.clear(plate.shape, _row(plate))[0]
        return bool(weakest >= share * CLOSED and alike >= share * ALIKE)

    def worth(self, shape: Shape, plates: F64, off: float = 1.0) -> F64:
        """(N,) what is to be as large as can be, of plates as `clear` takes them."""
        mean, weakest, alike = self.clear(shape, plates, off).T
        return np.asarray((mean + weakest) / 2 * alike + LARGER * np.log2(plates[:, 4] * plates[:, 5]))


def close_ups(place: F64, views: Sequence[View], photo: Callable[[int], U8 | None]) -> CloseUps | None:
    """What the finest photos show around a place (3,); None where fewer than three do.

    Args:
        place: local metres.
        views: that may be looked at.
        photo: index of a view to its picture (H, W, 3), None where it can't be read.
    """
    fineness = np.array([_fineness(view, place) for view in views])
    order = [int(i) for i in np.argsort(-fineness, kind="stable") if fineness[i] > LEAST]
    if len(order) < PHOTOS[0]:
        return None
    rays = np.array([views[i].centre - place for i in order])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    chosen = [
        i for i, ray in zip(order, rays, strict=True)
        if fineness[i] >= COARSEST * fineness[order[0]] and ray @ rays[0] > SIDEWAYS
    ][: PHOTOS[1]]  # fmt: skip
    size = 2 * math.ceil(AROUND * fineness[order[0]]) + 1
    shown = [(rgb, views[i], fineness[i]) for i in chosen if (rgb := photo(i)) is not None]
    if len(shown) < PHOTOS[0]:
        return None
    made = [_close_up(rgb, view, place, size, fine) for rgb, view, fine in shown]
    pictures, project, focal = (np.array(column) for column in zip(*made, strict=True))
    towards = rays[: len(chosen)].mean(axis=0)
    return CloseUps(pictures, project, focal, place, towards / np.linalg.norm(towards))


def _fineness(view: View, place: F64) -> float:
    """Pixels a metre at which a photo shows a place (3,), with `WHOLE` metres around it; 0 where it doesn't."""
    from scan2sim.pipeline.camera.models import inside as within
    from scan2sim.pipeline.camera.models import pixel_angle, project

    R = view.T_world_cam[:3, :3]
    local = (place - view.centre) @ R
    distance = float(np.linalg.norm(local))
    corners = local + WHOLE * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0, 0, 0)])
    uv, valid = project(view.camera, corners)
    if distance < 2 * WHOLE or not (valid & within(view.camera, uv)).all():
        return 0.0
    return 1 / (pixel_angle(view.camera) * distance)


def _close_up(rgb: U8, view: View, place: F64, size: int, fineness: float) -> tuple[F32, F64, float]:
    """A pinhole picture (size, size, 3) that looks at a place, its projection (3, 4), and its focal length."""
    import cv2

    from scan2sim.pipeline.camera.models import project

    ray = place - view.centre
    distance = float(np.linalg.norm(ray))
    forward = ray / distance
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])  # world to the close-up
    focal, middle = fineness * distance, (size - 1) / 2
    row, column = np.mgrid[:size, :size]
    rays = np.stack([(column - middle) / focal, (row - middle) / focal, np.ones((size, size))], axis=-1)
    uv, valid = project(view.camera, rays.reshape(-1, 3) @ R @ view.T_world_cam[:3, :3])
    uv = np.where(valid[:, None], uv, -1e4).reshape(size, size, 2).astype(np.float32)
    picture = cv2.remap(rgb, uv[..., 0], uv[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    K = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    return np.asarray(picture, np.float32), K @ np.column_stack([R, -R @ view.centre]), focal


def fitted(shown: CloseUps, reach: float, normal: F64 | None = None) -> Plate | None:
    """The plate within `reach` metres of the close-ups' middle, and the way it faces; None where there is none.

    Args:
        shown: of the place.
        reach: metres.
        normal: (3,) that the plate faces about, or None: the photos.
    """
    faces = shown.towards if normal is None else normal
    heading = math.atan2(faces[1], faces[0])
    low, high = [*(shown.place - reach), heading - TURN], [*(shown.place + reach), heading + TURN]
    return _clearest(shown, lambda shape, p: p, low, high, TURNS)


def beside(shown: CloseUps, plate: Plate, up: int) -> Plate | None:
    """Another plate in a plate's plane, next above (`up` 1) or below (-1) it; None where there is none."""

    def at(shape: Shape, p: F64) -> F64:
        across, gap, width, height = p.T
        rise = up * (plate.height / 2 + gap + height / 2)
        centre = plate.centre + across[:, None] * plate.across + rise[:, None] * (0, 0, 1)
        return np.column_stack([centre, np.full(len(p), _row(plate)[0, 3]), width, height])

    return _clearest(shown, at, [-ASIDE, -TOUCH], [ASIDE, GAP], (0.0,))


def _clearest(
    shown: CloseUps,
    at: Callable[[Shape, F64], F64],
    low: Sequence[float],
    high: Sequence[float],
    turns: Sequence[float],
) -> Plate | None:
    """The clearest plate of any shape that is there, of the largest that are; None where none is.

    Args:
        shown: of the place.
        at: makes plates as `CloseUps.clear` takes them of parameters (N, K + 2), width and height last.
        low, high: (K,) bounds of the parameters but those.
        turns: radians by which the heading of what is found may be off.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        best = list(pool.map(lambda shape: _best(shown, shape, at, low, high), OUTLINES))
    found = [_outermost(shown, plate, turns) for plate in best if plate is not None and shown.is_there(plate, NEARLY)]
    there = [plate for plate in found if shown.is_there(plate)]
    if not there:
        return None
    largest = max(plate.area for plate in there)
    return max(
        (plate for plate in there if plate.area > AS_LARGE * largest),
        key=lambda plate: float(shown.worth(plate.shape, _row(plate))[0]),
    )


def _best(
    shown: CloseUps, shape: Shape, at: Callable[[Shape, F64], F64], low: Sequence[float], high: Sequence[float]
) -> Plate | None:
    """The clearest plate of a shape, between bounds; None where none is near to be one."""
    from scipy.optimize import differential_evolution, minimize

    sides = 2 if shape == "rectangle" else 1
    low, high = [*low, *[SIZE[0]] * sides], [*high, *[SIZE[1]] * sides]

    def plates(p: F64) -> F64:
        tall = p[:, -1:] if sides == 2 else p[:, -1:] * ASPECT.get(shape, 1.0)
        return at(shape, np.column_stack([p[:, : len(low) - sides], p[:, -sides], tall]))

    def price(p: F64) -> F64:
        return -shown.worth(shape, plates(p.T))

    def one(p: F64) -> float:
        return float(price(p[:, None])[0])

    def hopeless(intermediate_result: OptimizeResult) -> bool:
        best = _of(shape, plates(intermediate_result.x[None])[0])
        return bool(intermediate_result.nit >= MIDWAY and not shown.is_there(best, HOPEFUL))

    bounds = list(zip(low, high, strict=True))
    found = differential_evolution(
        price, bounds, popsize=16, maxiter=GENERATIONS, tol=1e-2, rng=0, polish=False, updating="deferred",
        vectorized=True, callback=hopeless,
    )  # fmt: skip
    if not shown.is_there(_of(shape, plates(found.x[None])[0]), ROUGHLY):
        return None
    finer = minimize(
        one, found.x, method="Nelder-Mead", bounds=bounds, options={"maxiter": 300, "xatol": 1e-3, "fatol": 1e-5}
    )
    return _of(shape, plates(finer.x[None])[0])


def _outermost(shown: CloseUps, plate: Plate, turns: Sequence[float]) -> Plate:
    """A plate, or the largest clear outline around it, as exactly as photos tell, at headings about `turns` off."""
    plate = _nearby(shown, plate, turns)
    for _ in range(RINGS):
        ring = [replace(plate, width=k * plate.width, height=k * plate.height) for k in (0.99, *GROWN)]
        worth = shown.worth(plate.shape, np.concatenate([_row(p) for p in ring]))
        peaks = [k for k in range(1, len(ring) - 1) if worth[k] > max(worth[k - 1], worth[k + 1])]
        larger = (_nearby(shown, ring[k], turns) for k in reversed(peaks))
        found = next((other for other in larger if shown.is_there(other)), None)
        if found is None:
            break
        plate = found
    return plate


def _nearby(shown: CloseUps, plate: Plate, turns: Sequence[float]) -> Plate:
    """The clearest plate about as large as one, near it; in its plane where it is not to be turned."""
    from scipy.optimize import minimize

    row, free = _row(plate)[0], float(any(turns))
    axes = np.stack([plate.across, np.array([0.0, 0.0, 1.0]), free * plate.normal])

    def at(p: F64) -> F64:
        wider, higher = np.exp([p[4], p[5] if plate.shape == "rectangle" else p[4]])
        return np.array([*(row[:3] + p[:3] @ axes), row[3] + free * p[3], row[4] * wider, row[5] * higher])

    def price(p: F64) -> float:
        alike = np.abs(p[4:]).max() < ALIKE_SIZE and np.abs(p[:3]).max() < ALIKE_PLACE
        return -float(shown.worth(plate.shape, at(p)[None], FINE)[0]) if alike else 1e9

    steps = np.concatenate([np.zeros((1, 6)), np.diag([0.02, 0.02, 0.03, 0.1, 0.03, 0.03])])
    starts = [steps + (0, 0, 0, turn, 0, 0) for turn in turns]
    found = [
        minimize(price, s[0], method="Nelder-Mead", options={"initial_simplex": s, "maxiter": 400}) for s in starts
    ]
    return _of(plate.shape, at(min(found, key=lambda one: float(one.fun)).x))


def _of(shape: Shape, row: F64) -> Plate:
    """The plate of a row (6,) as `CloseUps.clear` takes it."""
    x, y, z, heading, width, height = row.tolist()
    return Plate(np.array([x, y, z]), np.array([math.cos(heading), math.sin(heading), 0.0]), shape, width, height)


def _row(plate: Plate) -> F64:
    """(1, 6) of a plate, as `CloseUps.clear` takes it."""
    heading = math.atan2(plate.normal[1], plate.normal[0])
    return np.array([[*plate.centre, heading, plate.width, plate.height]], np.float64)


@cache
def _samples(shape: Shape) -> tuple[F64, F64]:
    """Of an outline of half-size 1: places (S, 2), along it, along it once more, and over the face; and ways out."""
    corners = OUTLINES[shape]
    edge = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(edge, axis=1)
    first = np.concatenate([[0], np.cumsum(length)])
    t = (np.arange(RIM) + 0.5) / RIM * first[-1]
    k = np.searchsorted(first, t, side="right") - 1
    rim, out = corners[k] + ((t - first[k]) / length[k])[:, None] * edge[k], np.column_stack([edge[k, 1], -edge[k, 0]])
    grid = np.stack(np.meshgrid(*(np.linspace(-0.9, 0.9, 11),) * 2), axis=-1).reshape(-1, 2)
    face = grid[inside(grid, corners, -0.08)]
    return np.concatenate([rim, rim, face]), np.concatenate([-out, out, np.zeros_like(face)])


@njit(cache=True, nogil=True)
def _clear(
    pictures: F32, project: F64, focal: F64, plates: F64, flat: F64, out: F64, rim: int, off: float, noise: float
) -> F64:
    """`CloseUps.clear`; `flat` and `out` are of `_samples`."""
    rated = np.zeros((len(plates), 3))
    seen, mean, edge = np.empty((len(pictures), len(flat), 3)), np.empty((len(flat), 3)), np.empty(rim)
    for n in range(len(plates)):
        if _sample_photos(pictures, project, focal, plates, n, flat, out, rim, off, seen):
            rated[n, 0], rated[n, 1], rated[n, 2] = _rate(seen, mean, edge, noise)
    return rated


@njit(cache=True, nogil=True)
def _sample_photos(
    pictures: F32, project: F64, focal: F64, plates: F64, n: int, flat: F64, out: F64, rim: int, off: float, seen: F64
) -> bool:
    """Colours (J, S, 3) into `seen` at `_samples` of a plate (6,), its rim's `off` pixels in and out.

    False where a picture doesn't show them all.
    """
    height, width = pictures.shape[1:3]
    x, y, z, wide, tall = plates[n, 0], plates[n, 1], plates[n, 2], plates[n, 4], plates[n, 5]
    right, ahead = -math.sin(plates[n, 3]), math.cos(plates[n, 3])
    for j in range(len(pictures)):
        # not by `pipeline.camera.projection`: places of a plane are linear in a and b, which saves most of the products
        # a place a across and b up from the middle is at pixel (u + a ua + b ub, v + ...) / (w + ...)
        u = project[j, 0, 0] * x + project[j, 0, 1] * y + project[j, 0, 2] * z + project[j, 0, 3]
        v = project[j, 1, 0] * x + project[j, 1, 1] * y + project[j, 1, 2] * z + project[j, 1, 3]
        w = project[j, 2, 0] * x + project[j, 2, 1] * y + project[j, 2, 2] * z + project[j, 2, 3]
        ua, ub = project[j, 0, 0] * right + project[j, 0, 1] * ahead, project[j, 0, 2]
        va, vb = project[j, 1, 0] * right + project[j, 1, 1] * ahead, project[j, 1, 2]
        wa, wb = project[j, 2, 0] * right + project[j, 2, 1] * ahead, project[j, 2, 2]
        step = off * w / focal[j]
        for i in range(len(flat)):
            a, b = flat[i, 0] * wide / 2, flat[i, 1] * tall / 2
            if i < 2 * rim:
                p, q = out[i, 0] / wide, out[i, 1] / tall
                scale = step / math.sqrt(p * p + q * q)
                a, b = a + scale * p, b + scale * q
            depth = w + a * wa + b * wb
            if depth < 0.3:
                return False
            column, row = (u + a * ua + b * ub) / depth, (v + a * va + b * vb) / depth
            if not (column >= 0 and row >= 0 and column < width - 1 and row < height - 1):
                return False
            # not by `pipeline.camera.image_sampling`, which looks after borders that are far from here: 15 % slower
            c, r = int(column), int(row)
            s, t = column - c, row - r
            for k in range(3):
                upper = pictures[j, r, c, k] * (1 - s) + pictures[j, r, c + 1, k] * s
                lower = pictures[j, r + 1, c, k] * (1 - s) + pictures[j, r + 1, c + 1, k] * s
                seen[j, i, k] = upper * (1 - t) + lower * t
    return True


@njit(cache=True, nogil=True)
def _rate(seen: F64, mean: F64, edge: F64, noise: float) -> tuple[float, float, float]:
    """As `CloseUps.clear`, of colours (J, S, 3): just inside of the rim, just outside, and the face's.

    `mean` (S, 3) and `edge` (rim,) are room to work in.
    """
    count, places, _ = seen.shape
    rim = len(edge)
    within, apart = 0.0, 0.0
    for k in range(3):
        whole = 0.0
        for i in range(places):
            total = 0.0
            for j in range(count):
                total += seen[j, i, k]
            mean[i, k] = total / count
            if i >= 2 * rim:
                whole += mean[i, k] / (places - 2 * rim)
        for i in range(2 * rim, places):
            within += (mean[i, k] - whole) ** 2 + noise**2
            for j in range(count):
                apart += (seen[j, i, k] - mean[i, k]) ** 2 / count
    for i in range(rim):
        contrast, spread = 0.0, 0.0
        for j in range(count):
            across, own = 0.0, 0.0
            for k in range(3):
                across += (seen[j, i, k] - seen[j, rim + i, k]) ** 2
                own += (seen[j, i, k] - mean[i, k]) ** 2
            contrast += math.sqrt(across) / count
            spread += own / count
        edge[i] = contrast / (contrast + math.sqrt(spread) + 3 * noise)
    edge.sort()
    return edge.mean(), edge[: rim // 4].mean(), within / (within + apart)
