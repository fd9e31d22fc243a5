"""Ground of a town: the road network and a raster of distances to it.

The road's centre line runs `LANE_OFFSET_M` to the left of the driven path (traffic keeps right). Where a path passes
again, the existing road is used. Heights: road 0, everything else `KERB_HEIGHT_M` above, both on top of the hills.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.hills import FLAT
from scan2sim.data_samples.paths import chainage, extended, heading, smooth
from scan2sim.pipeline.core.types import F32, F64, I32

LANE_OFFSET_M = 1.7  # from the centre line to the driven path
HALF_ROAD_M = 5.2  # half the width of the carriageway with parking lanes
PAVEMENT_WIDTH_M = 2.6
KERB_HEIGHT_M = 0.12
CELL_M = 0.5  # spacing of the raster's nodes
DISTANCE_MAX_M = 30.0  # distances are clamped to this
EXTENSION_M = 80.0  # length of road beyond the path's ends
SAME_ROAD_M = 2.8  # a road this near, in the same direction, is the same road
JUNCTION_RADIUS_M = 14.0  # distance from another road within which there are no markings


@dataclass(frozen=True)
class Ground:
    """A road network: its centre lines, and a raster of distances to them.

    Attributes:
        origin: (2,) world position of the raster's first node, metres; nodes are `CELL_M` apart.
        distance: (Y, X) metres from a node to the nearest centre line, at most `DISTANCE_MAX_M`.
        nearest: (Y, X) index into `line` of the nearest point.
        line: (P, 6) points of the centre lines: x, y, direction (unit), chainage, 1 where markings are painted.
        driven: (N, 2) smoothed driven path.
        hills: waves of `hills.draw`.
    """

    origin: F64
    distance: F32
    nearest: I32
    line: F64
    driven: F64
    hills: F64 = field(default_factory=lambda: FLAT)

    def at(self, xy: npt.ArrayLike) -> F64:
        """(...) distance from points (..., 2) to the nearest centre line, metres; `DISTANCE_MAX_M` off the raster."""
        from scipy.ndimage import map_coordinates

        g = (np.asarray(xy, np.float64) - self.origin) / CELL_M
        flat = g.reshape(-1, 2)
        return map_coordinates(self.distance, flat.T[::-1], order=1, cval=DISTANCE_MAX_M).reshape(g.shape[:-1])

    def runs(self) -> list[tuple[int, int]]:
        """Index ranges [a, b) of `line` without gaps."""
        breaks = np.flatnonzero(np.abs(np.diff(self.line[:, 4])) > 1.0) + 1
        edges = [0, *breaks.tolist(), len(self.line)]
        return list(pairwise(edges))


def lay_ground(path: F64, hills: F64 = FLAT) -> Ground:
    """Ground around a path (N, 2) that is driven once from start to end."""
    from scipy.spatial import cKDTree

    driven = smooth(path)
    line = _without_duplicates(_centre_line(driven))
    low, high = line[:, :2].min(0) - 2 * DISTANCE_MAX_M, line[:, :2].max(0) + 2 * DISTANCE_MAX_M
    x, y = (np.arange(low[k], high[k], CELL_M) for k in range(2))
    distance, nearest = np.empty((len(y), len(x)), np.float32), np.empty((len(y), len(x)), np.int32)
    tree = cKDTree(line[:, :2])
    for j in range(0, len(y), 64):  # in blocks of rows, to bound memory
        nodes = np.stack(np.meshgrid(x, y[j : j + 64]), axis=-1)
        d, i = tree.query(nodes, distance_upper_bound=DISTANCE_MAX_M, workers=2)
        distance[j : j + 64], nearest[j : j + 64] = np.minimum(d, DISTANCE_MAX_M), np.where(i < len(line), i, 0)
    return Ground(low, distance, nearest, line, driven, hills)


def _centre_line(driven: F64) -> F64:
    """(N, 5) x, y, direction, chainage of the centre line along the whole path, extended straight at both ends."""
    whole = extended(driven, EXTENSION_M)
    yaw = heading(whole)
    line = smooth(whole + LANE_OFFSET_M * np.column_stack([-np.sin(yaw), np.cos(yaw)]))
    yaw = heading(line)
    return np.column_stack([line, np.cos(yaw), np.sin(yaw), chainage(line)])


def _without_duplicates(line: F64) -> F64:
    """(P, 6) centre line without parts that run along an earlier road, and whether markings are painted."""
    from scipy.spatial import cKDTree

    tree = cKDTree(line[:, :2])
    keep = np.ones(len(line), bool)
    paired = tree.query_pairs(SAME_ROAD_M, output_type="ndarray")
    first, second = paired.min(axis=1), paired.max(axis=1)
    apart = line[second, 4] - line[first, 4] > 40.0
    along = np.abs((line[first, 2:4] * line[second, 2:4]).sum(axis=1)) > 0.85
    keep[second[apart & along]] = False
    line = line[keep]
    tree = cKDTree(line[:, :2])
    first, second = tree.query_pairs(JUNCTION_RADIUS_M, output_type="ndarray").T
    across = np.abs((line[first, 2:4] * line[second, 2:4]).sum(axis=1)) < 0.85
    across &= np.abs(line[first, 4] - line[second, 4]) > 40.0
    painted = np.ones(len(line))
    painted[first[across]] = painted[second[across]] = 0.0
    return np.column_stack([line, painted])
