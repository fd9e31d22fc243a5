"""Plates: small, thin, upright sheets such as traffic signs, found among points and outlined.

A plate's plane is a line on the ground plan, by RANSAC (Fischler and Bolles 1981); its outline is the one of a few
shapes that its points fill and don't leave.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I64, Bools

Shape = Literal["rectangle", "disc", "octagon", "triangle", "triangle_down", "diamond"]

THIN = 0.04
"""Metres that points may lie beside their plate: noise of a range, and of poses between two drives."""
SIZE = (0.2, 1.5)
"""Metres across and high, at least and at most."""
CLOSE = 0.08
"""Metres between points of one plate at most."""
FEWEST = 25
"""Points of a plate."""
FULL = 0.7
"""Share of its outline that a plate's points fill at least."""
TRIALS = 200

OUTLINES: dict[Shape, F64] = {
    "rectangle": np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], np.float64),
    "disc": np.column_stack([np.cos(a := np.arange(20) * np.pi / 10), np.sin(a)]) / np.cos(np.pi / 20) ** 0.5,
    "octagon": np.column_stack([np.cos(a := np.arange(0.5, 8) * np.pi / 4), np.sin(a)]) / np.cos(np.pi / 8),
    "triangle": np.array([(-1, -1), (1, -1), (0, 1)], np.float64),
    "triangle_down": np.array([(0, -1), (1, 1), (-1, 1)], np.float64),
    "diamond": np.array([(0, -1), (1, 0), (0, 1), (-1, 0)], np.float64),
}
"""Corners counter-clockwise, in halves of the width and height."""
ASPECT: dict[Shape, float] = {"triangle": 0.866, "triangle_down": 0.866}
"""Height by width of signs of a shape, where that isn't 1; rectangles have any."""


@dataclass(frozen=True)
class Plate:
    """An upright sheet.

    Attributes:
        centre: (3,) middle of its bounds, local metres.
        normal: (3,) unit and level, to where it was seen from.
        shape: of its outline.
        width, height: metres.
    """

    centre: F64
    normal: F64
    shape: Shape
    width: float
    height: float

    @property
    def across(self) -> F64:
        """(3,) unit, level, to the right of who looks at its face."""
        return np.array([-self.normal[1], self.normal[0], 0.0])

    @property
    def outline(self) -> F64:
        """(K, 2) corners across and up from the centre, metres, counter-clockwise for who looks at its face."""
        return OUTLINES[self.shape] * (self.width / 2, self.height / 2)

    @property
    def area(self) -> float:
        """Square metres."""
        (x, y), (u, v) = self.outline.T, np.roll(self.outline, -1, axis=0).T
        return float((x * v - u * y).sum() / 2)

    def moved(self, by: F64) -> Plate:
        """It by (3,) metres elsewhere."""
        return replace(self, centre=self.centre + by)

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        return {
            "centre": self.centre.tolist(), "normal": self.normal.tolist(), "shape": self.shape,
            "width": self.width, "height": self.height,
        }  # fmt: skip

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Plate:
        """What `to_json` told."""
        centre, normal = np.array(row["centre"], np.float64), np.array(row["normal"], np.float64)
        return cls(centre, normal, row["shape"], row["width"], row["height"])

    def holds(self, xyz: npt.NDArray[np.floating], margin: float, thin: float) -> Bools:
        """(N,) which points lie within its outline and `margin`, and not further than `thin` from its plane."""
        d = np.asarray(xyz, np.float64) - self.centre
        flat = np.column_stack([d @ self.across, d[:, 2]])
        return (np.abs(d @ self.normal) < thin) & inside(flat, self.outline, margin)


def plates(xyz: F64, bare: Bools, viewer: F64, most: int = 4) -> list[Plate]:
    """All plates among a few thousand points, the largest first.

    Args:
        xyz: (N, 3) local metres.
        bare: (N,) which of them are no pole's; where these lie on both sides of the others, those are the plate's, too.
        viewer: (2,) from where they were seen, on the ground plan.
        most: so many planes are looked at.
    """
    found: list[Plate] = []
    free = bare.copy()
    for _ in range(most):
        line = _plane(xyz[free, :2]) if free.sum() >= FEWEST else None
        if line is None:
            break
        middle, along = line
        near = np.flatnonzero(_beside(xyz[:, :2], middle[None], along[None])[0] < THIN)
        flat = np.column_stack([(xyz[near, :2] - middle) @ along, xyz[near, 2]])
        kept = free[near] | (~bare[near] & _flanked(flat, bare[near]))
        piece = np.flatnonzero(kept)[_largest(flat[kept])]
        plate = _outlined(flat[piece], middle, along, viewer)
        if plate is not None:
            found.append(plate)
        free[near[piece]] = False
    return sorted(found, key=lambda plate: -plate.width * plate.height)


def _flanked(flat: F64, bare: Bools) -> Bools:
    """(N,) at which points bare ones lie on both sides at the same height, of places (N, 2) across and up."""
    if bare.all():
        return bare
    pole = float(np.median(flat[~bare, 0]))
    level = np.floor((flat[:, 1] - flat[:, 1].min()) / CLOSE).astype(np.int64)
    left, right = (np.bincount(level[bare & side], minlength=level.max() + 1) > 0
                   for side in (flat[:, 0] < pole, flat[:, 0] > pole))  # fmt: skip
    return np.asarray((left & right)[level])


def _plane(xy: F64) -> tuple[F64, F64] | None:
    """A place (2,) and the direction (2,) of the line that most points lie near, of lines through two a plate apart."""
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, len(xy), (2, TRIALS))
    along = xy[b] - xy[a]
    length = np.hypot(*along.T)
    good = (length > SIZE[0] / 2) & (length < SIZE[1])
    a, along = a[good], along[good] / length[good, None]
    if not len(a):
        return None
    some = xy[:: max(1, len(xy) // 2000)]
    best = int((_beside(some, xy[a], along) < THIN / 2).sum(axis=1).argmax())
    middle, way = xy[a[best]], along[best]
    for _ in range(3):
        near = _beside(xy, middle[None], way[None])[0] < THIN
        if near.sum() < FEWEST:
            return None
        middle, way = _line(xy[near])
    return middle, way


def _beside(xy: F64, middle: F64, along: F64) -> F64:
    """(L, N) metres of points (N, 2) from lines through (L, 2) along (L, 2), unit."""
    d = xy[None] - middle[:, None]
    return np.abs(d[..., 0] * along[:, None, 1] - d[..., 1] * along[:, None, 0])


def _line(xy: F64) -> tuple[F64, F64]:
    """Middle (2,) and direction (2,) of points."""
    middle = xy.mean(axis=0)
    along = np.linalg.svd(xy - middle, full_matrices=False)[2][0]
    return middle, along


def _largest(flat: F64) -> I64:
    """Indices of the largest connected piece of points (N, 2)."""
    from scipy import ndimage

    cell = np.floor((flat - flat.min(axis=0)) / CLOSE).astype(np.int64)
    held = np.zeros(cell.max(axis=0) + 1, bool)
    held[cell[:, 0], cell[:, 1]] = True
    part, _ = ndimage.label(held, np.ones((3, 3)))
    of = part[cell[:, 0], cell[:, 1]]
    return np.flatnonzero(of == np.bincount(of).argmax())


def _outlined(flat: F64, middle: F64, along: F64, viewer: F64) -> Plate | None:
    """The plate of points (N, 2) along and up its plane; None where they are too few, too large or no shape's."""
    from scipy.spatial import cKDTree

    if len(flat) < FEWEST:
        return None
    low, high = np.percentile(flat, [1, 99], axis=0)
    if not ((high - low > SIZE[0]) & (high - low < SIZE[1])).all():
        return None
    tree = cKDTree(flat)
    best: tuple[float, Shape, float, F64, F64] | None = None
    for shape, (grid, first, last) in _filled().items():
        half = (high - low) / (last - first)
        centre = low - first * half
        full = float((tree.query(grid * half + centre)[0] < CLOSE).mean())
        held = float(inside((flat - centre) / half, OUTLINES[shape], 0.08).mean())
        if best is None or full * held**2 > best[0]:
            best = full * held**2, shape, full, centre, 2 * half
    assert best is not None
    _, shape, full, centre, size = best
    if full < FULL:
        return None
    place = middle + centre[0] * along
    normal = np.array([along[1], -along[0]])
    normal *= 1.0 if (viewer - place) @ normal > 0 else -1.0
    return Plate(np.array([*place, centre[1]]), np.array([*normal, 0.0]), shape, float(size[0]), float(size[1]))


@cache
def _filled() -> dict[Shape, tuple[F64, F64, F64]]:
    """Of each outline: places evenly over it (N, 2), and (2,) below which 1 % of them lie, and above which."""
    grid = np.stack(np.meshgrid(*(np.linspace(-1, 1, 41),) * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    # points can't tell an octagon from a disc
    candidates = {shape: corners for shape, corners in OUTLINES.items() if shape != "octagon"}
    within = {shape: grid[inside(grid, corners, 1e-9)] for shape, corners in candidates.items()}
    return {shape: (places[::3], *np.percentile(places, [1, 99], axis=0)) for shape, places in within.items()}


def inside(flat: F64, corners: F64, margin: float) -> Bools:
    """(N,) whether points (N, 2) lie in a convex outline (K, 2), counter-clockwise, grown by a margin."""
    edge = np.roll(corners, -1, axis=0) - corners
    out = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.linalg.norm(edge, axis=1)[:, None]
    return np.asarray(((flat @ out.T - np.einsum("kc,kc->k", corners, out)) <= margin).all(axis=1))
