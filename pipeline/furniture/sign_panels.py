"""Sign panels: detection of small, thin, upright sheets such as traffic signs in points, and their outline.

The plane of a panel is a line in plan view, found by RANSAC (Fischler and Bolles 1981). Its outline is the one of a
few shapes that contains the points and is filled by them.
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

PANEL_PLANE_DISTANCE_M = 0.04
"""Largest distance of a point from its panel: range noise, and pose errors between two drives."""
PANEL_SIZE_M = (0.2, 1.5)
"""Minimum and maximum width and height."""
PANEL_POINT_GAP_M = 0.08
"""Largest gap between points of one panel."""
PANEL_MIN_POINTS = 25
PANEL_MIN_FILL = 0.7
"""Minimum fraction of the outline that is covered by points."""
RANSAC_TRIALS = 200

OUTLINES: dict[Shape, F64] = {
    "rectangle": np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], np.float64),
    "disc": np.column_stack([np.cos(a := np.arange(20) * np.pi / 10), np.sin(a)]) / np.cos(np.pi / 20) ** 0.5,
    "octagon": np.column_stack([np.cos(a := np.arange(0.5, 8) * np.pi / 4), np.sin(a)]) / np.cos(np.pi / 8),
    "triangle": np.array([(-1, -1), (1, -1), (0, 1)], np.float64),
    "triangle_down": np.array([(0, -1), (1, 1), (-1, 1)], np.float64),
    "diamond": np.array([(0, -1), (1, 0), (0, 1), (-1, 0)], np.float64),
}
"""Corners, counter-clockwise, relative to half the width and half the height."""
ASPECT: dict[Shape, float] = {"triangle": 0.866, "triangle_down": 0.866}
"""Ratio of height to width of shapes with a fixed ratio other than 1; rectangles have any."""


@dataclass(frozen=True)
class SignPanel:
    """An upright planar sheet, such as a traffic sign.

    Attributes:
        centre: (3,) centre of its bounds, local metres.
        normal: (3,) horizontal unit vector towards the viewer.
        shape: shape of its outline.
        width, height: metres.
    """

    centre: F64
    normal: F64
    shape: Shape
    width: float
    height: float

    @property
    def across(self) -> F64:
        """Horizontal unit vector (3,) to the right, as seen from the front."""
        return np.array([-self.normal[1], self.normal[0], 0.0])

    @property
    def outline(self) -> F64:
        """Corners (K, 2) across and up from the centre, metres, counter-clockwise as seen from the front."""
        return OUTLINES[self.shape] * (self.width / 2, self.height / 2)

    @property
    def area(self) -> float:
        """Area in m2."""
        (x, y), (u, v) = self.outline.T, np.roll(self.outline, -1, axis=0).T
        return float((x * v - u * y).sum() / 2)

    def moved(self, by: F64) -> SignPanel:
        """The panel translated by (3,) metres."""
        return replace(self, centre=self.centre + by)

    def to_json(self) -> dict[str, Any]:
        """JSON object, the inverse of `from_json`."""
        return {
            "centre": self.centre.tolist(), "normal": self.normal.tolist(), "shape": self.shape,
            "width": self.width, "height": self.height,
        }  # fmt: skip

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> SignPanel:
        """Read the result of `to_json`."""
        centre, normal = np.array(row["centre"], np.float64), np.array(row["normal"], np.float64)
        return cls(centre, normal, row["shape"], row["width"], row["height"])

    def contains(self, xyz: npt.NDArray[np.floating], margin: float, max_distance: float) -> Bools:
        """(N,) bool, True for points inside its outline plus `margin` and within `max_distance` of its plane (m)."""
        d = np.asarray(xyz, np.float64) - self.centre
        flat = np.column_stack([d @ self.across, d[:, 2]])
        return (np.abs(d @ self.normal) < max_distance) & inside(flat, self.outline, margin)


def detect_panels(xyz: F64, free: Bools, viewer: F64, max_panels: int = 4) -> list[SignPanel]:
    """Detect all sign panels among a few thousand points, the largest first.

    Args:
        xyz: (N, 3) local metres.
        free: (N,) bool, False for points of the pole; pole points with free points on both sides belong to the panel.
        viewer: (2,) position of the scanner in plan view.
        max_panels: maximum number of planes to try.
    """
    found: list[SignPanel] = []
    unused = free.copy()
    for _ in range(max_panels):
        line = _dominant_line(xyz[unused, :2]) if unused.sum() >= PANEL_MIN_POINTS else None
        if line is None:
            break
        middle, along = line
        near = np.flatnonzero(_line_distances(xyz[:, :2], middle[None], along[None])[0] < PANEL_PLANE_DISTANCE_M)
        flat = np.column_stack([(xyz[near, :2] - middle) @ along, xyz[near, 2]])
        kept = unused[near] | (~free[near] & _flanked(flat, free[near]))
        piece = np.flatnonzero(kept)[_largest_piece(flat[kept])]
        panel = _fit_outline(flat[piece], middle, along, viewer)
        if panel is not None:
            found.append(panel)
        unused[near[piece]] = False
    return sorted(found, key=lambda panel: -panel.width * panel.height)


def _flanked(flat: F64, free: Bools) -> Bools:
    """(N,) bool, True for points (N, 2) (across, up) with free points on both sides of the pole at the same height."""
    if free.all():
        return free
    pole = float(np.median(flat[~free, 0]))
    level = np.floor((flat[:, 1] - flat[:, 1].min()) / PANEL_POINT_GAP_M).astype(np.int64)
    left, right = (np.bincount(level[free & side], minlength=level.max() + 1) > 0
                   for side in (flat[:, 0] < pole, flat[:, 0] > pole))  # fmt: skip
    return np.asarray((left & right)[level])


def _dominant_line(xy: F64) -> tuple[F64, F64] | None:
    """Point (2,) and direction (2,) of the line near most points (RANSAC on pairs of points at a panel's distance)."""
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, len(xy), (2, RANSAC_TRIALS))
    along = xy[b] - xy[a]
    length = np.hypot(*along.T)
    good = (length > PANEL_SIZE_M[0] / 2) & (length < PANEL_SIZE_M[1])
    a, along = a[good], along[good] / length[good, None]
    if not len(a):
        return None
    sample = xy[:: max(1, len(xy) // 2000)]
    best = int((_line_distances(sample, xy[a], along) < PANEL_PLANE_DISTANCE_M / 2).sum(axis=1).argmax())
    middle, direction = xy[a[best]], along[best]
    for _ in range(3):
        near = _line_distances(xy, middle[None], direction[None])[0] < PANEL_PLANE_DISTANCE_M
        if near.sum() < PANEL_MIN_POINTS:
            return None
        middle, direction = _principal_line(xy[near])
    return middle, direction


def _line_distances(xy: F64, middle: F64, along: F64) -> F64:
    """Distances (L, N) in metres of points (N, 2) from lines through (L, 2) along unit vectors (L, 2)."""
    d = xy[None] - middle[:, None]
    return np.abs(d[..., 0] * along[:, None, 1] - d[..., 1] * along[:, None, 0])


def _principal_line(xy: F64) -> tuple[F64, F64]:
    """Mean (2,) and principal direction (2,) of points."""
    middle = xy.mean(axis=0)
    along = np.linalg.svd(xy - middle, full_matrices=False)[2][0]
    return middle, along


def _largest_piece(flat: F64) -> I64:
    """Indices of the largest connected component of points (N, 2)."""
    from scipy import ndimage

    cell = np.floor((flat - flat.min(axis=0)) / PANEL_POINT_GAP_M).astype(np.int64)
    held = np.zeros(cell.max(axis=0) + 1, bool)
    held[cell[:, 0], cell[:, 1]] = True
    part, _ = ndimage.label(held, np.ones((3, 3)))
    of = part[cell[:, 0], cell[:, 1]]
    return np.flatnonzero(of == np.bincount(of).argmax())


def _fit_outline(flat: F64, middle: F64, along: F64, viewer: F64) -> SignPanel | None:
    """Panel fitted to points (N, 2) (along the plane, up); None if too few, too large, or of no known shape."""
    from scipy.spatial import cKDTree

    if len(flat) < PANEL_MIN_POINTS:
        return None
    low, high = np.percentile(flat, [1, 99], axis=0)
    if not ((high - low > PANEL_SIZE_M[0]) & (high - low < PANEL_SIZE_M[1])).all():
        return None
    tree = cKDTree(flat)
    best: tuple[float, Shape, float, F64, F64] | None = None
    for shape, (grid, first, last) in _outline_grids().items():
        half = (high - low) / (last - first)
        centre = low - first * half
        full = float((tree.query(grid * half + centre)[0] < PANEL_POINT_GAP_M).mean())
        held = float(inside((flat - centre) / half, OUTLINES[shape], 0.08).mean())
        if best is None or full * held**2 > best[0]:
            best = full * held**2, shape, full, centre, 2 * half
    assert best is not None
    _, shape, full, centre, size = best
    if full < PANEL_MIN_FILL:
        return None
    place = middle + centre[0] * along
    normal = np.array([along[1], -along[0]])
    normal *= 1.0 if (viewer - place) @ normal > 0 else -1.0
    return SignPanel(np.array([*place, centre[1]]), np.array([*normal, 0.0]), shape, float(size[0]), float(size[1]))


@cache
def _outline_grids() -> dict[Shape, tuple[F64, F64, F64]]:
    """Per outline: a regular grid of points inside it (N, 2), and their 1st and 99th percentiles (2,)."""
    grid = np.stack(np.meshgrid(*(np.linspace(-1, 1, 41),) * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    # an octagon and a disc can't be distinguished in points
    candidates = {shape: corners for shape, corners in OUTLINES.items() if shape != "octagon"}
    within = {shape: grid[inside(grid, corners, 1e-9)] for shape, corners in candidates.items()}
    return {shape: (places[::3], *np.percentile(places, [1, 99], axis=0)) for shape, places in within.items()}


def inside(flat: F64, corners: F64, margin: float) -> Bools:
    """(N,) whether points (N, 2) lie inside a convex outline (K, 2), counter-clockwise, dilated by a margin."""
    edge = np.roll(corners, -1, axis=0) - corners
    out = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.linalg.norm(edge, axis=1)[:, None]
    return np.asarray(((flat @ out.T - np.einsum("kc,kc->k", corners, out)) <= margin).all(axis=1))
