"""Street furniture: which upright tubes are poles, signs or trunks, what they carry, and their meshes.

Tubes are found by shape (`pipeline.furniture.poles`), plates around them (`pipeline.furniture.sign_panels`); plates
that throw light back (signs are made so) are found by themselves, too, and their pole below them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE, NOISE, group_of
from scan2sim.pipeline.core.types import F32, F64, I64, Bools, PointCloud, Trajectory
from scan2sim.pipeline.furniture.lamps import Arm, arm
from scan2sim.pipeline.furniture.poles import SLAB, Columns, Stem, refined, stems
from scan2sim.pipeline.furniture.sign_panels import Plate, plates
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.geometry.primitives import Triangles

Kind = Literal["pole", "sign", "lamp", "trunk"]

LEAST = 1.25
"""Metres that a pole or trunk stands free at least."""
CROWN = 1.5
"""Metres around a trunk's top in which its crown is looked for ..."""
LEAFY = 0.5
"""... and share of the points there, or of the trunk's own, that are vegetation."""
THICK = 0.05
"""Metres: trunks are thicker (radius)."""
STOUT = 25.0
"""A trunk below a crown is at most this many times as long as it is thick: lamps stand in crowns, too."""
AROUND = 0.9
"""Metres around a pole in which its plates lie."""
AROUND_LAMP = 3.6
"""Metres around a pole in which its lamp hangs."""
HANGS = 0.8
"""Metres above the ground where plates begin."""
BEFORE = 0.2
"""Metres before or behind its pole that a plate may lie."""
BRIGHT = 2.0
"""Times the intensity that nine of ten points stay below: what throws light back, no matt surface does."""
TUBE = (0.02, 0.09)
"""Metres: radius of a sign's pole."""
SHEET = 0.02
"""Metres of a plate's thickness."""
SINK = 0.1
"""Metres that a foot reaches into the ground, so that no gap shows."""
SIDES = {"pole": 8, "sign": 8, "lamp": 8, "trunk": 10}


@dataclass(frozen=True)
class Thing:
    """A piece of street furniture.

    Attributes:
        kind: what it is.
        stem: its pole or trunk, from the ground up.
        plates: what it carries.
        arm: what reaches out from its top, or None.
    """

    kind: Kind
    stem: Stem
    plates: tuple[Plate, ...] = ()
    arm: Arm | None = None

    @property
    def foot(self) -> F64:
        """(3,) where it stands on the ground, local metres."""
        return self.stem.centre[0]

    @property
    def height(self) -> float:
        """Metres from the ground to its highest place."""
        tops = [self.stem.centre[-1, 2], *(plate.centre[2] + plate.height / 2 for plate in self.plates)]
        return float(max(tops) - self.foot[2])

    def moved(self, by: F64) -> Thing:
        """It by (3,) metres elsewhere: in another frame."""
        plates = tuple(plate.moved(by) for plate in self.plates)
        return Thing(self.kind, self.stem.moved(by), plates, None if self.arm is None else self.arm.moved(by))

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        plates = [plate.to_json() for plate in self.plates]
        arm = None if self.arm is None else self.arm.to_json()
        return {"kind": self.kind, "stem": self.stem.to_json(), "plates": plates, "arm": arm}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Thing:
        """What `to_json` told."""
        plates = tuple(Plate.from_json(plate) for plate in row["plates"])
        return cls(row["kind"], Stem.from_json(row["stem"]), plates, Arm.from_json(row["arm"]) if row["arm"] else None)

    def held(self, xyz: npt.NDArray[np.floating]) -> Bools:
        """(N,) which points (N, 3) are its own, those of noise around it among them."""
        low, high = self.stem.centre[[0, -1], 2]
        thin = max(0.06, 3 * self.stem.spread)
        own = (self.stem.distance(xyz) < thin) & (xyz[:, 2] > low) & (xyz[:, 2] < high)
        for plate in self.plates:
            own |= plate.holds(xyz, margin=thin, thin=thin + 0.04)
        return own if self.arm is None else own | self.arm.held(xyz, thin)

    def meshes(self) -> list[tuple[Triangles, int]]:
        """Its parts, and the class code of each."""
        path = self.stem.centre.copy()
        path[0, 2] -= SINK
        pole = primitives.tube(path, self.stem.radius, SIDES[self.kind])
        parts = [(pole, CODE["high_vegetation"] if self.kind == "trunk" else CODE["pole"])]
        for plate in self.plates:
            parts.append((sheet(plate), CODE["road_sign"]))
        return parts + [(part, CODE["pole"]) for part in (self.arm.meshes() if self.arm else [])]


def sheet(plate: Plate) -> Triangles:
    """A plate's mesh."""
    corners = plate.centre + plate.outline[:, :1] * plate.across + plate.outline[:, 1:] * (0, 0, 1)
    return primitives.plate(corners, -SHEET * plate.normal)


def eligible(cloud: PointCloud) -> tuple[Bools, I64]:
    """(N,) which points are the ground's, and the indices of those that may be furniture's, by their classes alone."""
    assert cloud.classification is not None
    ground = group_of()[cloud.classification] == 0
    out_of_it = np.isin(cloud.classification, [*NOISE, CODE["vehicle"], CODE["person"]])
    return ground, np.flatnonzero(~ground & ~out_of_it)


def find(cloud: PointCloud, columns: Columns, height: F32, path: Trajectory) -> list[Thing]:
    """All street furniture of a cloud.

    Args:
        cloud: N points above the ground, classified: of classes, only vegetation matters.
        columns: of its points.
        height: (N,) metres above the ground.
        path: the scanner's.
    """
    xyz = cloud.xyz
    assert cloud.classification is not None
    leafy = group_of()[cloud.classification] == 2
    things = []
    for stem in stems(columns, height, LEAST):
        n = columns.near(stem.middle, CROWN)
        ground = float(np.median(xyz[n, 2] - height[n]))
        standing = _grounded(stem, ground)
        if _is_trunk(stem, xyz[n], leafy[n]):
            things.append(Thing("trunk", standing))
        else:
            carried = _carried(standing, xyz[n], height[n])
            around = columns.near(stem.middle, AROUND_LAMP)
            lamp = arm(standing, ground, xyz[around].astype(np.float64), leafy[around])
            kind: Kind = "lamp" if lamp else "sign" if carried else "pole"
            things.append(Thing(kind, _up_to(standing, carried), tuple(carried), lamp))
    return things + _lonely(cloud, columns, height, path, things)


def _grounded(stem: Stem, ground: float) -> Stem:
    """The stem down to the ground."""
    if stem.centre[0, 2] <= ground:
        return stem
    xy, radius = stem.at([ground])
    return replace(
        stem, centre=np.vstack([[*xy[0], ground], stem.centre]), radius=np.concatenate([radius, stem.radius])
    )


def _up_to(stem: Stem, carried: list[Plate]) -> Stem:
    """The stem up to the middle of the highest plate, where it ended below."""
    top = max((plate.centre[2] for plate in carried), default=-np.inf)
    if top <= stem.centre[-1, 2]:
        return stem
    xy, radius = stem.at([top])
    return replace(stem, centre=np.vstack([stem.centre, [*xy[0], top]]), radius=np.concatenate([stem.radius, radius]))


def _is_trunk(stem: Stem, xyz: F32, leafy: Bools) -> bool:
    """Whether it is thick, and itself or what is around its top is vegetation."""
    if stem.thickness < THICK:
        return False
    off, top = stem.distance(xyz), stem.centre[-1, 2]
    own = (np.abs(off) < 0.05) & (xyz[:, 2] < top)
    if own.any() and leafy[own].mean() >= LEAFY:
        return True
    above = (off > 0.05) & (off < CROWN) & (xyz[:, 2] > top - 0.5) & (xyz[:, 2] < top + CROWN)
    stout = stem.length < STOUT * 2 * stem.thickness
    return bool(stout and above.sum() >= 20 and leafy[above].mean() >= LEAFY)


def _carried(stem: Stem, xyz: F32, height: F32) -> list[Plate]:
    """Plates on a pole; they look away from it."""
    off = stem.distance(xyz)
    near = (height > HANGS) & (off < AROUND)
    beside = xyz[near].astype(np.float64)
    good: list[Plate] = []
    for plate in plates(beside, off[near] > max(0.03, 2 * stem.spread), stem.middle):
        (axis,), (radius,) = stem.at([plate.centre[2]])
        d = axis - plate.centre[:2]
        if d @ plate.normal[:2] > 0:
            plate = replace(plate, normal=-plate.normal)
        before, aside = abs(d @ plate.normal[:2]), abs(d @ plate.across[:2])
        near_top = plate.centre[2] - plate.height / 2 < stem.centre[-1, 2] + SLAB
        if before < radius + BEFORE and aside < plate.width / 2 and near_top and plate.width > 3 * radius:
            good.append(plate)
    return good


def _lonely(cloud: PointCloud, columns: Columns, height: F32, path: Trajectory, things: list[Thing]) -> list[Thing]:
    """Signs that throw light back, on poles that do not stand free."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    xyz, intensity = cloud.xyz, cloud.intensity
    if intensity is None:
        return []
    bright = np.flatnonzero((intensity > BRIGHT * np.percentile(intensity, 90)) & (height > HANGS) & (height < 6))
    for thing in things:
        bright = bright[~thing.held(xyz[bright])]
    if not len(bright):
        return []
    pairs = cKDTree(xyz[bright]).query_pairs(0.15, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(bright),) * 2)
    _, piece = connected_components(links, directed=False)
    found = []
    for k in np.flatnonzero(np.bincount(piece) >= 20):
        own = bright[piece == k]
        middle = xyz[own, :2].mean(axis=0).astype(np.float64)
        carried = plates(xyz[own].astype(np.float64), np.ones(len(own), bool), _viewer(cloud, own, path), most=2)
        near = columns.near(middle, 0.5)
        stem = _below(xyz[near], height[near], middle, float(xyz[own, 2].min()))
        if stem is not None and carried:
            found.append(Thing("sign", _up_to(stem, carried), tuple(carried)))
    return found


def _viewer(cloud: PointCloud, index: I64, path: Trajectory) -> F64:
    """(2,) from where the scanner saw points, on the ground plan: in the mean, or the path's nearest place."""
    if cloud.time is not None and len(path.times) > 1 and np.isfinite(path.times).all():
        return np.asarray(path.at(cloud.time[index])[:, :2].mean(axis=0))
    middle = cloud.xyz[index, :2].mean(axis=0)
    return np.asarray(path.positions[np.hypot(*(path.positions[:, :2] - middle).T).argmin(), :2])


def _below(xyz: F32, height: F32, middle: F64, top: float) -> Stem | None:
    """The pole below something at `middle` (2,), though other things touch it: where points lie in slab upon slab."""
    import cv2

    ground = float(np.median(xyz[:, 2] - height))
    low = (height > SLAB) & (xyz[:, 2] < top)
    slabs = int((top - ground) / SLAB) - 1
    if slabs < 3 or low.sum() < 5 * slabs:
        return None
    cell, n = 0.04, 24
    at = np.floor((xyz[low, :2] - middle) / cell).astype(int) + n // 2
    level = np.floor(height[low] / SLAB).astype(int) - 1
    ok = (at >= 0).all(axis=1) & (at < n).all(axis=1) & (level < slabs)
    held = np.zeros((slabs, n, n), np.float32)
    np.add.at(held, (level[ok], at[ok, 0], at[ok, 1]), 1)
    through = np.mean([cv2.blur(layer, (3, 3)) * 9 >= 3 for layer in held], axis=0)
    many = cv2.blur(held.sum(axis=0), (3, 3))
    peak = np.unravel_index(np.argmax(through + many / (many.max() + 1) / slabs), through.shape)
    if through[peak] < 0.6:
        return None
    place = middle + (np.array(peak) - n // 2 + 0.5) * cell
    flat = (xyz[low, :2] - place).astype(np.float64)
    flat = flat[np.hypot(*flat.T) < 2 * cell + TUBE[1]]
    centre, radius = refined(flat, np.ones(len(flat)), np.zeros(2), 0.04, 8, 10.0)
    if np.hypot(*centre) > 0.15:
        centre = np.zeros(2)
    z = np.array([ground, top])
    xy = np.broadcast_to(place + centre, (2, 2))
    return Stem(np.column_stack([xy, z]), np.full(2, np.clip(radius, *TUBE)), 0.02, 0.0)
