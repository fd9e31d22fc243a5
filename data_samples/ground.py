"""The town's ground: where the road is, and how far from it everything else.

The road's centre line runs `LANE` to the left of the driven path (traffic keeps right). Where a path
comes by again, the road that is there already serves. Heights: road 0, all else `KERB` above, and hills below both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.hills import FLAT
from scan2sim.data_samples.paths import chainage, extended, heading, smooth
from scan2sim.pipeline.core.types import F32, F64, I32

LANE = 1.7  # metres from the centre line to the driven path
HALF = 5.2  # half the carriageway, parking included
WALK = 2.6  # width of the pavement
KERB = 0.12
CELL = 0.5  # metres of the raster
FAR = 30.0  # distances are capped here
AHEAD = 80.0  # metres that the road goes on beyond the path's ends
SAME = 2.8  # metres: a road this near, in the same direction, is the same road
JUNCTION = 14.0  # metres from another road within which there are no markings


@dataclass(frozen=True)
class Ground:
    """A road network as a raster of distances, and its centre lines.

    Attributes:
        origin: (2,) world metres of the raster's first node; nodes are `CELL` apart.
        distance: (Y, X) metres from a node to the nearest centre line, at most `FAR`.
        nearest: (Y, X) index into `line` of the nearest point.
        line: (P, 6) points of the centre lines: x, y, direction (unit), chainage, 1 where markings are painted.
        driven: (N, 2) the smoothed path itself.
        hills: see `hills.draw`.
    """

    origin: F64
    distance: F32
    nearest: I32
    line: F64
    driven: F64
    hills: F64 = field(default_factory=lambda: FLAT)

    def at(self, xy: npt.ArrayLike) -> F64:
        """(...) metres from points (..., 2) to the nearest centre line (bilinear), `FAR` outside the raster."""
        from scipy.ndimage import map_coordinates

        g = (np.asarray(xy, np.float64) - self.origin) / CELL
        flat = g.reshape(-1, 2)
        return map_coordinates(self.distance, flat.T[::-1], order=1, cval=FAR).reshape(g.shape[:-1])

    def runs(self) -> list[tuple[int, int]]:
        """Index ranges [a, b) of `line` that run on without a break."""
        breaks = np.flatnonzero(np.abs(np.diff(self.line[:, 4])) > 1.0) + 1
        edges = [0, *breaks.tolist(), len(self.line)]
        return list(pairwise(edges))


def lay_ground(path: F64, hills: F64 = FLAT) -> Ground:
    """The ground around a path (N, 2) that is driven once from its start to its end."""
    from scipy.spatial import cKDTree

    driven = smooth(path)
    line = _roads(_centre(driven))
    low, high = line[:, :2].min(0) - 2 * FAR, line[:, :2].max(0) + 2 * FAR
    x, y = (np.arange(low[k], high[k], CELL) for k in range(2))
    distance, nearest = np.empty((len(y), len(x)), np.float32), np.empty((len(y), len(x)), np.int32)
    tree = cKDTree(line[:, :2])
    for j in range(0, len(y), 64):  # rows at a time
        nodes = np.stack(np.meshgrid(x, y[j : j + 64]), axis=-1)
        d, i = tree.query(nodes, distance_upper_bound=FAR, workers=2)
        distance[j : j + 64], nearest[j : j + 64] = np.minimum(d, FAR), np.where(i < len(line), i, 0)
    return Ground(low, distance, nearest, line, driven, hills)


def _centre(driven: F64) -> F64:
    """(N, 5) x, y, direction, chainage of the centre line along the whole path, and straight on beyond its ends."""
    whole = extended(driven, AHEAD)
    yaw = heading(whole)
    line = smooth(whole + LANE * np.column_stack([-np.sin(yaw), np.cos(yaw)]))
    yaw = heading(line)
    return np.column_stack([line, np.cos(yaw), np.sin(yaw), chainage(line)])


def _roads(line: F64) -> F64:
    """(P, 6) without what runs along an earlier road, and whether markings are painted."""
    from scipy.spatial import cKDTree

    tree = cKDTree(line[:, :2])
    keep = np.ones(len(line), bool)
    paired = tree.query_pairs(SAME, output_type="ndarray")
    first, second = paired.min(axis=1), paired.max(axis=1)
    apart = line[second, 4] - line[first, 4] > 40.0
    along = np.abs((line[first, 2:4] * line[second, 2:4]).sum(axis=1)) > 0.85
    keep[second[apart & along]] = False
    line = line[keep]
    tree = cKDTree(line[:, :2])
    first, second = tree.query_pairs(JUNCTION, output_type="ndarray").T
    across = np.abs((line[first, 2:4] * line[second, 2:4]).sum(axis=1)) < 0.85
    across &= np.abs(line[first, 4] - line[second, 4]) > 40.0
    painted = np.ones(len(line))
    painted[first[across]] = painted[second[across]] = 0.0
    return np.column_stack([line, painted])
