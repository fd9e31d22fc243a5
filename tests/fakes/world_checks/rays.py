"""A lidar in a consumer's world: its ranges are those of this project's own ray casting on the same rays."""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import Visible, WorldReference

LIDAR_HEIGHT_M, ROOM_HEIGHT_M = 1.8, 0.5
POSITION_COUNT = 3
"""Positions of the lidar along the longest way."""
ELEVATIONS_DEG = np.linspace(-25, 15, 41)
AZIMUTHS_DEG = np.arange(0, 360, 0.5)
MAX_RANGE_M = 100.0
MAX_MEDIAN_M, MAX_MISSING = 0.02, 0.01
"""Largest median difference of ranges, and largest share of rays that hit a surface in one of both only."""
MIN_CLASS_RAYS = 20
"""Rays on a class from which its median counts by itself."""
MIN_RETRO_SHARE = 0.99
"""Least share of hits with an intensity, if the world's reflectance is known."""


def rays(reference: WorldReference) -> tuple[F64, F64]:
    """Origins (N, 3) and unit vectors (N, 3) of a spinning lidar at some positions along the longest way."""
    way = reference.ways[0]
    index = np.linspace(0, len(way) - 1, POSITION_COUNT + 2).astype(np.int64)[1:-1]
    at = way[index] + [0, 0, ROOM_HEIGHT_M if reference.rooms else LIDAR_HEIGHT_M]
    azimuth, elevation = (part.ravel() for part in np.meshgrid(np.radians(AZIMUTHS_DEG), np.radians(ELEVATIONS_DEG)))
    flat = np.cos(elevation)
    turn = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    return np.repeat(at, len(turn), axis=0), np.tile(turn, (len(at), 1))


def compare(origins: F64, directions: F64, ranges: F64, retro: F64, surfaces: tuple[Visible, ...]) -> dict[str, Any]:
    """Metrics of the ranges (N,) that a consumer measured (inf without a hit), and of its intensities `retro` (N,).

    Raises:
        Fault: they differ from the ranges to the surfaces, hits are missing, or intensities are.
    """
    from scan2sim.pipeline.lidar.casting import Scanner

    expected, surface = Scanner.of([one.mesh for one in surfaces]).cast(origins, directions)
    hit, found = expected < MAX_RANGE_M, ranges < MAX_RANGE_M
    both = hit & found
    off = np.abs(ranges[both] - expected[both])
    label = np.array([one.label for one in surfaces])[surface[both]]
    medians = {name: float(np.median(off[label == name])) for name in sorted({*label.tolist()})}
    counted = {name: int((label == name).sum()) for name in medians}
    reflective = np.array([one.reflective for one in surfaces])[surface[both]]
    intense = float((retro[both][reflective] > 0).mean()) if reflective.any() else None
    median, high = np.percentile(off, [50, 99]).tolist() if len(off) else (np.inf, np.inf)
    missing = float((hit != found).sum() / max(hit.sum(), 1))
    metrics = {
        "lidar_rays": counted,
        "lidar_off_median_m": round(median, 5),
        "lidar_off_p99_m": round(high, 5),
        "lidar_missing_share": round(missing, 5),
        "lidar_retro_share": intense,
    }
    worst = {name: round(m, 3) for name, m in medians.items() if m > MAX_MEDIAN_M and counted[name] >= MIN_CLASS_RAYS}
    if median > MAX_MEDIAN_M or worst:
        raise Fault(f"a lidar's ranges differ from those to the surfaces, median in metres by class: {worst}", metrics)
    if missing > MAX_MISSING:
        raise Fault(f"{missing:.1%} of a lidar's rays hit a surface here or there only", metrics)
    if intense is not None and intense < MIN_RETRO_SHARE:
        raise Fault(f"only {intense:.1%} of a lidar's hits have an intensity", metrics)
    return metrics
