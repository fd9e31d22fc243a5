"""A small scan with known content, which the cases write in foreign ways, and checks of the tile made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F64, U8

PLACE = np.array([389_000.0, 5_820_000.0, 35.0])
"""A street in Berlin, EPSG:32633."""
TOLERANCE_M = 0.002


@dataclass(frozen=True)
class Scan:
    """Points of a corner: ground and two walls.

    Attributes:
        xyz: (N, 3) EPSG:32633; rgb: (N, 3); intensity: (N,) 0 to 255; normal: (N, 3); code: (N,) LAS classes.
    """

    xyz: F64
    rgb: U8
    intensity: U8
    normal: F64
    code: U8


def scan(count: int = 3000, seed: int = 1) -> Scan:
    """The scan; ground and walls are textured."""
    random = np.random.default_rng(seed)
    part = np.arange(count) % 3
    x, y, z = random.uniform(-10, 10, count), random.uniform(-10, 10, count), random.uniform(0, 5, count)
    xyz = np.column_stack([np.where(part == 1, 10, x), np.where(part == 2, 10, y), np.where(part == 0, 0, z)])
    xyz += random.normal(0, 0.005, xyz.shape)
    grey = (120 + 60 * np.sin(xyz[:, 0]) * np.cos(xyz[:, 1] + xyz[:, 2]))[:, None]
    rgb = np.clip(grey + random.integers(-12, 13, (count, 3)), 0, 255).astype(np.uint8)
    normal = np.array([(0, 0, 1), (-1, 0, 0), (0, -1, 0)], float)[part]
    code = np.array([2, 6, 6], np.uint8)[part]
    return Scan(np.round(xyz + PLACE, 3), rgb, random.integers(0, 256, count).astype(np.uint8), normal, code)


def points_are(
    xyz: F64,
    rgb: U8 | None = None,
    code: U8 | None = None,
    *,
    coloured: bool | None = None,
    place: F64 = PLACE,
    among: bool = False,
) -> Callable[[Path], str]:
    """A check: the tile `tile` has these points.

    Args:
        xyz: (N, 3) the points in the units of the CRS.
        rgb, code: their colours and classes; None: not checked.
        coloured: whether the tile has colours; None: not checked.
        place: a position near them.
        among: there may be others: those that steps leave out later.
    """

    def check(folder: Path) -> str:
        from scipy.spatial import cKDTree

        from scan2sim.pipeline.core.types import PointCloud
        from scan2sim.pipeline.io import clouds
        from scan2sim.pipeline.io.tile import read_tile

        tile = read_tile(folder / "tile")
        cloud = PointCloud.join([clouds.read(path, tile.frame) for path in tile.clouds])
        if len(cloud) != len(xyz) and not among:
            return f"{len(cloud)} points instead of {len(xyz)}"
        off, at = cKDTree(tile.frame.to_crs(cloud.xyz) - place).query(xyz - place)
        if off.max() > TOLERANCE_M:
            return f"coordinates are off by up to {off.max():.3g}"
        if rgb is not None and (cloud.rgb is None or not np.array_equal(cloud.rgb[at], rgb)):
            return "other colours"
        if coloured is False and cloud.rgb is not None:
            return "colours are invented"
        if code is not None and (cloud.classification is None or not np.array_equal(cloud.classification[at], code)):
            return "other classes"
        return ""

    return check
