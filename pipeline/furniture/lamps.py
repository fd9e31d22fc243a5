"""Lamps: what reaches out from the top of a tall pole, as an arm and the box at its end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.furniture.poles import Stem
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.geometry.primitives import Triangles

TALL = 3.5
"""Metres of a pole that carries a lamp."""
REACH = (0.4, 3.5)
"""Metres that an arm is long."""
BELOW, ABOVE = 1.0, 1.5
"""Metres below and above the pole's top between which an arm lies."""
CLOSE = 0.2
"""Metres between the points of an arm at most ..."""
JOINED = 0.4
"""... and from the pole's top."""
NARROW = 0.5
"""Metres across of an arm with its lamp at most."""
STEP = 0.2
"""Metres of an arm that share a middle."""
HEAD = 0.1
"""Metres across from which on it is the lamp's box."""
FEWEST = 30


@dataclass(frozen=True)
class Arm:
    """What reaches out from a pole.

    Attributes:
        path: (K, 3) of a tube from the pole outwards, local metres.
        radius: metres of the tube.
        box: (3,) centre and (3,) half extents along, across and up of the lamp's box, or None.
    """

    path: F64
    radius: float
    box: tuple[F64, F64] | None

    @property
    def direction(self) -> F64:
        """(2,) unit, on the ground plan, outwards."""
        d = self.path[-1, :2] - self.path[0, :2]
        return np.asarray(d / np.linalg.norm(d))

    @property
    def axes(self) -> F64:
        """(3, 3) rows along, across and up."""
        along = np.array([*self.direction, 0.0])
        return np.array([along, np.cross([0, 0, 1.0], along), [0, 0, 1.0]])

    def moved(self, by: F64) -> Arm:
        """It by (3,) metres elsewhere."""
        box = None if self.box is None else (self.box[0] + by, self.box[1])
        return replace(self, path=self.path + by, box=box)

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        box = None if self.box is None else [part.tolist() for part in self.box]
        return {"path": self.path.tolist(), "radius": self.radius, "box": box}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Arm:
        """What `to_json` told."""
        box = None if row["box"] is None else (np.array(row["box"][0]), np.array(row["box"][1]))
        return cls(np.array(row["path"], np.float64), row["radius"], box)

    def held(self, xyz: npt.NDArray[np.floating], thin: float) -> Bools:
        """(N,) which points are its own, `thin` metres around it."""
        own = np.zeros(len(xyz), bool)
        for a, b in pairwise(self.path):
            d = b - a
            t = np.clip((xyz - a) @ d / max(float(d @ d), 1e-9), 0, 1)
            own |= np.linalg.norm(xyz - a - t[:, None] * d, axis=1) < self.radius + thin
        if self.box is not None:
            centre, half = self.box
            own |= (np.abs((xyz - centre) @ self.axes.T) < half + thin).all(axis=1)
        return own

    def meshes(self) -> list[Triangles]:
        """Its tube and box."""
        parts = [primitives.tube(self.path, np.full(len(self.path), self.radius), 6)]
        return parts + ([] if self.box is None else [primitives.box(self.box[0], self.axes, self.box[1])])


def arm(stem: Stem, ground: float, xyz: F64, leafy: Bools) -> Arm | None:
    """What reaches out from the top of a pole; None: nothing does.

    Args:
        stem: the pole.
        ground: metres, z at its foot.
        xyz: (N, 3) points around it, its own among them.
        leafy: (N,) which of them are vegetation.
    """
    top = stem.centre[-1]
    if top[2] - ground < TALL:
        return None
    d = xyz - top
    off = np.hypot(*d[:, :2].T)
    near = (off < REACH[1]) & (d[:, 2] > -BELOW) & (d[:, 2] < ABOVE) & ~leafy
    near &= stem.distance(xyz) > max(0.04, 3 * stem.spread)
    piece = _joined(xyz[near], top)
    own = d[near][piece]
    if len(own) < FEWEST:
        return None
    middle = own[:, :2].mean(axis=0)
    if np.linalg.norm(middle) < REACH[0] / 3:
        return None
    along = middle / np.linalg.norm(middle)
    out, aside = own[:, :2] @ along, own[:, :2] @ np.array([-along[1], along[0]])
    length = float(np.percentile(out, 99))
    if not REACH[0] < length < REACH[1] or np.ptp(np.percentile(aside, [2, 98])) > NARROW:
        return None
    return _fitted(top, along, np.column_stack([out, aside, own[:, 2]]), length)


def _joined(xyz: F64, top: F64) -> Bools:
    """(N,) the points of the piece that reaches the top."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(xyz):
        return np.zeros(0, bool)
    pairs = cKDTree(xyz).query_pairs(CLOSE, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(xyz),) * 2)
    _, piece = connected_components(links, directed=False)
    near = np.hypot(*(xyz - top)[:, :2].T) < JOINED
    return np.isin(piece, piece[near])


def _fitted(top: F64, along: F64, own: F64, length: float) -> Arm:
    """Tube and box of points (N, 3) out, aside and up from the top."""
    count = max(2, int(length / STEP))
    edges = np.linspace(0, length, count + 1)
    parts = [own[(own[:, 0] >= a) & (own[:, 0] <= b)] for a, b in pairwise(edges.tolist())]
    parts = [part for part in parts if len(part) >= 3]
    middles = np.array([np.median(part, axis=0) for part in parts])
    across = np.array([np.ptp(np.percentile(part[:, 1], [10, 90])) for part in parts])
    wide = across > HEAD
    first = len(parts)
    while first > 0 and wide[first - 1]:
        first -= 1
    box = None
    axes = np.array([[*along, 0], [-along[1], along[0], 0], [0, 0, 1.0]])
    if 0 < first < len(parts):
        head = np.concatenate(parts[first:])
        low, high = np.percentile(head, [2, 98], axis=0)
        half = np.maximum((high - low) / 2, 0.02)
        box = top + (low + high) / 2 @ axes, half
    stretch = middles[: max(first, 1)] if box is not None else middles
    path = np.concatenate([[top], top + stretch @ axes])
    if box is not None:
        path = np.concatenate([path, [box[0]]])
    radius = float(np.clip(np.median(across[: max(first, 1)]) / 1.6, 0.02, 0.06))
    return Arm(path, radius, box)
