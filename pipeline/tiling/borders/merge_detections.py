"""Merging of detections of neighbouring tiles: an object at a border becomes one detection, identical in all tiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scan2sim.pipeline.core.voronoi_cell import Seed, nearest
from scan2sim.pipeline.furniture.classify import Detection

MAX_FOOT_DISTANCE_M = 2.0
"""Distance between the feet of two detections up to which they are compared."""


def merged_detections(
    detections: Mapping[str, Sequence[Detection]], seeds: Mapping[str, Seed]
) -> list[tuple[str, Detection]]:
    """All detections without duplicates, each with the name of the tile whose cell contains its foot.

    Of duplicates, that of the tile whose cell contains the object is kept; if that is both or neither, that of the
    tile whose name sorts first. All tiles with the same detections therefore get the same result.

    Args:
        detections: detections of each tile, world metres.
        seeds: seeds of these tiles and all around them.
    """
    names = sorted(seeds)
    found = [(name, detection) for name in sorted(detections) for detection in detections[name]]
    if not found:
        return []
    feet = np.array([detection.foot[:2] for _, detection in found])
    owner = [names[i] for i in nearest(feet, [seeds[name] for name in names])]
    kept: list[int] = []
    for i in sorted(range(len(found)), key=lambda i: owner[i] != found[i][0]):  # stable: then by name and order
        near = [k for k in kept if found[k][0] != found[i][0] and np.hypot(*(feet[k] - feet[i])) < MAX_FOOT_DISTANCE_M]
        if not any(found[k][1].stem.covers(found[i][1].stem) for k in near):
            kept.append(i)
    return [(owner[i], found[i][1]) for i in kept]
