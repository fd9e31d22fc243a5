"""What a map shows of itself: point spacing, noise, scene (indoor or outdoor)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from scan2sim.pipeline.core.types import F32, F64
from scan2sim.pipeline.geometry.height_map import LATTICE_SPACING_CELLS
from scan2sim.pipeline.geometry.sorting import stable_argsort

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Scene = Literal["indoor", "outdoor"]
SAMPLES = 20_000
"""Points at which spacing and noise are measured."""
MILLIMETRE_MIN_SPACING = 3.0
MILLIMETRE_MIN_HEIGHT = 500.0
"""Spacing and smallest extent from which coordinates are millimetres: no map in metres is so thin and so high."""
PLANE_NEIGHBOURS = 12
NOISE_SAMPLES, NOISE_NEIGHBOURS = 2_000, 25
NOISE_THINNING = (1, 4, 16, 64, 256)
"""Noise is measured in neighbourhoods of every n-th point that are several times as wide as it: n for each sample is
the smallest of these at which variance across the plane is at most `NOISE_MAX_RATIO` of that along it."""
NOISE_MAX_RATIO, NOISE_MAX_WIDTH_M = 0.04, 0.5
"""Of wider ones (standard deviation along the plane), the shape of the ground would count as noise."""
PLAN_CELL_M = 0.5
"""Cell of the raster in plan view in which heights are compared."""
CEILING_HEIGHT_M = (1.8, 6.0)
"""Heights above the lowest points of a column at which level points are a ceiling."""
LEVEL_MIN_NORMAL_Z, UPRIGHT_MAX_NORMAL_Z = 0.9, 0.2
INDOOR_MIN_CEILING_SHARE = 0.2
MIN_COLUMNS_SHARE = 0.05
"""Share of the columns with enough points below which their heights say nothing: on a grid of 50 cm, hardly one has."""
WALL_RANGE_M = (0.5, 15.0)
WALL_HEIGHT_M = (0.5, 3.0)
"""Heights above the sensor's start at which points within that range are walls around it."""
SECTORS, SECTOR_MIN_POINTS = 36, 10
INDOOR_MIN_ENCLOSED_SHARE = 0.85
"""Share of the directions from the start that a wall closes: streets are open at both ends."""


@dataclass(frozen=True)
class MapDescription:
    """Properties of a levelled map, in metres.

    Attributes:
        spacing: median over points of the mean distance to six neighbours, on the scale of a square lattice.
        noise: median over points of the standard deviation around the plane through their neighbours; 0: none is flat.
        level_share, upright_share: shares of points whose normals are vertical and horizontal.
        ceiling_share: share of the columns in plan view with a ceiling.
        enclosed_share: share of the directions around the sensor's start that a wall closes.
        scene: indoor or outdoor.
    """

    spacing: float
    noise: float
    level_share: float
    upright_share: float
    ceiling_share: float
    enclosed_share: float
    scene: Scene


def guess_unit(xyz: F32, spacing: float) -> Literal["m", "mm"]:
    """Unit of the coordinates of a map (N, 3): metres, unless its spacing and extent can only be millimetres."""
    extent = np.ptp(np.percentile(xyz, (1, 99), axis=0), axis=0)
    return "mm" if spacing > MILLIMETRE_MIN_SPACING and extent.min() > MILLIMETRE_MIN_HEIGHT else "m"


def describe(xyz: F32, start: F64) -> MapDescription:
    """Describe a map.

    Args:
        xyz: (N, 3) metres, z up, without outliers.
        start: (3,) position of the sensor at its start, in the same axes.
    """
    tree = _tree(xyz)
    normal_z, spacing = _surfaces(xyz, tree)
    level, upright = float((normal_z > LEVEL_MIN_NORMAL_Z).mean()), float((normal_z < UPRIGHT_MAX_NORMAL_Z).mean())
    ceiling, enclosed = _ceiling_share(xyz), _enclosed_share(xyz, start)
    indoor = ceiling > INDOOR_MIN_CEILING_SHARE or enclosed > INDOOR_MIN_ENCLOSED_SHARE
    scene: Scene = "indoor" if indoor else "outdoor"
    return MapDescription(spacing, _noise(xyz, tree), level, upright, ceiling, enclosed, scene)


def _enclosed_share(xyz: F32, start: F64) -> float:
    """Share of the directions in plan view in which there are points above the sensor, within `WALL_RANGE_M`."""
    away = xyz.astype(np.float64) - start
    distance = np.hypot(away[:, 0], away[:, 1])
    near = (distance > WALL_RANGE_M[0]) & (distance < WALL_RANGE_M[1])
    near &= (away[:, 2] > WALL_HEIGHT_M[0]) & (away[:, 2] < WALL_HEIGHT_M[1])
    turn = np.arctan2(away[near, 1], away[near, 0]) / (2 * np.pi) + 0.5
    count = np.bincount((turn * SECTORS).astype(np.int64) % SECTORS, minlength=SECTORS)
    return float((count > SECTOR_MIN_POINTS).mean())


def _tree(xyz: F32) -> cKDTree:
    from scipy.spatial import cKDTree

    return cKDTree(xyz, balanced_tree=False, compact_nodes=False)  # several times faster to build


def _surfaces(xyz: F32, tree: cKDTree) -> tuple[F32, float]:
    """|z| of the normals of sampled points, and spacing; the tree is that of the points."""
    some = xyz[:: max(1, len(xyz) // SAMPLES)]
    distance, index = tree.query(some, min(PLANE_NEIGHBOURS, len(xyz)), workers=-1)
    spacing = float(np.median(distance[:, 1:7].mean(axis=1))) / LATTICE_SPACING_CELLS
    _, vectors = _planes(xyz[index])
    return np.abs(vectors[:, 2, 0]).astype(np.float32), spacing


def _planes(groups: F32) -> tuple[F64, F64]:
    """Variances (S, 3), ascending, and axes (S, 3, 3) of groups of points (S, K, 3); the first axis is the normal."""
    around = groups.astype(np.float64)
    around -= around.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / around.shape[1])
    return values, vectors


def _noise(xyz: F32, tree: cKDTree) -> float:
    """Standard deviation of points around planes, metres; the tree is that of the points."""
    left = xyz[:: max(1, len(xyz) // NOISE_SAMPLES)]
    found = [np.zeros(0)]
    for step in NOISE_THINNING:
        part = xyz[::step]
        if len(part) < NOISE_NEIGHBOURS or not len(left):
            break
        _, index = (tree if step == 1 else _tree(part)).query(left, NOISE_NEIGHBOURS, workers=-1)
        values, _ = _planes(part[index])
        flat = (values[:, 0] < NOISE_MAX_RATIO * values[:, 1]) & (values[:, 2] < NOISE_MAX_WIDTH_M**2)
        found.append(np.sqrt(np.maximum(values[flat, 0], 0) * NOISE_NEIGHBOURS / (NOISE_NEIGHBOURS - 3)))
        left = left[~flat]
    deviations = np.concatenate(found)
    return float(np.median(deviations)) if len(deviations) else 0.0


def _ceiling_share(xyz: F32) -> float:
    """Share of the columns in plan view with many points at the height of a ceiling, and few above it."""
    cell = np.floor(xyz[:, :2] / PLAN_CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    by_height = np.argsort(xyz[:, 2])
    order, key = stable_argsort(key[by_height])  # several times faster than np.lexsort
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    z = xyz[by_height[order], 2]
    ends = np.append(starts[1:], len(order)) - 1
    low = z[(starts + 0.1 * (ends - starts)).astype(np.int64)]
    high = z[(ends - 0.02 * (ends - starts)).astype(np.int64)]
    enough = ends - starts >= 10
    if enough.mean() < MIN_COLUMNS_SHARE:
        return 0.0
    # under a ceiling many points are at the top; a wall's are spread over its height
    top = np.array([np.mean(z[a : b + 1] > h - 0.15) for a, b, h in zip(starts, ends, high, strict=True)])
    rise = high - low
    ceiling = (rise > CEILING_HEIGHT_M[0]) & (rise < CEILING_HEIGHT_M[1]) & (top > 0.25)
    return float(ceiling[enough].mean())
