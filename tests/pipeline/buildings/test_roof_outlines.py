"""Roof outlines: rasters of buildings of known shape, against their corners, areas and numbers of roofs."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.buildings.roof_outlines import OutlinePoints, nearest_value, regularize, rings, roofs
from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.geometry.height_map import Raster, signed_area

L_SHAPE = np.array([[0, 0], [14, 0], [14, 6], [6, 6], [6, 11], [0, 11]], float)
"""Corners of an L-shaped building, counter-clockwise, metres."""
COURTYARD = np.array([[5, 2], [9, 2], [9, 5], [5, 5]], float)
CELL, TOLERANCE = 0.25, 0.5
RASTER = Raster(CELL, (-80, -60), (160, 200))


def turned(ring: F64, heading: float) -> F64:
    c, s = np.cos(heading), np.sin(heading)
    return np.asarray(ring @ np.array([[c, s], [-s, c]]))


def inside(ring: F64, xy: F64) -> Bools:
    """(N,) bool, True for points (N, 2) inside a ring (K, 2), by the crossing number."""
    count = np.zeros(len(xy), int)
    for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        across = (y0 > xy[:, 1]) != (y1 > xy[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            count += across & (xy[:, 0] < x0 + (xy[:, 1] - y0) / (y1 - y0) * (x1 - x0))
    return np.asarray(count % 2 == 1)


def mask_of(ring: F64, hole: F64 | None = None) -> Bools:
    """Cells of `RASTER` whose centre is inside a ring, and outside a hole."""
    centres = RASTER.centres(np.ones(RASTER.shape, bool))
    own = inside(ring, centres) if hole is None else inside(ring, centres) & ~inside(hole, centres)
    return own.reshape(RASTER.shape)


def farthest(found: F64, true: F64) -> float:
    """Largest distance of a true corner from the nearest found one, metres."""
    return float(np.linalg.norm(true[:, None] - found, axis=2).min(axis=1).max())


@pytest.mark.parametrize("heading", [0.0, 0.3, 0.78, -1.2])
def test_outline_of_an_l_shaped_building_has_its_six_corners(heading: float) -> None:
    true = turned(L_SHAPE, heading)
    (ring,) = rings(mask_of(true), RASTER, TOLERANCE, 4.0)
    assert len(ring) == 6 and farthest(ring, true) < 0.25
    assert signed_area(ring) == pytest.approx(signed_area(true), rel=0.03), "its inside must be to the left"
    side = np.roll(ring, -1, axis=0) - ring
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    assert np.abs((side * np.roll(side, 1, axis=0)).sum(axis=1)).max() < 1e-6, "its corners are right angles"


@pytest.mark.parametrize("heading", [0.0, 0.3, 0.78, -1.2])
@pytest.mark.parametrize("cut", [2.0, 4.0, 7.0])
def test_oblique_side_does_not_rotate_the_other_sides(heading: float, cut: float) -> None:
    """A rectangle of 14 m by 8 m with a corner cut off at 30 degrees."""
    true = np.array([[0, 0], [14, 0], [14, 8 - cut / np.sqrt(3)], [14 - cut, 8], [0, 8]])
    (ring,) = rings(mask_of(turned(true, heading)), RASTER, TOLERANCE, 4.0)
    side = turned(np.roll(ring, -1, axis=0) - ring, -heading)
    angle = np.degrees(np.arctan2(side[:, 1], side[:, 0]))[np.linalg.norm(side, axis=1) > 2]
    off = np.abs((angle + 45) % 90 - 45)
    assert (off < 0.5).sum() >= 4 and (off[off >= 0.5] > 28).all(), off
    assert farthest(ring, turned(true, heading)) < 0.35


def test_holes_run_clockwise_and_small_ones_are_closed() -> None:
    true, hole = turned(L_SHAPE, 0.3), turned(COURTYARD, 0.3)
    mask = mask_of(true, hole)
    found = sorted(rings(mask, RASTER, TOLERANCE, 4.0), key=signed_area)
    assert len(found) == 2
    assert signed_area(found[0]) == pytest.approx(-12, rel=0.08) and farthest(found[0], hole) < 0.25
    assert farthest(found[1], true) < 0.25
    assert len(rings(mask, RASTER, TOLERANCE, 20.0)) == 1


def test_rings_are_equivariant_to_shifts_and_rotations() -> None:
    mask = mask_of(turned(L_SHAPE, 0.3))
    (ring,) = rings(mask, RASTER, TOLERANCE, 4.0)
    (moved,) = rings(mask, Raster(CELL, (-80 + 400, -60 - 200), RASTER.shape), TOLERANCE, 4.0)
    assert moved == pytest.approx(ring + (100, -50), abs=1e-4)
    rows, columns = RASTER.shape
    quarter = Raster(CELL, (-(RASTER.low[1] + rows), RASTER.low[0]), (columns, rows))
    (turn,) = rings(np.rot90(mask, -1).copy(), quarter, TOLERANCE, 4.0)
    assert farthest(turn, turned(ring, np.pi / 2)) < 0.15


def test_degenerate_masks_and_contours_give_valid_rings_or_none() -> None:
    assert rings(np.zeros(RASTER.shape, bool), RASTER, TOLERANCE, 4.0) == []
    one, line = np.zeros(RASTER.shape, bool), np.zeros(RASTER.shape, bool)
    one[50, 50] = line[50, 20:60] = True
    for mask in (one, line):
        for ring in rings(mask, RASTER, TOLERANCE, 4.0):
            assert len(ring) >= 3 and np.isfinite(ring).all()
    whole = np.ones(RASTER.shape, bool)
    (ring,) = rings(whole, RASTER, TOLERANCE, 4.0)
    assert signed_area(ring) == pytest.approx(whole.size * CELL**2, rel=0.01)
    assert regularize(np.column_stack([np.arange(30.0), np.zeros(30)]), TOLERANCE) is None
    for count in (1, 2):
        assert regularize(np.arange(2.0 * count).reshape(-1, 2), TOLERANCE) is None


def flood(top: F64, step: float) -> list[int]:
    """Sizes of connected components of a height raster without gaps, by flood fill."""
    left, sizes = {tuple(at) for at in np.argwhere(np.isfinite(top)).tolist()}, []
    while left:
        queue, size = [left.pop()], 0
        while queue:
            row, column = queue.pop()
            size += 1
            for at in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
                if at in left and abs(top[at] - top[row, column]) <= step:
                    left.remove(at)
                    queue.append(at)
        sizes.append(size)
    return sorted(sizes)


def test_roofs_are_separated_at_height_steps() -> None:
    x = np.arange(60) * 0.5
    top = np.full((44, 60), np.nan)
    top[2:42, 2:30] = 8.0 + 0.4 * x[2:30]  # a pitched roof, which rises by 0.2 m per cell
    top[2:42, 30:50] = 5.0
    top[20:24, 10:14] += 1.5  # a chimney of 4 m2
    number = roofs(top, 0.5, 1.0, 6.0)
    assert number.max() == 2 and (number[np.isnan(top)] == 0).all()
    assert len(np.unique(number[2:42, 2:30])) == 1, "the chimney belongs to the roof around it"
    assert len(np.unique(number[2:42, 30:50])) == 1 and number[10, 10] != number[10, 40]
    assert roofs(top, 0.5, 1.0, 3.0).max() == 3, "with a smaller limit, it is a roof"


@pytest.mark.parametrize("seed", range(3))
def test_roofs_equal_flood_fill(seed: int) -> None:
    rng = np.random.default_rng(seed)
    top: F64 = np.kron(rng.uniform(0, 6, (8, 9)), np.ones((3, 3))).astype(np.float64)
    number = roofs(top, 1.0, 1.0, 1.0)
    assert sorted(np.bincount(number.ravel())[1:].tolist()) == flood(top, 1.0)
    np.testing.assert_array_equal(roofs(top, 1.0, 1.0, 1.0), number)


def test_nearest_value_equals_exhaustive_search() -> None:
    rng = np.random.default_rng(0)
    values, known = rng.random((9, 11)), rng.random((9, 11)) < 0.2
    places = np.argwhere(known)
    filled = nearest_value(np.where(known, values, np.nan), known)
    for at in np.ndindex(values.shape):
        away = np.linalg.norm(places - at, axis=1)
        assert filled[at] in values[tuple(places[away <= away.min() + 1e-9].T)]


def test_points_along_rings_are_evenly_spaced_and_point_outwards() -> None:
    hole = COURTYARD[::-1]
    points = OutlinePoints.along([L_SHAPE, hole], 0.3)
    assert len(np.unique(points.side)) == 10 and len(points) == len(points.outward) == len(points.side)
    beyond = points.xy + 0.01 * points.outward
    own = inside(L_SHAPE, beyond) & ~inside(COURTYARD, beyond)
    assert not own.any(), "outward points away from the roof, into the courtyard too"
    for side, (start, end) in enumerate(zip(L_SHAPE, np.roll(L_SHAPE, -1, axis=0), strict=True)):
        at = points.xy[points.side == side]
        gaps = np.diff(np.concatenate([[0], np.linalg.norm(at - start, axis=1), [np.linalg.norm(end - start)]]))
        assert gaps.max() <= 0.3 + 1e-9 and gaps.min() > 0
    assert len(OutlinePoints.along([], 0.3)) == 0
    assert len(OutlinePoints.along([np.zeros((3, 2))], 0.3)) == 0, "sides without a length have no points"
