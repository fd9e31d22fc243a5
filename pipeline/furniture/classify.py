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
from scan2sim.pipeline.furniture.poles import STEM, Beams, Columns, Stem, refine_circle, stems
from scan2sim.pipeline.furniture.sign_panels import SignPanel, detect_panels
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.geometry.primitives import Triangles

Kind = Literal["pole", "sign", "lamp", "trunk"]

PANEL_SEARCH_RADIUS_M = 0.9
"""Distance of sign panels from their pole."""
PANEL_THICKNESS_M = 0.02
FOOT_DEPTH_M = 0.1
"""Meshes of poles extend this far into the ground, so that no gap is visible."""
GRAZING_M = 0.05
"""Further distance from a stem of returns of beams that only graze it: they would become a shell around it."""
TUBE_SIDES = {"pole": 8, "sign": 8, "lamp": 8, "trunk": 10}


@dataclass(frozen=True)
class ClassifyLimits:
    """Thresholds of the classification."""

    min_stem_length_m: float = 1.25  # of the isolated part of a pole or trunk
    min_post_length_m: float = 0.6  # of the isolated part of a low post: a delineator in grass
    max_post_height_m: float = 1.35  # of a low post: a bollard
    max_post_foot_height_m: float = 0.5  # height of the lowest visible point of a low post
    max_post_radius_m: float = 0.15
    post_clearance_m: tuple[float, float] = (0.6, 1.5)  # beside and above a low post
    min_post_own_fraction: float = 0.8  # of the points in that clearance
    crown_radius_m: float = 1.5  # around the top of a trunk, for `min_leafy_fraction`
    min_leafy_fraction: float = 0.5  # vegetation among the points of the crown, or of the trunk
    min_trunk_radius_m: float = 0.05
    max_trunk_slenderness: float = 25.0  # length to diameter of a trunk below a crown: lamps stand in crowns, too
    lamp_search_radius_m: float = 3.6  # distance of a lamp from its pole
    min_panel_height_m: float = 0.8  # above the ground
    max_panel_offset_m: float = 0.2  # distance of a sign panel in front of or behind its pole
    max_panel_pole_radius_m: float = 0.13  # what is flat beside thicker stems is foliage or a wall behind a trunk
    max_panel_overlap: float = 0.3  # of the heights of two panels that aren't parallel
    min_parallel_cosine: float = 0.9  # between the normals of parallel panels: front and back of a sign
    retroreflective_factor: float = 2.0  # intensity relative to the 90th percentile; above that of any matt surface
    sign_pole_radius_m: tuple[float, float] = (0.02, 0.09)


LIMITS = ClassifyLimits()


@dataclass(frozen=True)
class Detection:
    """A detected piece of street furniture.

    Attributes:
        kind: its kind.
        stem: its pole or trunk, from the ground up.
        panels: its sign panels.
        arm: its lamp arm, or None.
    """

    kind: Kind
    stem: Stem
    panels: tuple[SignPanel, ...] = ()
    arm: Arm | None = None

    @property
    def foot(self) -> F64:
        """Position (3,) of its foot on the ground, local metres."""
        return self.stem.centre[0]

    @property
    def height(self) -> float:
        """Height of its highest point above the ground, metres."""
        tops = [self.stem.centre[-1, 2], *(panel.centre[2] + panel.height / 2 for panel in self.panels)]
        return float(max(tops) - self.foot[2])

    def moved(self, by: F64) -> Detection:
        """The detection translated by (3,) metres, into another frame."""
        panels = tuple(panel.moved(by) for panel in self.panels)
        return Detection(self.kind, self.stem.moved(by), panels, None if self.arm is None else self.arm.moved(by))

    def to_json(self) -> dict[str, Any]:
        """JSON object, the inverse of `from_json`."""
        panels = [panel.to_json() for panel in self.panels]
        arm = None if self.arm is None else self.arm.to_json()
        return {"kind": self.kind, "stem": self.stem.to_json(), "panels": panels, "arm": arm}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Detection:
        """Read the result of `to_json`."""
        panels = tuple(SignPanel.from_json(panel) for panel in row["panels"])
        return cls(row["kind"], Stem.from_json(row["stem"]), panels, Arm.from_json(row["arm"]) if row["arm"] else None)

    def contains(self, xyz: npt.NDArray[np.floating]) -> Bools:
        """(N,) bool, True for points (N, 3) that belong to it, including measurement noise around it."""
        low, high = self.stem.centre[[0, -1], 2]
        margin = max(0.06, 3 * self.stem.spread)
        own = (self.stem.distance(xyz) < margin + GRAZING_M) & (xyz[:, 2] > low) & (xyz[:, 2] < high)
        for panel in self.panels:
            own |= panel.contains(xyz, margin=margin, max_distance=margin + 0.04)
        return own if self.arm is None else own | self.arm.contains(xyz, margin)

    def meshes(self) -> list[tuple[Triangles, int]]:
        """Meshes of its parts, each with its class code."""
        path = self.stem.centre.copy()
        path[0, 2] -= FOOT_DEPTH_M
        pole = primitives.tube(path, self.stem.radius, TUBE_SIDES[self.kind])
        parts = [(pole, CODE["high_vegetation"] if self.kind == "trunk" else CODE["pole"])]
        for panel in self.panels:
            parts.append((panel_mesh(panel), CODE["road_sign"]))
        return parts + [(part, CODE["pole"]) for part in (self.arm.meshes() if self.arm else [])]


def panel_mesh(panel: SignPanel) -> Triangles:
    """Mesh of a sign panel."""
    corners = panel.centre + panel.outline[:, :1] * panel.across + panel.outline[:, 1:] * (0, 0, 1)
    return primitives.plate(corners, -PANEL_THICKNESS_M * panel.normal)


def eligible(cloud: PointCloud) -> tuple[Bools, I64]:
    """Ground points (N,) bool, and indices of points that may be furniture, by their classes.

    Photos often give a trunk the class of the cars behind it; cars have no isolated parts.
    """
    assert cloud.classification is not None
    ground = group_of()[cloud.classification] == 0
    excluded = np.isin(cloud.classification, [*NOISE, CODE["person"]])
    return ground, np.flatnonzero(~ground & ~excluded)


def detect_furniture(cloud: PointCloud, columns: Columns, height: F32, path: Trajectory) -> list[Detection]:
    """Detect all street furniture of a cloud.

    Args:
        cloud: N classified points above the ground; only the classes vegetation and vehicle are used.
        columns: index of its points.
        height: (N,) metres above the ground.
        path: path of the scanner.
    """
    xyz = cloud.xyz
    assert cloud.classification is not None
    leafy, vehicle = group_of()[cloud.classification] == 2, cloud.classification == CODE["vehicle"]
    detections = []
    for stem in stems(columns, height, LIMITS.min_post_length_m, _beams(cloud, path)):
        n = columns.near(stem.middle, LIMITS.crown_radius_m)
        if stem.length < LIMITS.min_stem_length_m and not _is_low_post(stem, xyz[n], height[n], vehicle[n]):
            continue
        ground = float(np.median(xyz[n, 2] - height[n]))
        grounded = _extend_to_ground(stem, ground)
        if _is_trunk(stem, xyz[n], leafy[n]):
            detections.append(Detection("trunk", grounded))
        else:
            n = n[~vehicle[n]]
            panels = _panels_on(grounded, xyz[n], height[n])
            around = columns.near(stem.middle, LIMITS.lamp_search_radius_m)
            around = around[~vehicle[around]]
            lamp = fit_arm(grounded, ground, xyz[around].astype(np.float64), leafy[around])
            kind: Kind = "lamp" if lamp else "sign" if panels else "pole"
            detections.append(Detection(kind, _extend_to_panels(grounded, panels), tuple(panels), lamp))
    return detections + _retroreflective_signs(cloud, columns, height, path, detections)


def _beams(cloud: PointCloud, path: Trajectory) -> Beams | None:
    """Time and place of the scanner of each point; None if the times or the path's are unknown."""
    if cloud.time is None or len(path.times) < 2 or not np.isfinite(path.times).all():
        return None
    return Beams(cloud.time, path.at(cloud.time)[:, :2])


def _is_low_post(stem: Stem, xyz: F32, height: F32, vehicle: Bools) -> bool:
    """Whether a short stem is a delineator or a bollard: no part of a vehicle, nothing else beside or above it."""
    beside, above = LIMITS.post_clearance_m
    off = stem.distance(xyz)
    margin = max(0.03, 2 * stem.spread)
    ground = float(np.median(xyz[:, 2] - height))
    near = (off < beside) & (xyz[:, 2] > stem.centre[0, 2] + STEM.slab_m / 2) & (xyz[:, 2] < stem.centre[-1, 2] + above)
    own = (np.abs(off) < margin) & (xyz[:, 2] < stem.centre[-1, 2] + STEM.slab_m)
    return bool(
        stem.thickness < LIMITS.max_post_radius_m
        and stem.centre[-1, 2] - ground < LIMITS.max_post_height_m
        and stem.centre[0, 2] - ground < LIMITS.max_post_foot_height_m
        and (near & own & ~vehicle).sum() > LIMITS.min_post_own_fraction * near.sum()
    )


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
    top = max((panel.centre[2] for panel in panels), default=-np.inf)
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
    if stem.thickness > LIMITS.max_panel_pole_radius_m:
        return []
    off = stem.distance(xyz)
    near = (height > LIMITS.min_panel_height_m) & (off < PANEL_SEARCH_RADIUS_M)
    beside = xyz[near].astype(np.float64)
    good: list[SignPanel] = []
    for panel in detect_panels(beside, off[near] > max(0.03, 2 * stem.spread), stem.middle):
        (axis,), (radius,) = stem.at([panel.centre[2]])
        d = axis - panel.centre[:2]
        if d @ panel.normal[:2] > 0:
            panel = replace(panel, normal=-panel.normal)
        before, aside = abs(d @ panel.normal[:2]), abs(d @ panel.across[:2])
        near_top = panel.centre[2] - panel.height / 2 < stem.centre[-1, 2] + STEM.slab_m
        if (
            before < radius + LIMITS.max_panel_offset_m
            and aside < panel.width / 2
            and near_top
            and panel.width > max(3 * radius, 2 * (radius + 2 * stem.spread))
        ):
            good.append(panel)
    return _not_crossing(good)


def _not_crossing(panels: list[SignPanel]) -> list[SignPanel]:
    """Panels without those that cross another one at the same height: they are no sheets, but blurred posts."""

    def cross(a: SignPanel, b: SignPanel) -> bool:
        overlap = (a.height + b.height) / 2 - abs(a.centre[2] - b.centre[2])
        return overlap > LIMITS.max_panel_overlap * min(a.height, b.height) and (
            abs(float(a.normal @ b.normal)) < LIMITS.min_parallel_cosine
        )

    return [a for a in panels if not any(cross(a, b) for b in panels)]


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
        & (cloud.classification != CODE["vehicle"])
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
