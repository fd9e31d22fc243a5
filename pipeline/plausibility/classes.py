"""Check of a cloud's own classes: whether those of the ground are on the ground."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.classes import GROUPS, classified_codes, group_of
from scan2sim.pipeline.core.types import PointCloud
from scan2sim.pipeline.plausibility.finding import Finding

CELL_M = 5.0
"""Size of the cells in which the lowest point counts as the ground."""
HIGH_M, LOW_M = 4.0, 0.5
"""Height above the lowest point of a cell from which a point isn't on the ground, and to which it mostly is."""
MIN_CLASSIFIED = 0.2
"""Share of points with a class below which classes aren't kept (`segmentation.steps.segment`)."""
MIN_HIGH_SHARE = 0.05
"""Share of high points in the cloud below which there is nothing to judge by."""
MAX_GROUND_SHARE, MIN_GROUND_SHARE = 0.3, 0.5
"""Codes are others if more of the high points have a class of the ground, and fewer of the low ones: not on a cliff."""


def ground_classes(cloud: PointCloud) -> Finding | None:
    """Classes of the ground high above it: the codes of another data set, read as LAS classes.

    Args:
        cloud: a sample of the points, with our codes.
    """
    if cloud.classification is None:
        return None
    known = classified_codes()[cloud.classification]
    if known.mean() < MIN_CLASSIFIED:
        return None
    _, cell = np.unique(np.floor(cloud.xyz[:, :2] / CELL_M).astype(np.int64), axis=0, return_inverse=True)
    lowest = np.full(int(cell.max()) + 1, np.inf, np.float32)
    np.minimum.at(lowest, cell.ravel(), cloud.xyz[:, 2])
    height = cloud.xyz[:, 2] - lowest[cell.ravel()]
    high = known & (height > HIGH_M)
    if high.mean() < MIN_HIGH_SHARE:
        return None
    ground = group_of()[cloud.classification] == GROUPS.index("terrain")
    share = float(ground[high].mean())
    if share < MAX_GROUND_SHARE or ground[height < LOW_M].mean() > MIN_GROUND_SHARE:
        return None
    return Finding(
        2,
        f"{share:.0%} of the classified points more than {HIGH_M:.0f} m above the lowest ones around them have classes "
        "of the ground (terrain, road, ...): the codes seem to be another data set's, read as LAS classes. Map them by "
        "the import's --classes (CODE=CLASS,... or the data set's name), or classify the points again: run with --set "
        "segment.overwrite=true",
    )
