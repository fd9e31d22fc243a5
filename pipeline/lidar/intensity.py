"""Intensities of a lidar, and their dependence on range and angle of incidence, measured in the scan itself.

A data-driven correction as in Jutzi and Gross, "Normalization of lidar intensity data based on range and surface
incidence angle", ISPRS Archives 38, 2009.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, U8, PointCloud, Trajectory
from scan2sim.pipeline.geometry.sorting import first_of_each, stable_argsort

NORMAL_NEIGHBOURS = 12
BINS, CELL_MIN_POINTS = 24, 8
"""Bins of range and of the angle's cosine, and the number of points of a class in both from which there is a median."""
SMOOTHNESS = 0.03
"""Weight of the curves' second differences, relative to all points: fills bins without points."""
ROUNDS, MIN_RESIDUAL = 5, 0.1
"""Reweighting of outliers, such as walls of another colour; smaller residuals have equal weights."""
MIN_POINTS = 20
"""Number of points from which intensities can be compared."""
MIN_RANGE_M = 0.5


def has_intensity(cloud: PointCloud) -> bool:
    """Whether the intensities of a cloud show anything: at least three different values, not nearly one value."""
    if cloud.intensity is None or len(cloud) < MIN_POINTS:
        return False
    low, high = np.percentile(cloud.intensity, (5, 95))
    return bool(high > low) and len(np.unique(cloud.intensity[:100_000])) > 2


def range_and_incidence(cloud: PointCloud, path: Trajectory) -> tuple[F64, F64]:
    """Range (N,) in metres from the sensor on its path to each point, and (N,) cosine of the angle of incidence.

    The sensor is where it was at the point's time, or else at the nearest position of the path.
    """
    from scan2sim.pipeline.geometry.normals import normals, scanner_positions

    ray = scanner_positions(cloud, path) - cloud.xyz
    distance = np.maximum(np.linalg.norm(ray, axis=1), MIN_RANGE_M)
    if len(cloud) < 3:
        return distance, np.ones(len(cloud))
    normal = normals(cloud.xyz, NORMAL_NEIGHBOURS)
    return distance, np.abs(np.einsum("ij,ij->i", ray, normal)) / distance


def response(values: F32, distance: F64, incidence: F64, code: U8 | None = None) -> F32:
    """(N,) factor of range and angle of incidence in intensities: divided by it, they are those of the surface.

    Intensity is modelled as a level per class, times a function of range, times one of the angle. All are fitted
    together to the medians over class, range and angle, by least absolute logarithms: on level ground the angle follows
    from the range, so what is due to which only shows together with other surfaces. Intensity 0, which lidars give to
    weak returns of any strength, is left out.

    Args:
        values: (N,) intensities.
        distance, incidence: (N,) each, as `range_and_incidence` returns them.
        code: (N,) classes; None: all points are of one.
    """
    axes = np.log(distance), incidence
    ends = [np.percentile(axis, (0.5, 99.5)) for axis in axes]
    bins = [
        np.clip((axis - low) / max(high - low, 1e-6) * BINS, 0, BINS - 1).astype(np.int64)
        for axis, (low, high) in zip(axes, ends, strict=True)
    ]
    classes, level = np.unique(np.zeros(len(values), np.uint8) if code is None else code, return_inverse=True)
    order, cell = stable_argsort((level * BINS + bins[0]) * BINS + bins[1])
    starts = np.flatnonzero(first_of_each(cell))
    count = np.diff(np.append(starts, len(order)))
    median = medians(values, order, starts)
    enough = (count >= CELL_MIN_POINTS) & (median > 0)
    if not enough.any():
        return np.ones(len(values), np.float32)
    first, weight = order[starts[enough]], np.sqrt(count[enough])
    columns = np.stack([level[first], len(classes) + bins[0][first], len(classes) + BINS + bins[1][first]])
    model = np.zeros((len(first), len(classes) + 2 * BINS))
    model[np.arange(len(first)), columns] = weight
    smooth = np.zeros((2, BINS - 2, model.shape[1]))  # second differences of both curves
    for curve, part in enumerate(smooth):
        begin = len(classes) + curve * BINS
        part[:, begin : begin + BINS] = SMOOTHNESS * np.sqrt(len(values)) * np.diff(np.eye(BINS), 2, axis=0)
    target, robust, solution = weight * np.log(median[enough]), np.ones(len(first)), np.zeros(model.shape[1])
    for _ in range(ROUNDS):
        rows = np.concatenate([model * robust[:, None], *smooth])
        solution = np.linalg.lstsq(rows, np.append(target * robust, np.zeros(2 * (BINS - 2))), rcond=None)[0]
        robust = np.maximum(np.abs(target - model @ solution) / weight, MIN_RESIDUAL) ** -0.5
    factor = np.zeros(len(values))
    for axis, (low, high), log_factor in zip(axes, ends, solution[len(classes) :].reshape(2, BINS), strict=True):
        factor += np.interp(
            axis, low + (np.arange(BINS) + 0.5) / BINS * (high - low), log_factor - np.median(log_factor)
        )
    return np.exp(factor).astype(np.float32)


def medians(values: F32, order: I64, starts: I64) -> F64:
    """(V,) median of the values (N,) in each group; order and starts as those of `voxel_groups`."""
    count = np.diff(np.append(starts, len(order)))
    group = np.repeat(np.arange(len(starts)), count)
    ordered = values[order][np.lexsort((values[order], group))]
    return ordered[starts + (count - 1) // 2].astype(np.float64)
