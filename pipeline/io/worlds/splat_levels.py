"""Levels of detail of splats: a quadtree whose leaves hold all splats, and whose parents hold merged ones.

Splats of a parent are those of its children, merged within the cells of a grid. A merged splat has the mean and the
covariance of its members, weighted by opacity times surface, and an opacity that keeps the sum of these weights: Kerbl
et al., "A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very Large Datasets", SIGGRAPH 2024,
section 4.1. There the opacity may exceed 1 where members overlap; here the splat grows instead, as files end at 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.core.types import F64, I64, Bools

MAX_SPLATS = 50_000
"""Maximum number of splats of a level, unless its cell is at its smallest."""
COARSEST_SPLATS = 1_000
"""Maximum number of splats of the root."""
MIN_CELL_M = 1.0
"""Side of a cell at which it isn't divided any further."""
MERGED_SHARE = 0.25
"""Maximum number of splats of a parent, relative to all of its children: half of the resolution."""
FINEST_SPACING_M = 0.01
"""Smallest cell of the grid."""
SPACING_STEP = 2**0.5
"""Ratio of the spacings that are tried."""
MAX_GROWTH = 2.0
"""Maximum ratio by which a merged splat grows where its members overlap."""
MAX_OPACITY = 0.99
"""Maximum opacity of a merged splat."""
THINNEST_M = 1e-4
"""Minimum standard deviation of a merged splat."""
BOX_DEVIATIONS = 3.0
"""Standard deviations of a splat that belong to its bounding box."""


@dataclass(frozen=True)
class SplatLevel:
    """A level of detail.

    Attributes:
        splats: its N splats.
        spacing: side in metres of the cells within which splats were merged; 0 for leaves.
        finer: levels that together show the same more finely; empty for leaves.
    """

    splats: Splats
    spacing: float = 0.0
    finer: tuple[SplatLevel, ...] = ()

    def leaves(self) -> Iterator[SplatLevel]:
        """The finest levels."""
        if not self.finer:
            yield self
        for level in self.finer:
            yield from level.leaves()


def levels(splats: Splats, max_splats: int = MAX_SPLATS) -> SplatLevel:
    """The root of the levels of N > 0 splats, z up; leaves have at most `max_splats`."""
    xy = splats.xyz[:, :2].astype(np.float64)
    low = xy.min(axis=0)
    root = _cell(splats, low, float((xy.max(axis=0) - low).max()), max_splats)
    while len(root.splats) > COARSEST_SPLATS:
        root = _parent((root,), max_splats)
    return root


def bounds(splats: Splats) -> tuple[F64, F64]:
    """Lowest and highest corner (3,) of N > 0 splats, with `BOX_DEVIATIONS` around their centres."""
    reach = BOX_DEVIATIONS * np.sqrt(np.diagonal(splats.covariance, axis1=1, axis2=2))
    return (splats.xyz - reach).min(axis=0), (splats.xyz + reach).max(axis=0)


def _cell(splats: Splats, low: F64, side: float, max_splats: int) -> SplatLevel:
    """The level of the splats in a square cell with its lowest corner (2,) at `low`."""
    if len(splats) <= max_splats or side <= MIN_CELL_M:
        return SplatLevel(splats)
    half = side / 2
    quadrant = (splats.xyz[:, :2] >= low + half) @ (1, 2)
    finer = tuple(
        _cell(Splats(splats.parameters[quadrant == k]), low + (k % 2 * half, k // 2 * half), half, max_splats)
        for k in np.unique(quadrant).tolist()
    )
    return finer[0] if len(finer) == 1 else _parent(finer, max_splats)


def _parent(finer: tuple[SplatLevel, ...], max_splats: int) -> SplatLevel:
    """A level with the merged splats of finer ones, in the finest grid with which they are few enough."""
    whole = Splats(np.concatenate([level.splats.parameters for level in finer]))
    spacing = SPACING_STEP * max(FINEST_SPACING_M, *(level.spacing for level in finer))
    while (cells := _cells(whole, spacing)).max() >= min(max_splats, max(1, MERGED_SHARE * len(whole))):
        spacing *= SPACING_STEP
    return SplatLevel(merge(whole, cells), spacing, finer)


def _cells(splats: Splats, spacing: float) -> I64:
    """Group (N,) of each splat: its cell in a grid; splats as large as a cell are a group of their own."""
    group = np.zeros(len(splats), np.int64)
    small = splats.scale.max(axis=1) < spacing
    cell = np.floor((splats.xyz[small] - splats.xyz.min(axis=0)) / spacing).astype(np.int64)
    _, group[small] = np.unique(cell @ (1, 2**21, 2**42), return_inverse=True)
    group[~small] = group[small].max(initial=-1) + 1 + np.arange(np.count_nonzero(~small))
    return group


def merge(splats: Splats, group: I64) -> Splats:
    """Merge splats of the same group (N,), 0 to M - 1, to one each (see the module's docstring): M splats."""
    count = np.bincount(group)
    alone: Bools = count[group] == 1
    if alone.all():
        return splats
    kept = Splats(splats.parameters[alone])
    _, group = np.unique(group[~alone], return_inverse=True)
    return Splats(np.concatenate([kept.parameters, _merged(Splats(splats.parameters[~alone]), group).parameters]))


def _merged(splats: Splats, group: I64) -> Splats:
    """One splat for each group (N,)."""
    weight = splats.opacity * _surface(splats.scale.astype(np.float64))
    total = np.bincount(group, weight)

    def mean(values: F64) -> F64:
        """Weighted means (M, k) of (N, k)."""
        return np.column_stack([np.bincount(group, weight * column) for column in values.T]) / total[:, None]

    xyz = mean(splats.xyz.astype(np.float64))
    away = splats.xyz - xyz[group]
    spread = splats.covariance + away[:, :, None] * away[:, None, :]
    variance, axes = np.linalg.eigh(mean(spread.reshape(-1, 9)).reshape(-1, 3, 3))
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    scale = np.maximum(np.sqrt(np.maximum(variance, 0)), THINNEST_M)
    ratio = total / _surface(scale)
    scale *= np.clip(np.sqrt(ratio / MAX_OPACITY), 1, MAX_GROWTH)[:, None]
    opacity = np.clip(ratio, splats.opacity.min(), MAX_OPACITY)
    return Splats.of(xyz, scale, _quaternions(axes), opacity, mean(splats.rgb.astype(np.float64)))


def _surface(scale: F64) -> F64:
    """(N,) surfaces of ellipsoids with semi-axes (N, 3), up to a factor."""
    a, b, c = scale.T
    return a * b + b * c + c * a


def _quaternions(rotation: F64) -> F64:
    """Quaternions (N, 4) w x y z of rotations (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]])
