"""Maps with more points than fit into memory: they are thinned while they are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.geometry.height_map import exact_point_spacing
from scan2sim.pipeline.io import clouds as cloud_io

MAX_POINTS = 20_000_000
"""Maps with more points are thinned; the steps need up to 0.25 GB of memory per million."""
GROWTH = 1.25
"""Factor by which cubes grow until half of `MAX_POINTS` are left."""
HASH = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


def read_thinned(clouds: Sequence[Path], frame: Frame, count: int, report: Report) -> tuple[PointCloud, float]:
    """At most `MAX_POINTS` of the points with finite coordinates: the first one in each cube.

    Args:
        clouds: files in one frame.
        frame: of the result.
        count: number of all points, for the progress.
        report: receives progress.

    Returns:
        The cloud, and the side of a cube in its coordinates; 0 if no point was left out.
    """
    kept, side, number = list[PointCloud](), 0.0, 0
    for path in clouds:
        for chunk in cloud_io.chunks(path, frame):
            number += len(chunk)
            report(0.2 * min(1.0, number / count), f"reading: {number / 1e6:.0f} of {count / 1e6:.0f} million points")
            local = frame.to_local(chunk.frame.to_crs(chunk.xyz)).astype(np.float32)
            part = replace(chunk, xyz=local, frame=frame).take(np.asarray(np.isfinite(local).all(axis=1)))
            kept.append(_one_per_cube(part, side) if side else part)
            if sum(map(len, kept)) > MAX_POINTS:
                whole = PointCloud.join(kept)
                side = side or exact_point_spacing(whole.xyz)
                while len(whole := _one_per_cube(whole, side)) > MAX_POINTS / 2:
                    side *= GROWTH
                kept = [whole]
    return PointCloud.join(kept), side


def _one_per_cube(cloud: PointCloud, side: float) -> PointCloud:
    """The first point in each cube, in their order."""
    x, y, z = (
        np.floor(column / side).astype(np.int64).view(np.uint64) * np.uint64(k)
        for column, k in zip(cloud.xyz.T, HASH, strict=True)
    )
    _, first = np.unique(x ^ (y << np.uint64(1)) ^ (z >> np.uint64(1)), return_index=True)
    return cloud.take(np.sort(first))
