"""Checks of the points: steps of coordinates, far points, density, level ground."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, PointCloud
from scan2sim.pipeline.geometry.upright import find_up
from scan2sim.pipeline.plausibility.finding import Finding

AXES = ("eastings", "northings", "heights")
MIN_STEP_M = 0.03
"""Coarser steps of coordinates than this show in surfaces."""
MIN_GRID_M = 0.08
"""The same for a thinned cloud, whose step is that of the voxels of a world, or finer."""
MIN_VALUES = 20
"""Distinct coordinates along an axis that are needed to know their step."""
STEP_TOLERANCE = 0.02
"""Share of a step by which coordinates may be off it, rounded when units are converted."""
CORE_PERCENT = 0.1
"""Percentage of the points at either end of each axis that aren't counted to the core of a cloud."""
FAR_FACTOR, MIN_FAR_M = 3.0, 100.0
"""Extent of all points, relative to that of the core and in metres, from which the others are far away."""
MAX_SPACING_M = 0.7
"""Distance of neighbouring points from which there is no surface, only terrain at best."""
OCCUPIED_CELL_M = 2.0
"""Cells whose area counts as covered by points."""
MAX_TILT_DEGREES = 20.0
MIN_MARGIN = 0.3
"""Margin (`Upright.margin`) of an up axis over the next one from which it is certain."""


def coordinate_steps(cloud: PointCloud, unit: float = 1.0) -> Finding | None:
    """Coordinates in coarse steps: those of 32-bit floats far from their origin, or of a thinned cloud.

    Args:
        cloud: a sample of the points, unthinned.
        unit: metres per unit of the file's coordinates.
    """
    found = [_step(column) for column in cloud.xyz.T]
    coarse = [(name, step) for name, step in zip(AXES, found, strict=True) if step >= MIN_STEP_M]
    if not coarse:
        return None
    steps = ", ".join(f"{name} of {100 * step:.0f} cm" for name, step in coarse)
    at = np.abs(np.asarray(cloud.frame.origin) + cloud.xyz.astype(np.float64)).max(axis=0) / unit
    of_float = np.spacing(at.astype(np.float32)) * unit
    if any(abs(step - own) < STEP_TOLERANCE * own for step, own in zip(found, of_float, strict=True) if own >= 0.01):
        cause = "they were stored as 32-bit floats, which have no more digits so far from the origin"
        remedy = "Export the cloud again in double precision (LAS, E57), or with a local origin"
        return Finding(3, f"coordinates are in steps, {steps}: {cause}. {remedy}")
    if max(step for _, step in coarse) < MIN_GRID_M:
        return None
    return Finding(
        1,
        f"coordinates are in steps, {steps}: the cloud was rounded or thinned to a grid, so smaller shapes are lost, "
        "or its unit isn't the metre. Export it again unthinned, in metres with millimetres",
    )


def _step(values: F32) -> float:
    """Step of which all values (N,) are multiples, from one of them; 0 without one."""
    distinct = np.unique(values.astype(np.float64))
    if len(distinct) < MIN_VALUES:
        return 0.0
    between = np.sort(np.diff(distinct))
    step = float(np.median(between[: max(1, len(between) // 4)]))
    off = between / step - np.rint(between / step)
    return step if step >= MIN_STEP_M and np.abs(off).max() < STEP_TOLERANCE else 0.0


def far_points(cloud: PointCloud) -> Finding | None:
    """A few points far from all others, which make the extent of a tile."""
    low, high = np.percentile(cloud.xyz, (CORE_PERCENT, 100 - CORE_PERCENT), axis=0)
    core, whole = float((high - low).max()), float(np.ptp(cloud.xyz, axis=0).max())
    if whole < FAR_FACTOR * core or whole - core < MIN_FAR_M:
        return None
    margin = core / 2
    outside = np.any((cloud.xyz < low - margin) | (cloud.xyz > high + margin), axis=1)
    return Finding(
        2,
        f"{outside.sum():,} of {len(cloud):,} sampled points are far from the rest: all extend over {whole:,.0f} m, "
        f"all but {2 * CORE_PERCENT / 100:.1%} over {core:,.0f} m. They are outliers, or several places in one file: "
        "remove them",
    )


def density(cloud: PointCloud, count: int) -> Finding | None:
    """Too few points for surfaces.

    Args:
        cloud: a sample of the points.
        count: number of all points.
    """
    from scipy.spatial import cKDTree

    cells = np.unique(np.floor(cloud.xyz[:, :2].astype(np.float64) / OCCUPIED_CELL_M).astype(np.int64), axis=0)
    spacing = float(np.sqrt(len(cells) * OCCUPIED_CELL_M**2 / max(1, count)))
    if spacing < MAX_SPACING_M or len(cloud) < 2:
        return None
    nearest = float(cKDTree(cloud.xyz).query(cloud.xyz, 2)[0][:, 1].mean())
    apart = 2 * nearest * (len(cloud) / count) ** 0.5  # on a grid; points at random have the nearest at half of it
    return Finding(
        2,
        f"neighbouring points are about {apart:.1f} m apart: too far for the surfaces of a street (0.1 m). The cloud "
        "is sparse (a reconstruction's sparse points?) or its unit isn't the metre. Give the dense cloud, or the unit "
        "by the import's --units (m, ft, us-ft); convert others, such as millimetres, to metres first",
    )


def level_ground(cloud: PointCloud) -> Finding | None:
    """Flat surfaces whose common up axis isn't z."""
    found = find_up(cloud.xyz)
    if found is None or found.margin < MIN_MARGIN:
        return None
    tilt = float(
        np.degrees(np.arccos(min(1.0, abs(found.up[2]))))
    )  # which end of the axis is up isn't certain outdoors
    if tilt < MAX_TILT_DEGREES:
        return None
    axis = "xyz"[int(np.abs(found.up).argmax())]
    other = "" if axis == "z" else f": up seems to be {axis} (or -{axis}), not z"
    return Finding(
        3,
        f"the ground and the walls are tilted by {tilt:.0f} degrees{other}. Export the cloud with z up, or import it "
        "as a robot's map (`import map` finds up of clouds without a CRS). If columns were only exchanged, name their "
        "order with --axes",
    )
