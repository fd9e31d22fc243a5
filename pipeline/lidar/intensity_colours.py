"""Colours of points from their intensity: shades of a tint per class, for maps without colours.

Intensity falls with range and angle of incidence, and differs between lidars, so only its contrast to the
surroundings is kept. Where the path of the sensor is known, the effect of range and angle is divided out first
(`pipeline.lidar.intensity`). On the ground, what reflects far more than its surroundings (lane markings, crossings)
becomes white. At the foot of walls and furniture the floor has one shade: noise makes their lowest points part of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2sim.pipeline.core.classes import CODE, GROUPS, colour_of, group_of
from scan2sim.pipeline.core.types import F32, I64, U8, Bools, PointCloud, Trajectory
from scan2sim.pipeline.lidar import intensity

LEVEL_CELL_M = 0.5
"""Cells that share the median of their surroundings; normals are fitted to them, too."""
LEVEL_RADIUS_M = 3.0
"""Distance at which the weight of a cell's median in the surroundings falls to 1/e: far wider than lane markings."""
LEVEL_NEIGHBOURS = 48
DARK_PERCENTILE, BRIGHT_PERCENTILE = 2.0, 98.0
SHADES, EVEN_SHADES = (0.55, 1.25), (0.8, 1.15)
"""Factors on the tint at these percentiles of a class's contrast; the latter of `EVEN` classes."""
EVEN = ("terrain", "wall", "ceiling", "furniture")
"""The ground, but for its markings, and surfaces of rooms, whose contrast is mostly that of the range and the angle."""
MARKING_SIGMAS = (1.8, 3.6)
"""Contrast on the ground, in robust standard deviations, from which points turn white, and are white."""
MARKING_RGB = (235, 235, 230)
FOOT_M = 0.2
"""Points of a floor at this distance or less from a wall or furniture may be points of the wall or furniture."""
GROUND_RGB = (112, 112, 114)
"""Tint of the ground: asphalt; shape alone doesn't distinguish it from soil."""


def intensity_colours(cloud: PointCloud, path: Trajectory | None = None, tint: U8 | None = None) -> U8:
    """(N, 3) uint8 colours of classified points with intensities.

    Args:
        cloud: points (N, 3) in metres; `has_intensity` is true.
        path: positions of the sensor in the same frame, or None.
        tint: (256, 3) colour of each class at medium intensity; None: the classes' display colours, grey ground.
    """
    assert cloud.intensity is not None
    n = len(cloud)
    code = np.full(n, CODE["unclassified"], np.uint8) if cloud.classification is None else cloud.classification
    if tint is None:
        tint = colour_of().copy()
        tint[CODE["terrain"]] = GROUND_RGB
    is_ground = group_of() == GROUPS.index("terrain")
    rgb = tint[code].astype(np.float32)
    strength = cloud.intensity.astype(np.float32)
    merged = np.where(is_ground[code], CODE["terrain"], code)  # the ground is one surface
    even = {CODE[name] for name in EVEN}
    for one in np.unique(merged).tolist():
        rows = np.flatnonzero(merged == one)
        if len(rows) < intensity.MIN_POINTS:
            continue  # keep the plain tint
        contrast = _contrast(replace(cloud, rgb=None).take(rows), strength[rows], path)
        if is_ground[one]:
            contrast[_at_foot(cloud.xyz, code, rows)] = 0
        low, high = np.percentile(contrast, (DARK_PERCENTILE, BRIGHT_PERCENTILE)).tolist()
        share = np.clip((contrast - low) / max(high - low, 1e-6), 0, 1)
        dark, bright = EVEN_SHADES if one in even else SHADES
        rgb[rows] *= (dark + (bright - dark) * share)[:, None]
        if is_ground[one]:
            white = _marking(contrast)[:, None]
            rgb[rows] += white * (np.array(MARKING_RGB, np.float32) - rgb[rows])
    return np.clip(np.rint(rgb), 1, 255).astype(np.uint8)


def _contrast(cloud: PointCloud, strength: F32, path: Trajectory | None) -> F32:
    """(N,) difference of the points of one class from the median of their surroundings, in robust standard deviations.

    The strength (N,) is corrected for range and angle before. Where it scatters more than elsewhere, the deviation is
    that of the surroundings: far away, noise is no contrast.
    """
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.geometry.voxel_grid import sample, voxel_groups

    groups = voxel_groups(cloud.xyz, LEVEL_CELL_M)
    order, starts = groups
    cell = np.empty(len(cloud), np.int64)
    cell[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(cloud))))
    cells = sample(cloud, LEVEL_CELL_M, groups)
    if path is not None and len(path):
        distance, incidence = intensity.range_and_incidence(cells, path)
        strength = strength / intensity.response(strength, distance[cell], incidence[cell])
    k = min(LEVEL_NEIGHBOURS, len(cells))
    distance, near = (a.reshape(len(cells), k) for a in cKDTree(cells.xyz).query(cells.xyz, k=k, workers=-1))
    weight = np.exp(-((distance / LEVEL_RADIUS_M) ** 2)) * np.diff(np.append(starts, len(cloud)))[near]
    weight /= weight.sum(axis=1, keepdims=True)
    level = (weight * intensity.medians(strength, order, starts)[near]).sum(axis=1)
    offset = strength - level[cell]
    spread = 1.4826 * (weight * intensity.medians(np.abs(offset), order, starts)[near]).sum(axis=1)
    usual = max(1.4826 * float(np.median(np.abs(offset))), 1e-6)
    contrast: F32 = (offset / np.maximum(spread, usual)[cell]).astype(np.float32)
    return contrast


def _marking(contrast: F32) -> F32:
    """(N,) share of white: 1 where the ground reflects far more than its surroundings."""
    begin, end = MARKING_SIGMAS
    return np.clip((contrast - begin) / (end - begin), 0, 1).astype(np.float32)


def _at_foot(xyz: F32, code: U8, rows: I64) -> Bools:
    """(K,) which ground points `rows` (K,) are on the floor of a room, within `FOOT_M` of what stands on it."""
    from scipy.spatial import cKDTree

    at_foot = code[rows] == CODE["floor"]
    standing = xyz[group_of()[code] != GROUPS.index("terrain")]
    if at_foot.any() and len(standing):
        near = cKDTree(standing).query(xyz[rows[at_foot]], distance_upper_bound=FOOT_M, workers=-1)[0]
        at_foot[at_foot] = np.isfinite(near)
    return at_foot
