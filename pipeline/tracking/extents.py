"""Extents: where the points of a sweep end along the axes of an object's box, and what that says about the box.

The scanner sees the near sides of an object. A face turned to it is measured; the far end of a side is known to the
spacing of the rays along that side, unless something hides it; what lies behind is unknown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64

FACE_SIGMA_M = 0.06
"""Standard deviation of a face that was seen: roundness of bodies, range noise."""
POINT_SIGMA_M = 0.3
"""Standard deviation of a face of which one point was seen; that of N points is smaller by their square root."""
OUTLIERS_PERCENT = 0.5
"""Share of points beyond each end of an extent: antennas, spray, neighbours."""
FEW_POINTS = 12
"""Points from which an extent excludes outliers; with fewer, all count."""
SPACING_RAD = 0.004
"""Angle between neighbouring rays of a spinning scanner; it limits how well the end of a side is known."""
FRONTAL_MARGIN_M = 0.3
"""Distance of the scanner beyond the plane of a face from which the face is seen."""
RESOLVED_M = 0.5
"""Spacing of points across a face up to which it is seen."""
GRAZING = 1e-2
"""Smallest sine of the angle at which a side is seen."""
SPREAD = (0.11, 0.07)
"""Standard deviation of length and of width within a category, relative to the typical one."""
HIDDEN_PRIOR = 0.2
"""Probability that something hides a part of the far end of a side in all sweeps."""


class Extent(NamedTuple):
    """Interval of an object's points along both axes of its box, from a reference point, metres.

    Attributes:
        low, high: (2,) along and across.
        scanner: (2,) the scanner.
        points: number of points.
    """

    low: F64
    high: F64
    scanner: F64
    points: int

    @property
    def length(self) -> F64:
        """(2,) metres along and across."""
        return self.high - self.low

    @property
    def face_sigma(self) -> float:
        """Standard deviation of a face that is turned to the scanner, metres."""
        return float(FACE_SIGMA_M + POINT_SIGMA_M / np.sqrt(self.points))


def axes(yaw: float) -> F64:
    """(2, 2) unit vectors along and across a box, as columns."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return np.array([[c, -s], [s, c]])


def extent(xy: F64, reference: F64, yaw: float, scanner: F64) -> Extent:
    """Extent of points (N, 2) about `reference` (2,); `scanner` (2,): its position."""
    R = axes(yaw)
    local = (xy - reference) @ R
    tail = OUTLIERS_PERCENT if len(xy) >= FEW_POINTS else 0.0
    low, high = np.percentile(local, (tail, 100 - tail), axis=0)
    return Extent(low, high, (scanner - reference) @ R, len(xy))


def spacing(offset: F64, beyond: F64) -> F64:
    """Spacing in metres of points on a side, by the scanner's `offset` (..., 2), and distance (...,) `beyond` it."""
    distance = np.maximum(np.hypot(offset[..., 0], offset[..., 1]), 0.1)
    return np.asarray(SPACING_RAD * distance / np.maximum(beyond / distance, GRAZING))


def side_spacing(seen: Extent, axis: int) -> float:
    """Spacing of points along an axis: on the side that is parallel to it and turned to the scanner."""
    offset = seen.scanner - (seen.low + seen.high) / 2
    beyond = np.abs(offset[1 - axis]) - seen.length[1 - axis] / 2
    return float(spacing(offset, beyond))


def completed(seen: float, gap: float, axis: int, typical: float, largest: float) -> tuple[float, float, float]:
    """Mean and standard deviation of a size (m) of which the extent `seen` is a lower bound; and its evidence.

    The prior is normal; the unseen rest is as long as the spacing of the rays (exponential), unless something hides it.

    Args:
        seen: extent along the axis, metres.
        gap: spacing of points along that side, metres.
        axis: 0 along, 1 across.
        typical, largest: sizes of the category, metres.

    Returns:
        The mean, the standard deviation, and the probability density of the extent, 1/m.
    """
    if seen >= largest:
        return largest, FACE_SIGMA_M, 1e-9
    sizes = np.linspace(seen, largest, 200)
    sigma = SPREAD[axis] * typical
    prior = np.exp(-(((sizes - typical) / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi)) + 1e-9
    rest = (1 - HIDDEN_PRIOR) * np.exp(-(sizes - seen) / gap) / gap + HIDDEN_PRIOR / typical
    weight = prior * rest
    evidence = float(weight.sum() * (sizes[1] - sizes[0]))
    weight /= weight.sum()
    mean = float((weight * sizes).sum())
    return mean, float(np.sqrt((weight * (sizes - mean) ** 2).sum())), evidence
