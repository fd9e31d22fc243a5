"""Lamps: fits an arm, and the lamp head at its end as a box, to the points near the top of a tall pole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.furniture.poles import Stem
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.geometry.primitives import Triangles


@dataclass(frozen=True)
class LampLimits:
    """Thresholds of lamp detection."""

    min_pole_height_m: float = 3.5
    arm_length_m: tuple[float, float] = (0.4, 3.5)  # minimum and maximum
    max_excess_m: float = 0.5  # beyond the maximum length: points that show that something longer is no arm
    max_below_top_m: float = 1.0  # arm relative to the top of the pole
    max_above_top_m: float = 1.5
    max_point_gap_m: float = 0.2  # between points of the arm
    max_pole_gap_m: float = 0.4  # between the arm and the top of the pole
    max_width_m: float = 0.5  # of the arm with its lamp head
    section_m: float = 0.2  # length of a section of the arm with a centre of its own
    min_head_width_m: float = 0.1  # wider sections belong to the lamp head
    min_points: int = 30


LAMP = LampLimits()


@dataclass(frozen=True)
class Arm:
    """The arm of a lamp, with or without a lamp head.

    Attributes:
        path: (K, 3) axis of the arm from the pole outwards, local metres.
        radius: radius of the arm, metres.
        box: (3,) centre and (3,) half extents (along, across, up) of the lamp head, or None.
    """

    path: F64
    radius: float
    box: tuple[F64, F64] | None

    @property
    def direction(self) -> F64:
        """Unit vector (2,) outwards, in plan view."""
        d = self.path[-1, :2] - self.path[0, :2]
        return np.asarray(d / np.linalg.norm(d))

    @property
    def axes(self) -> F64:
        """Axes (3, 3) of the box: rows along, across and up."""
        along = np.array([*self.direction, 0.0])
        return np.array([along, np.cross([0, 0, 1.0], along), [0, 0, 1.0]])

    def moved(self, by: F64) -> Arm:
        """The arm translated by (3,) metres."""
        box = None if self.box is None else (self.box[0] + by, self.box[1])
        return replace(self, path=self.path + by, box=box)

    def to_json(self) -> dict[str, Any]:
        """JSON object, the inverse of `from_json`."""
        box = None if self.box is None else [part.tolist() for part in self.box]
        return {"path": self.path.tolist(), "radius": self.radius, "box": box}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Arm:
        """Read the result of `to_json`."""
        box = None if row["box"] is None else (np.array(row["box"][0]), np.array(row["box"][1]))
        return cls(np.array(row["path"], np.float64), row["radius"], box)

    def contains(self, xyz: npt.NDArray[np.floating], margin: float) -> Bools:
        """(N,) bool, True for points that belong to the arm, within `margin` metres of it."""
        own = np.zeros(len(xyz), bool)
        for a, b in pairwise(self.path):
            d = b - a
            t = np.clip((xyz - a) @ d / max(float(d @ d), 1e-9), 0, 1)
            own |= np.linalg.norm(xyz - a - t[:, None] * d, axis=1) < self.radius + margin
        if self.box is not None:
            centre, half = self.box
            own |= (np.abs((xyz - centre) @ self.axes.T) < half + margin).all(axis=1)
        return own

    def meshes(self) -> list[Triangles]:
        """Meshes of the tube and the box."""
        parts = [primitives.tube(self.path, np.full(len(self.path), self.radius), 6)]
        return parts + ([] if self.box is None else [primitives.box(self.box[0], self.axes, self.box[1])])


def fit_arm(stem: Stem, ground: float, xyz: F64, leafy: Bools) -> Arm | None:
    """Fit an arm to the points near the top of a pole; None if there is none.

    Args:
        stem: the pole.
        ground: z at its foot, metres.
        xyz: (N, 3) points around it, including those of the pole.
        leafy: (N,) bool, True for vegetation.
    """
    top = stem.centre[-1]
    if top[2] - ground < LAMP.min_pole_height_m:
        return None
    d = xyz - top
    off = np.hypot(*d[:, :2].T)
    max_off = LAMP.arm_length_m[1] + LAMP.max_excess_m
    near = (off < max_off) & (d[:, 2] > -LAMP.max_below_top_m) & (d[:, 2] < LAMP.max_above_top_m) & ~leafy
    near &= stem.distance(xyz) > max(0.04, 3 * stem.spread)
    piece = _connected_to_top(xyz[near], top)
    own = d[near][piece]
    if len(own) < LAMP.min_points:
        return None
    middle = own[:, :2].mean(axis=0)
    if np.linalg.norm(middle) < LAMP.arm_length_m[0] / 3:
        return None
    along = middle / np.linalg.norm(middle)
    out, aside = own[:, :2] @ along, own[:, :2] @ np.array([-along[1], along[0]])
    length = float(np.percentile(out, 99))
    if (
        not LAMP.arm_length_m[0] < length < LAMP.arm_length_m[1]
        or np.ptp(np.percentile(aside, [2, 98])) > LAMP.max_width_m
    ):
        return None
    return _fit_arm_and_head(top, along, np.column_stack([out, aside, own[:, 2]]), length)


def _connected_to_top(xyz: F64, top: F64) -> Bools:
    """(N,) bool, True for points of components that reach the top of the pole."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(xyz):
        return np.zeros(0, bool)
    pairs = cKDTree(xyz).query_pairs(LAMP.max_point_gap_m, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(xyz),) * 2)
    _, piece = connected_components(links, directed=False)
    near = np.hypot(*(xyz - top)[:, :2].T) < LAMP.max_pole_gap_m
    return np.isin(piece, piece[near])


def _fit_arm_and_head(top: F64, along: F64, own: F64, length: float) -> Arm | None:
    """Arm and lamp head fitted to points (N, 3): outwards, sideways and up from the top of the pole.

    None if no section of the arm has enough points.
    """
    count = max(2, int(length / LAMP.section_m))
    edges = np.linspace(0, length, count + 1)
    parts = [own[(own[:, 0] >= a) & (own[:, 0] <= b)] for a, b in pairwise(edges.tolist())]
    parts = [part for part in parts if len(part) >= 3]
    if not parts:
        return None
    middles = np.array([np.median(part, axis=0) for part in parts])
    across = np.array([np.ptp(np.percentile(part[:, 1], [10, 90])) for part in parts])
    wide = across > LAMP.min_head_width_m
    first = len(parts)
    while first > 0 and wide[first - 1]:
        first -= 1
    box = None
    axes = np.array([[*along, 0], [-along[1], along[0], 0], [0, 0, 1.0]])
    if 0 < first < len(parts):
        head = np.concatenate(parts[first:])
        low, high = np.percentile(head, [2, 98], axis=0)
        half = np.maximum((high - low) / 2, 0.02)
        box = top + (low + high) / 2 @ axes, half
    stretch = middles[: max(first, 1)] if box is not None else middles
    path = np.concatenate([[top], top + stretch @ axes])
    if box is not None:
        path = np.concatenate([path, [box[0]]])
    radius = float(np.clip(np.median(across[: max(first, 1)]) / 1.6, 0.02, 0.06))
    return Arm(path, radius, box)
