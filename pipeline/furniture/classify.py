"""Street furniture: classification of stems as poles, signs, lamps or trunks, their attachments, and meshes.

Stems are detected by shape (`pipeline.furniture.poles`), then sign panels around them
(`pipeline.furniture.sign_panels`). Retroreflective panels are also detected without a stem; their pole is then
searched below them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE, NOISE, group_of
from scan2sim.pipeline.core.types import F32, F64, I64, Bools, PointCloud, Trajectory
from scan2sim.pipeline.furniture.lamps import Arm, fit_arm
from scan2sim.pipeline.furniture.poles import STEM, Columns, Stem, refine_circle, stems
from scan2sim.pipeline.furniture.sign_panels import SignPanel, detect_panels
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.geometry.primitives import Triangles

Kind = Literal["pole", "sign", "lamp", "trunk"]

PANEL_SEARCH_RADIUS_M = 0.9
"""Distance of sign panels from their pole."""
PANEL_THICKNESS_M = 0.02
FOOT_DEPTH_M = 0.1
"""Meshes of poles extend this far into the ground, so that no gap is visible."""
TUBE_SIDES = {"pole": 8, "sign": 8, "lamp": 8, "trunk": 10}


@dataclass(frozen=True)
class ClassifyLimits:
    """Thresholds of the classification."""

    min_stem_length_m: float = 1.25  # of the isolated part of a pole or trunk
    crown_radius_m: float = 1.5  # around the top of a trunk, for `min_leafy_fraction`
    min_leafy_fraction: float = 0.5  # vegetation among the points of the crown, or of the trunk
    min_trunk_radius_m: float = 0.05
    max_trunk_slenderness: float = 25.0  # length to diameter of a trunk below a crown: lamps stand in crowns, too
    lamp_search_radius_m: float = 3.6  # distance of a lamp from its pole
    min_panel_height_m: float = 0.8  # above the ground
    max_panel_offset_m: float = 0.2  # distance of a sign panel in front of or behind its pole
    retroreflective_factor: float = 2.0  # intensity relative to the 90th percentile; above that of any matt surface
    sign_pole_radius_m: tuple[float, float] = (0.02, 0.09)


LIMITS = ClassifyLimits()


@dataclass(frozen=True)
class Detection:
    """A detected piece of street furniture.

    Attributes:
        kind: its kind.
        stem: its pole or trunk, from the ground up.
        plates: its sign panels.
        arm: its lamp arm, or None.
    """

    kind: Kind
    stem: Stem
    plates: tuple[SignPanel, ...] = ()
    arm: Arm | None = None

    @property
    def foot(self) -> F64:
        """Position (3,) of its foot on the ground, local metres."""
        return self.stem.centre[0]

    @property
    def height(self) -> float:
        """Height of its highest point above the ground, metres."""
        tops = [self.stem.centre[-1, 2], *(plate.centre[2] + plate.height / 2 for plate in self.plates)]
        return float(max(tops) - self.foot[2])

    def moved(self, by: F64) -> Detection:
        """The detection translated by (3,) metres, into another frame."""
        plates = tuple(plate.moved(by) for plate in self.plates)
        return Detection(self.kind, self.stem.moved(by), plates, None if self.arm is None else self.arm.moved(by))

    def to_json(self) -> dict[str, Any]:
        """JSON object, the inverse of `from_json`."""
        plates = [plate.to_json() for plate in self.plates]
        arm = None if self.arm is None else self.arm.to_json()
        return {"kind": self.kind, "stem": self.stem.to_json(), "plates": plates, "arm": arm}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Detection:
        """Read the result of `to_json`."""
        plates = tuple(SignPanel.from_json(plate) for plate in row["plates"])
        return cls(row["kind"], Stem.from_json(row["stem"]), plates, Arm.from_json(row["arm"]) if row["arm"] else None)

    def contains(self, xyz: npt.NDArray[np.floating]) -> Bools:
        """(N,) bool, True for points (N, 3) that belong to it, including measurement noise around it."""
        low, high = self.stem.centre[[0, -1], 2]
        margin = max(0.06, 3 * self.stem.spread)
        own = (self.stem.distance(xyz) < margin) & (xyz[:, 2] > low) & (xyz[:, 2] < high)
        for plate in self.plates:
            own |= plate.contains(xyz, margin=margin, max_distance=margin + 0.04)
        return own if self.arm is None else own | self.arm.contains(xyz, margin)

    def meshes(self) -> list[tuple[Triangles, int]]:
        """Meshes of its parts, each with its class code."""
        path = self.stem.centre.copy()
        path[0, 2] -= FOOT_DEPTH_M
        pole = primitives.tube(path, self.stem.radius, TUBE_SIDES[self.kind])
        parts = [(pole, CODE["high_vegetation"] if self.kind == "trunk" else CODE["pole"])]
        for plate in self.plates:
            parts.append((panel_mesh(plate), CODE["road_sign"]))
        return parts + [(part, CODE["pole"]) for part in (self.arm.meshes() if self.arm else [])]


def panel_mesh(plate: SignPanel) -> Triangles:
    """Mesh of a sign panel."""
    corners = plate.centre + plate.outline[:, :1] * plate.across + plate.outline[:, 1:] * (0, 0, 1)
    return primitives.plate(corners, -PANEL_THICKNESS_M * plate.normal)


def eligible(cloud: PointCloud) -> tuple[Bools, I64]:
    """Ground points (N,) bool, and indices of points that may be furniture, by their classes."""
    assert cloud.classification is not None
    ground = group_of()[cloud.classification] == 0
    excluded = np.isin(cloud.classification, [*NOISE, CODE["vehicle"], CODE["person"]])
    return ground, np.flatnonzero(~ground & ~excluded)


def detect_furniture(cloud: PointCloud, columns: Columns, height: F32, path: Trajectory) -> list[Detection]:
    """Detect all street furniture of a cloud.

    Args:
        cloud: N classified points above the ground; only the class vegetation is used.
        columns: index of its points.
        height: (N,) metres above the ground.
        path: path of the scanner.
    """
    xyz = cloud.xyz
    assert cloud.classification is not None
    leafy = group_of()[cloud.classification] == 2
    detections = []
    for stem in stems(columns, height, LIMITS.min_stem_length_m):
        n = columns.near(stem.middle, LIMITS.crown_radius_m)
        ground = float(np.median(xyz[n, 2] - height[n]))
        grounded = _extend_to_ground(stem, ground)
        if _is_trunk(stem, xyz[n], leafy[n]):
            detections.append(Detection("trunk", grounded))
        else:
            panels = _panels_on(grounded, xyz[n], height[n])
            around = columns.near(stem.middle, LIMITS.lamp_search_radius_m)
            lamp = fit_arm(grounded, ground, xyz[around].astype(np.float64), leafy[around])
            kind: Kind = "lamp" if lamp else "sign" if panels else "pole"
            detections.append(Detection(kind, _extend_to_panels(grounded, panels), tuple(panels), lamp))
    return detections + _retroreflective_signs(cloud, columns, height, path, detections)


def _extend_to_ground(stem: Stem, ground: float) -> Stem:
    """The stem extended down to the ground."""
    if stem.centre[0, 2] <= ground:
        return stem
    xy, radius = stem.at([ground])
    return replace(
        stem, centre=np.vstack([[*xy[0], ground], stem.centre]), radius=np.concatenate([radius, stem.radius])
    )


def _extend_to_panels(stem: Stem, panels: list[SignPanel]) -> Stem:
    """The stem extended up to the centre of the highest sign panel."""
    top = max((plate.centre[2] for plate in panels), default=-np.inf)
    if top <= stem.centre[-1, 2]:
        return stem
    xy, radius = stem.at([top])
    return replace(stem, centre=np.vstack([stem.centre, [*xy[0], top]]), radius=np.concatenate([stem.radius, radius]))


def _is_trunk(stem: Stem, xyz: F32, leafy: Bools) -> bool:
    """Whether a stem is a trunk: thick, with vegetation on it or around its top."""
    if stem.thickness < LIMITS.min_trunk_radius_m:
        return False
    off, top = stem.distance(xyz), stem.centre[-1, 2]
    own = (np.abs(off) < 0.05) & (xyz[:, 2] < top)
    if own.any() and leafy[own].mean() >= LIMITS.min_leafy_fraction:
        return True
    above = (
        (off > 0.05)
        & (off < LIMITS.crown_radius_m)
        & (xyz[:, 2] > top - 0.5)
        & (xyz[:, 2] < top + LIMITS.crown_radius_m)
    )
    stout = stem.length < LIMITS.max_trunk_slenderness * 2 * stem.thickness
    return bool(stout and above.sum() >= 20 and leafy[above].mean() >= LIMITS.min_leafy_fraction)


def _panels_on(stem: Stem, xyz: F32, height: F32) -> list[SignPanel]:
    """Sign panels on a pole, facing away from it."""
    off = stem.distance(xyz)
    near = (height > LIMITS.min_panel_height_m) & (off < PANEL_SEARCH_RADIUS_M)
    beside = xyz[near].astype(np.float64)
    good: list[SignPanel] = []
    for plate in detect_panels(beside, off[near] > max(0.03, 2 * stem.spread), stem.middle):
        (axis,), (radius,) = stem.at([plate.centre[2]])
        d = axis - plate.centre[:2]
        if d @ plate.normal[:2] > 0:
            plate = replace(plate, normal=-plate.normal)
        before, aside = abs(d @ plate.normal[:2]), abs(d @ plate.across[:2])
        near_top = plate.centre[2] - plate.height / 2 < stem.centre[-1, 2] + STEM.slab_m
        if (
            before < radius + LIMITS.max_panel_offset_m
            and aside < plate.width / 2
            and near_top
            and plate.width > 3 * radius
        ):
            good.append(plate)
    return good


def _retroreflective_signs(
    cloud: PointCloud, columns: Columns, height: F32, path: Trajectory, detections: list[Detection]
) -> list[Detection]:
    """Signs with retroreflective panels on poles that were not detected because they are not isolated."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    xyz, intensity = cloud.xyz, cloud.intensity
    if intensity is None:
        return []
    bright = np.flatnonzero(
        (intensity > LIMITS.retroreflective_factor * np.percentile(intensity, 90))
        & (height > LIMITS.min_panel_height_m)
        & (height < 6)
    )
    for detection in detections:
        bright = bright[~detection.contains(xyz[bright])]
    if not len(bright):
        return []
    pairs = cKDTree(xyz[bright]).query_pairs(0.15, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(bright),) * 2)
    _, piece = connected_components(links, directed=False)
    found = []
    for k in np.flatnonzero(np.bincount(piece) >= 20):
        own = bright[piece == k]
        middle = xyz[own, :2].mean(axis=0).astype(np.float64)
        panels = detect_panels(
            xyz[own].astype(np.float64), np.ones(len(own), bool), _viewpoint(cloud, own, path), max_panels=2
        )
        near = columns.near(middle, 0.5)
        stem = _pole_below(xyz[near], height[near], middle, float(xyz[own, 2].min()))
        if stem is not None and panels:
            found.append(Detection("sign", _extend_to_panels(stem, panels), tuple(panels)))
    return found


def _viewpoint(cloud: PointCloud, index: I64, path: Trajectory) -> F64:
    """Mean position (2,) of the scanner when it saw the points, in plan view; without times, of the path."""
    if cloud.time is not None and len(path.times) > 1 and np.isfinite(path.times).all():
        return np.asarray(path.at(cloud.time[index])[:, :2].mean(axis=0))
    middle = cloud.xyz[index, :2].mean(axis=0)
    return np.asarray(path.positions[np.hypot(*(path.positions[:, :2] - middle).T).argmin(), :2])


def _pole_below(xyz: F32, height: F32, middle: F64, top: float) -> Stem | None:
    """Pole below `middle` (2,) even if other objects touch it: the location with points in most slabs; or None."""
    import cv2

    ground = float(np.median(xyz[:, 2] - height))
    low = (height > STEM.slab_m) & (xyz[:, 2] < top)
    slabs = int((top - ground) / STEM.slab_m) - 1
    if slabs < 3 or low.sum() < 5 * slabs:
        return None
    cell, n = 0.04, 24
    at = np.floor((xyz[low, :2] - middle) / cell).astype(int) + n // 2
    level = np.floor(height[low] / STEM.slab_m).astype(int) - 1
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
    flat = flat[np.hypot(*flat.T) < 2 * cell + LIMITS.sign_pole_radius_m[1]]
    centre, radius = refine_circle(flat, np.ones(len(flat)), np.zeros(2), 0.04, 8, 10.0)
    if np.hypot(*centre) > 0.15:
        centre = np.zeros(2)
    z = np.array([ground, top])
    xy = np.broadcast_to(place + centre, (2, 2))
    return Stem(np.column_stack([xy, z]), np.full(2, np.clip(radius, *LIMITS.sign_pole_radius_m)), 0.02, 0.0)
